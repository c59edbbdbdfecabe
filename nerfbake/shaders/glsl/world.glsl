// Transforms from an engine's world to a field: points to voxels, and view directions to the field's own axes.
// Evaluate spherical harmonics in these axes, so that they rotate with the object.
// GLSL ES 3.00 (WebGL 2) and GLSL 3.30; no buffers.
//
// The three rows of a 3 x 4 matrix are vec4s, so the code does not depend on an engine's order of rows and columns.
#ifndef NERFBAKE_WORLD_GLSL
#define NERFBAKE_WORLD_GLSL
precision highp float;
precision highp int;

const int Z_UP = 0;       // right-handed, z up: Blender, and the fields themselves
const int Y_UP = 1;       // right-handed, y up: glTF, three.js
const int Y_UP_LEFT = 2;  // left-handed, y up: Unity

struct World {
    vec4 toObject[3];  // engine's world to object, e.g. unity_WorldToObject or the inverse of matrixWorld
    vec4 toVoxels[3];  // field's own world to voxels
    int axes;          // of the engine: one of the three constants above
};

vec3 timesRows(vec4 rows[3], vec4 v) {
    return vec3(dot(rows[0], v), dot(rows[1], v), dot(rows[2], v));
}

// Convert a vector from the object's axes in the engine to the axes of the field's own world.
vec3 zUp(int axes, vec3 v) {
    if (axes == Y_UP) return vec3(v.x, -v.z, v.y);
    if (axes == Y_UP_LEFT) return vec3(v.x, v.z, v.y);
    return v;
}

// Convert a point of the engine's world to voxels.
vec3 pointInVoxels(World world, vec3 point) {
    return timesRows(world.toVoxels, vec4(zUp(world.axes, timesRows(world.toObject, vec4(point, 1.0))), 1.0));
}

// Convert a vector of the engine's world to voxels. march() takes the result as `along`.
vec3 stepInVoxels(World world, vec3 along) {
    return timesRows(world.toVoxels, vec4(zUp(world.axes, timesRows(world.toObject, vec4(along, 0.0))), 0.0));
}

// Convert a direction of the engine's world to a unit vector in the field's own axes, as harmonics() takes it.
vec3 lookInAxes(World world, vec3 along) {
    vec3 look = stepInVoxels(world, along);
    for (int i = 0; i < 3; i++) look[i] /= length(world.toVoxels[i].xyz);
    return normalize(look);
}
#endif  // NERFBAKE_WORLD_GLSL
