// Shared by the other files: bit counts, the eight voxels around a point. WGSL. Paste this file above the others.
//
// A buffer of int32 is an array<i32>, pairs of uint32 are an array<vec2u>, and groups of four float32 are an
// array<vec4f>. Convert float16 to float32 before you upload it. All buffers are in group 1, each with its own binding
// number. You can change both.

// The number of bits that are set in a word.
fn count(bits: u32) -> i32 {
    return i32(countOneBits(bits));
}

const FAR: f32 = 1e9;  // voxels; coordinates are clamped to this, because an int32 ends at 2^31

fn bounded(point: vec3f) -> vec3f {
    return clamp(point, vec3f(-FAR), vec3f(FAR));
}

// The eight voxels around a point: their rows in a buffer, and their trilinear weights. Entry 4 x + 2 y + z is the
// voxel at offset (x, y, z) from the lowest of the eight; each offset is 0 or 1.
struct Corners {
    row: array<i32, 8>,
    weight: array<f32, 8>,
}

fn sideOf(i: i32) -> vec3i {
    return vec3i(i >> 2, (i >> 1) & 1, i & 1);
}

// The trilinear weight of voxel i. f: offset of the point from the centre of the lowest of the eight voxels, 0 to 1.
fn weightOf(i: i32, f: vec3f) -> f32 {
    let weights = mix(1.0 - f, f, vec3f(sideOf(i)));
    return weights.x * weights.y * weights.z;
}
