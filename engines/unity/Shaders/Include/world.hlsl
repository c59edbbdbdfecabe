// From an engine's world to a field: points to voxels, and looks to the field's own axes, in which its spherical
// harmonics are: asked there, they turn with the object. HLSL, shader model 5; no buffers.
//
// Three rows of a 3 x 4 matrix are float4s, so that it does not matter whether an engine counts rows or columns first.
#ifndef NERFBAKE_WORLD_HLSL
#define NERFBAKE_WORLD_HLSL
static const int Z_UP = 0;       // right-handed, z up: Blender, and the fields themselves
static const int Y_UP = 1;       // right-handed, y up: glTF, three.js
static const int Y_UP_LEFT = 2;  // left-handed, y up: Unity

struct World {
    float4 toObject[3];  // the engine's world to the object, e.g. unity_WorldToObject or the inverse of matrixWorld
    float4 toVoxels[3];  // what the field's own world is in voxels
    int axes;            // those of the engine: one of the three above
};

float3 timesRows(float4 rows[3], float4 v) {
    return float3(dot(rows[0], v), dot(rows[1], v), dot(rows[2], v));
}

// A vector in the object's axes, as the engine has them, in those of the field's own world.
float3 zUp(int axes, float3 v) {
    if (axes == Y_UP) return float3(v.x, -v.z, v.y);
    if (axes == Y_UP_LEFT) return float3(v.x, v.z, v.y);
    return v;
}

// A point of the engine's world, in voxels.
float3 pointInVoxels(World world, float3 p) {
    return timesRows(world.toVoxels, float4(zUp(world.axes, timesRows(world.toObject, float4(p, 1.0))), 1.0));
}

// How many voxels a step in the engine's world is: what march() takes as its direction.
float3 stepInVoxels(World world, float3 along) {
    return timesRows(world.toVoxels, float4(zUp(world.axes, timesRows(world.toObject, float4(along, 0.0))), 0.0));
}

// A look along a step in the engine's world, of length 1, in the field's own axes: what harmonics() takes.
float3 lookInAxes(World world, float3 along) {
    float3 look = stepInVoxels(world, along);
    for (int i = 0; i < 3; i++) look[i] /= length(world.toVoxels[i].xyz);
    return normalize(look);
}
#endif  // NERFBAKE_WORLD_HLSL
