// What the other files need, and stands before them: the bits of a word, the eight voxels around a point.
// WGSL. A buffer of int32 is an array<i32>, pairs of uint32 are an array<vec2u>, and four of float32 an array<vec4f>;
// float16 is widened before it is uploaded. All buffers are in group 1, each at a binding of its own: change both freely.

// How many bits of a word are set.
fn count(bits: u32) -> i32 {
    return i32(countOneBits(bits));
}

const FAR: f32 = 1e9;  // voxels; what is farther away is taken for this, as a whole number ends at 2^31

fn bounded(point: vec3f) -> vec3f {
    return clamp(point, vec3f(-FAR), vec3f(FAR));
}

// The eight voxels around a point: rows of a buffer, and their trilinear weights. Number 4 x + 2 y + z is at x, y, z,
// where 1 is the upper one.
struct Corners {
    row: array<i32, 8>,
    weight: array<f32, 8>,
}

fn sideOf(i: i32) -> vec3i {
    return vec3i(i >> 2, (i >> 1) & 1, i & 1);
}

// f: how far the point is beyond the lowest of the eight, 0 to 1.
fn weightOf(i: i32, f: vec3f) -> f32 {
    let weights = mix(1.0 - f, f, vec3f(sideOf(i)));
    return weights.x * weights.y * weights.z;
}
