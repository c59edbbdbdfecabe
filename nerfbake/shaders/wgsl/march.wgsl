// A ray through a PageField, which the pages of `nerfbake view` show: its colour, its depth, and what light is left.
// Behind common.wgsl and harmonics.wgsl. Density and colour are constant in a voxel: sums along the ray are exact.
//
//   top     an int32 for each cell of 8^3 voxels, z fastest: below 0 empty, and so is every cell nearer than minus this
//           number of cells; from 0 the number of a leaf; from 2^30 a row for all of the cell, plus 2^30
//   blocks  four uint32 for each of the eight 4^3 blocks of a leaf: lower and upper half of its mask, the row of its
//           first voxel, and how many bits the lower half has; 255 there: the whole block has that row
//   texels  four float32 each, texelsPerRow in a row: red, green, blue of the first coefficient and the
//           density; then red, green, blue of the second, of the third, ..., without a gap
@group(1) @binding(7) var<storage, read> top: array<i32>;
@group(1) @binding(8) var<storage, read> blocks: array<vec4u>;
@group(1) @binding(9) var<storage, read> texels: array<vec4f>;

struct Field {
    cells: vec3i,       // of `top`, along x, y, z
    low: vec3f,         // the box around all that is not empty, in voxels
    high: vec3f,
    texelsPerRow: i32,  // 1 + 3 ceil((size of the basis - 1) / 4)
    densityUnit: f32,   // densities are multiples of this, in 1/world unit; divide it by the scale of a scaled object
}

// Voxels that are alike: a row, or -1 where they are empty, and the lowest corner and the edge of their cube.
struct Cube {
    row: i32,
    corner: vec3i,
    edge: i32,
}

struct Marched {
    colour: vec3f,       // what the field adds to a picture, times its opacity
    transmittance: f32,  // the share of what is behind that is added to it
    depth: f32,          // E[d]: where the ray is expected to end, from its origin, in world units; 0 where nothing is
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
    let i = voxel & vec3i(3);
    let upper = i.x > 1;
    let mask = select(block.x, block.y, upper);
    let bit = 1u << u32(((i.x & 1) << 4) | (i.y << 2) | i.z);
    if (mask & bit) == 0u { return Cube(-1, voxel, 1); }
    return Cube(i32(block.z) + select(0, i32(block.w), upper) + count(mask & (bit - 1u)), voxel, 1);
}

// The colour of a row in the direction that the harmonics are of.
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

// origin: in voxels. along: how many voxels a step of one world unit is (stepInVoxels() of a unit vector). basis: the
// harmonics in that direction. stop: no light from farther away, in world units: of a Z-buffer, say. cut: the ray ends
// where less light is left.
fn march(field: Field, origin: vec3f, along: vec3f, basis: Harmonics, stop: f32, cut: f32) -> Marched {
    var found = Marched(vec3f(0.0), 1.0, 0.0);
    // Parallel to an axis: a hair's breadth beside it, so that nothing is divided by 0.
    let d = select(along, vec3f(1e-12), abs(along) < vec3f(1e-12));
    let one = (field.low - origin) / d;
    let other = (field.high - origin) / d;
    let near = min(one, other);
    let away = max(one, other);
    let start = max(max(near.x, near.y), max(near.z, 0.0));
    let end = min(min(away.x, away.y), min(away.z, stop)) - start;
    // Distances count from where the ray enters the box: they stay small, and exact.
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
        // The voxel behind is found by number and not by a small step: rounding can neither hold a ray up nor skip one.
        let axis = select(select(2, 1, exits.y <= exits.z), 0, exits.x <= exits.y && exits.x <= exits.z);
        voxel = clamp(vec3i(floor(entry + t * d)), max(cube.corner, low), min(cube.corner + cube.edge - 1, high));
        voxel[axis] = select(cube.corner[axis] - 1, cube.corner[axis] + cube.edge, d[axis] > 0.0);
        if voxel[axis] < low[axis] || voxel[axis] > high[axis] { break; }
    }
    found.depth /= max(1.0 - found.transmittance, 1e-30);
    return found;
}

// What is drawn of it in a cutout queue: an opaque colour where less light than `cut` is left, else nothing, alpha 0.
// The same `cut` can end the ray.
fn cutout(found: Marched, cut: f32) -> vec4f {
    if found.transmittance >= cut { return vec4f(0.0); }
    return vec4f(found.colour / (1.0 - found.transmittance), 1.0);
}
