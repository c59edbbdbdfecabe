// From an engine's world to a field: points to voxels, and looks to the field's own axes, in which its spherical
// harmonics are: asked there, they turn with the object. WGSL; no buffers.
//
// Three rows of a 3 x 4 matrix are vec4s, so that it does not matter whether an engine counts rows or columns first.
const Z_UP = 0;       // right-handed, z up: Blender, and the fields themselves
const Y_UP = 1;       // right-handed, y up: glTF, three.js
const Y_UP_LEFT = 2;  // left-handed, y up: Unity

struct World {
    toObject: array<vec4f, 3>,  // the engine's world to the object, e.g. the inverse of three.js's matrixWorld
    toVoxels: array<vec4f, 3>,  // what the field's own world is in voxels
    axes: i32,                  // those of the engine: one of the three above
}

fn timesRows(rows: array<vec4f, 3>, v: vec4f) -> vec3f {
    return vec3f(dot(rows[0], v), dot(rows[1], v), dot(rows[2], v));
}

// A vector in the object's axes, as the engine has them, in those of the field's own world.
fn zUp(axes: i32, v: vec3f) -> vec3f {
    if axes == Y_UP { return vec3f(v.x, -v.z, v.y); }
    if axes == Y_UP_LEFT { return vec3f(v.x, v.z, v.y); }
    return v;
}

// A point of the engine's world, in voxels.
fn pointInVoxels(world: World, point: vec3f) -> vec3f {
    return timesRows(world.toVoxels, vec4f(zUp(world.axes, timesRows(world.toObject, vec4f(point, 1.0))), 1.0));
}

// How many voxels a step in the engine's world is: what march() takes as its direction.
fn stepInVoxels(world: World, along: vec3f) -> vec3f {
    return timesRows(world.toVoxels, vec4f(zUp(world.axes, timesRows(world.toObject, vec4f(along, 0.0))), 0.0));
}

// A look along a step in the engine's world, of length 1, in the field's own axes: what harmonics() takes.
fn lookInAxes(world: World, along: vec3f) -> vec3f {
    var look = stepInVoxels(world, along);
    for (var i = 0; i < 3; i++) { look[i] /= length(world.toVoxels[i].xyz); }
    return normalize(look);
}
