// Transforms from an engine's world to a field: points to voxels, and view directions to the field's own axes.
// Evaluate spherical harmonics in these axes, so that they rotate with the object.
// WGSL; no buffers.
//
// The three rows of a 3 x 4 matrix are vec4s, so the code does not depend on an engine's order of rows and columns.
const Z_UP = 0;       // right-handed, z up: Blender, and the fields themselves
const Y_UP = 1;       // right-handed, y up: glTF, three.js
const Y_UP_LEFT = 2;  // left-handed, y up: Unity

struct World {
    toObject: array<vec4f, 3>,  // engine's world to object, e.g. the inverse of three.js's matrixWorld
    toVoxels: array<vec4f, 3>,  // field's own world to voxels
    axes: i32,                  // of the engine: one of the three constants above
}

fn timesRows(rows: array<vec4f, 3>, v: vec4f) -> vec3f {
    return vec3f(dot(rows[0], v), dot(rows[1], v), dot(rows[2], v));
}

// Convert a vector from the object's axes in the engine to the axes of the field's own world.
fn zUp(axes: i32, v: vec3f) -> vec3f {
    if axes == Y_UP { return vec3f(v.x, -v.z, v.y); }
    if axes == Y_UP_LEFT { return vec3f(v.x, v.z, v.y); }
    return v;
}

// Convert a point of the engine's world to voxels.
fn pointInVoxels(world: World, point: vec3f) -> vec3f {
    return timesRows(world.toVoxels, vec4f(zUp(world.axes, timesRows(world.toObject, vec4f(point, 1.0))), 1.0));
}

// Convert a vector of the engine's world to voxels. march() takes the result as `along`.
fn stepInVoxels(world: World, along: vec3f) -> vec3f {
    return timesRows(world.toVoxels, vec4f(zUp(world.axes, timesRows(world.toObject, vec4f(along, 0.0))), 0.0));
}

// Convert a direction of the engine's world to a unit vector in the field's own axes, as harmonics() takes it.
fn lookInAxes(world: World, along: vec3f) -> vec3f {
    var look = stepInVoxels(world, along);
    for (var i = 0; i < 3; i++) { look[i] /= length(world.toVoxels[i].xyz); }
    return normalize(look);
}
