// Transforms from an engine's world to a field: points to voxels, and view directions to the field's own axes.
// Evaluate spherical harmonics in these axes, so that they rotate with the object.
// HLSL, shader model 5; no buffers.
//
// The three rows of a 3 x 4 matrix are float4s, so the code does not depend on an engine's order of rows and columns.
#ifndef NERFBAKE_WORLD_HLSL
#define NERFBAKE_WORLD_HLSL
static const int Z_UP = 0;       // right-handed, z up: Blender, and the fields themselves
static const int Y_UP = 1;       // right-handed, y up: glTF, three.js
static const int Y_UP_LEFT = 2;  // left-handed, y up: Unity

struct World {
    float4 toObject[3];  // engine's world to object, e.g. unity_WorldToObject or the inverse of matrixWorld
    float4 toVoxels[3];  // field's own world to voxels
    int axes;            // of the engine: one of the three constants above
};

float3 timesRows(float4 rows[3], float4 v) {
    return float3(dot(rows[0], v), dot(rows[1], v), dot(rows[2], v));
}

// Convert a vector from the object's axes in the engine to the axes of the field's own world.
float3 zUp(int axes, float3 v) {
    if (axes == Y_UP) return float3(v.x, -v.z, v.y);
    if (axes == Y_UP_LEFT) return float3(v.x, v.z, v.y);
    return v;
}

// Convert a point of the engine's world to voxels.
float3 pointInVoxels(World world, float3 p) {
    return timesRows(world.toVoxels, float4(zUp(world.axes, timesRows(world.toObject, float4(p, 1.0))), 1.0));
}

// Convert a vector of the engine's world to voxels. march() takes the result as `along`.
float3 stepInVoxels(World world, float3 along) {
    return timesRows(world.toVoxels, float4(zUp(world.axes, timesRows(world.toObject, float4(along, 0.0))), 0.0));
}

// Convert a direction of the engine's world to a unit vector in the field's own axes, as harmonics() takes it.
float3 lookInAxes(World world, float3 along) {
    float3 look = stepInVoxels(world, along);
    for (int i = 0; i < 3; i++) look[i] /= length(world.toVoxels[i].xyz);
    return normalize(look);
}
#endif  // NERFBAKE_WORLD_HLSL
