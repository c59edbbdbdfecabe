// From an engine's world to a field: points to voxels, and looks to the field's own axes, in which its spherical
// harmonics are: asked there, they turn with the object. GLSL ES 3.00 (WebGL 2) and GLSL 3.30; no buffers.
//
// Three rows of a 3 x 4 matrix are vec4s, so that it does not matter whether an engine counts rows or columns first.
#ifndef NERFBAKE_WORLD_GLSL
#define NERFBAKE_WORLD_GLSL
precision highp float;
precision highp int;

const int Z_UP = 0;       // right-handed, z up: Blender, and the fields themselves
const int Y_UP = 1;       // right-handed, y up: glTF, three.js
const int Y_UP_LEFT = 2;  // left-handed, y up: Unity

struct World {
    vec4 toObject[3];  // the engine's world to the object, e.g. unity_WorldToObject or the inverse of matrixWorld
    vec4 toVoxels[3];  // what the field's own world is in voxels
    int axes;          // those of the engine: one of the three above
};

vec3 timesRows(vec4 rows[3], vec4 v) {
    return vec3(dot(rows[0], v), dot(rows[1], v), dot(rows[2], v));
}

// A vector in the object's axes, as the engine has them, in those of the field's own world.
vec3 zUp(int axes, vec3 v) {
    if (axes == Y_UP) return vec3(v.x, -v.z, v.y);
    if (axes == Y_UP_LEFT) return vec3(v.x, v.z, v.y);
    return v;
}

// A point of the engine's world, in voxels.
vec3 pointInVoxels(World world, vec3 point) {
    return timesRows(world.toVoxels, vec4(zUp(world.axes, timesRows(world.toObject, vec4(point, 1.0))), 1.0));
}

// How many voxels a step in the engine's world is: what march() takes as its direction.
vec3 stepInVoxels(World world, vec3 along) {
    return timesRows(world.toVoxels, vec4(zUp(world.axes, timesRows(world.toObject, vec4(along, 0.0))), 0.0));
}

// A look along a step in the engine's world, of length 1, in the field's own axes: what harmonics() takes.
vec3 lookInAxes(World world, vec3 along) {
    vec3 look = stepInVoxels(world, along);
    for (int i = 0; i < 3; i++) look[i] /= length(world.toVoxels[i].xyz);
    return normalize(look);
}
#endif  // NERFBAKE_WORLD_GLSL
