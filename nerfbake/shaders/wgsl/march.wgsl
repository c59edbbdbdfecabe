// March a ray through a PageField, the field in the pages of `nerfbake view`: colour, transmittance and depth.
// Density and colour are constant within a voxel, so sums along the ray are exact. Paste common.wgsl and harmonics.wgsl
// above this file.
//
//   top     an int32 per cell of 8^3 voxels, z fastest. Negative: the cell is empty, and so is every cell closer than
//           -top cells along all three axes. From 0: the number of a leaf. From 2^30: the whole cell has row top - 2^30
//   blocks  four uint32 for each of the eight 4^3 blocks of a leaf: lower and upper half of its mask, the row of its
//           first voxel, and the number of bits set in the lower half; 255 there: the whole block has that row. Bit
//           8 + 4 x + 2 y + z there: this octant of 2^3 voxels has one row, and one bit in the mask, its lowest voxel's
//   texels  four float32 each, texelsPerRow per row: red, green, blue of the first coefficient and the density; then
//           red, green, blue of the second, of the third, ..., without gaps
@group(1) @binding(7) var<storage, read> top: array<i32>;
@group(1) @binding(8) var<storage, read> blocks: array<vec4u>;
@group(1) @binding(9) var<storage, read> texels: array<vec4f>;

struct Field {
    cells: vec3i,       // size of `top` along x, y, z
    low: vec3f,         // the box around everything that is not empty, in voxels
    high: vec3f,
    texelsPerRow: i32,  // 1 + 3 ceil((basis functions - 1) / 4)
    densityUnit: f32,   // densities are multiples of this, in 1/world unit; divide it by the scale of the object
}

// A cube of voxels with the same contents: their row (-1: empty), and the cube's lowest corner and edge.
struct Cube {
    row: i32,
    corner: vec3i,
    edge: i32,
}

struct Marched {
    colour: vec3f,       // premultiplied by the field's opacity
    transmittance: f32,  // the share of the light from behind the field that remains
    depth: f32,          // E[d]: expected distance from the origin to the ray's end, in world units; 0 for no hit
}

fn cubeAt(field: Field, voxel: vec3i) -> Cube {
    let cell = voxel >> vec3u(3);
    let here = top[(cell.x * field.cells.y + cell.y) * field.cells.z + cell.z];
    if here < 0 { return Cube(-1, (cell + here + 1) << vec3u(3), 8 * (-2 * here - 1)); }
    if here >= 1 << 30 { return Cube(here - (1 << 30), cell << vec3u(3), 8); }
    let part = (voxel >> vec3u(2)) & vec3i(1);
    let block = blocks[8 * here + 4 * part.x + 2 * part.y + part.z];
    if (block.x | block.y) == 0u { return Cube(-1, voxel & vec3i(~3), 4); }
    if block.w == 255u { return Cube(i32(block.z), voxel & vec3i(~3), 4); }
    var i = voxel & vec3i(3);
    let edge = 1 + i32((block.w >> u32(8 + ((2 * (i.x & 2)) | (i.y & 2) | (i.z >> 1)))) & 1u);
    i &= vec3i(4 - edge);
    let upper = i.x > 1;
    let mask = select(block.x, block.y, upper);
    let bit = 1u << u32(((i.x & 1) << 4) | (i.y << 2) | i.z);
    if (mask & bit) == 0u { return Cube(-1, voxel, 1); }
    let before = select(0, i32(block.w & 255u), upper) + count(mask & (bit - 1u));
    return Cube(i32(block.z) + before, voxel & vec3i(-edge), edge);
}

// The colour of a row in the direction of `basis`. first: red, green and blue of the row's first coefficient.
fn colourOf(field: Field, row: i32, first: vec3f, basis: Harmonics) -> vec3f {
    var h = basis;
    var sum = h.f[0] * first;
    for (var i = 1; i < field.texelsPerRow; i += 3) {
        let at = field.texelsPerRow * row + i;
        let k = (4 * i - 1) / 3;
        let a = texels[at];
        let b = texels[at + 1];
        let c = texels[at + 2];
        sum += h.f[k] * a.rgb + h.f[k + 1] * vec3f(a.a, b.rg);
        sum += h.f[k + 2] * vec3f(b.ba, c.r) + h.f[k + 3] * c.gba;
    }
    return sigmoid(sum);
}

// origin: in voxels. along: the direction in voxels per world unit, stepInVoxels() of a unit vector. basis: harmonics()
// in that direction. stop: distance at which the ray ends, in world units, for example from a depth buffer. cut: the
// ray also ends when its transmittance is below this value.
fn march(field: Field, origin: vec3f, along: vec3f, basis: Harmonics, stop: f32, cut: f32) -> Marched {
    var found = Marched(vec3f(0.0), 1.0, 0.0);
    // Replace components near 0 (rays parallel to an axis), to avoid a division by 0.
    let d = select(along, vec3f(1e-12), abs(along) < vec3f(1e-12));
    let one = (field.low - origin) / d;
    let other = (field.high - origin) / d;
    let near = min(one, other);
    let away = max(one, other);
    let start = max(max(near.x, near.y), max(near.z, 0.0));
    let end = min(min(away.x, away.y), min(away.z, stop)) - start;
    // Distances count from the point where the ray enters the box, so they stay small and exact.
    let entry = origin + start * d;
    let upward = select(vec3f(0.0), vec3f(1.0), d > vec3f(0.0));
    let low = vec3i(floor(field.low));
    let high = vec3i(ceil(field.high)) - 1;
    var voxel = clamp(vec3i(floor(entry)), low, high);
    var t = 0.0;
    for (var i = 0; i < 16384 && t < end && found.transmittance >= cut; i++) {
        let cube = cubeAt(field, voxel);
        let exits = (vec3f(cube.corner) + upward * f32(cube.edge) - entry) / d;
        let next = max(min(exits.x, min(exits.y, exits.z)), t);
        if cube.row >= 0 {
            let first = texels[field.texelsPerRow * cube.row];
            let sigma = first.a * field.densityUnit;
            let thick = sigma * (min(next, end) - t);
            let kept = exp(-thick);
            let weight = found.transmittance * (1.0 - kept);
            found.colour += weight * colourOf(field, cube.row, first.rgb, basis);
            found.depth += weight * (start + t);
            found.depth += found.transmittance * (1.0 - kept - thick * kept) / max(sigma, 1e-30);
            found.transmittance *= kept;
        }
        t = next;
        // The next voxel is computed by index. A small step instead could stall the ray or skip a voxel by rounding.
        let axis = select(select(2, 1, exits.y <= exits.z), 0, exits.x <= exits.y && exits.x <= exits.z);
        voxel = clamp(vec3i(floor(entry + t * d)), max(cube.corner, low), min(cube.corner + cube.edge - 1, high));
        voxel[axis] = select(cube.corner[axis] - 1, cube.corner[axis] + cube.edge, d[axis] > 0.0);
        if voxel[axis] < low[axis] || voxel[axis] > high[axis] { break; }
    }
    found.depth /= max(1.0 - found.transmittance, 1e-30);
    return found;
}

// The colour for a cutout queue: opaque if the transmittance is below `cut`, else nothing (alpha 0). You can pass the
// same `cut` to march().
fn cutout(found: Marched, cut: f32) -> vec4f {
    if found.transmittance >= cut { return vec4f(0.0); }
    return vec4f(found.colour / (1.0 - found.transmittance), 1.0);
}
