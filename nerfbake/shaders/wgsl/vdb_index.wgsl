// A VDB tree of a .vdb.npz: find the table row of a voxel through masks and ranks, nearest or trilinear.
// Names are those of the file, without the prefixes `tree_{t}_` and `grid_{g}_`. Paste common.wgsl above this file.
//
//   rootOrigin  3 int32 per upper node: root_origin
//   upper       a pair of uint32 for each of the 1024 words of an upper node: upper_mask and upper_rank, interleaved
//   lower       the same for the 128 words of a lower node
//   leaf        the same for the 16 words of a leaf
//   table       `channels` float32 per row; row 0 is the background
//
// Points are in voxels whose CENTRES are at integers, as in NanoVDB. Tiles are not read; grids that nerfbake makes have
// none.
@group(1) @binding(2) var<storage, read> rootOrigin: array<i32>;
@group(1) @binding(3) var<storage, read> upper: array<vec2u>;
@group(1) @binding(4) var<storage, read> lower: array<vec2u>;
@group(1) @binding(5) var<storage, read> leaf: array<vec2u>;
@group(1) @binding(6) var<storage, read> table: array<f32>;

struct VdbIndex {
    uppers: i32,    // upper nodes
    channels: i32,  // values per row
}

// The child (in a leaf: the table row) of a slot: the word's rank plus the number of set bits below the slot's bit; -1
// if that bit is not set.
fn childOf(word: vec2u, slot: i32) -> i32 {
    let bit = 1u << u32(slot & 31);
    if (word.x & bit) == 0u { return -1; }
    return i32(word.y) + count(word.x & (bit - 1u));
}

// The row of a voxel; 0 if the voxel is not active.
fn vdbRow(index: VdbIndex, voxel: vec3i) -> i32 {
    let tile = voxel & vec3i(~4095);
    var node = -1;
    for (var i = 0; i < index.uppers && node < 0; i++) {
        let origin = vec3i(rootOrigin[3 * i], rootOrigin[3 * i + 1], rootOrigin[3 * i + 2]);
        if all(origin == tile) { node = i; }
    }
    if node < 0 { return 0; }
    var at = (voxel >> vec3u(7)) & vec3i(31);
    var slot = (at.x << 10) | (at.y << 5) | at.z;
    node = childOf(upper[1024 * node + (slot >> 5)], slot);
    if node < 0 { return 0; }
    at = (voxel >> vec3u(3)) & vec3i(15);
    slot = (at.x << 8) | (at.y << 4) | at.z;
    node = childOf(lower[128 * node + (slot >> 5)], slot);
    if node < 0 { return 0; }
    at = voxel & vec3i(7);
    slot = (at.x << 6) | (at.y << 3) | at.z;
    return max(childOf(leaf[16 * node + (slot >> 5)], slot), 0);
}

// Value k of a row.
fn vdbValue(index: VdbIndex, row: i32, k: i32) -> f32 {
    return table[row * index.channels + k];
}

// The row of the voxel that contains a point.
fn vdbNearest(index: VdbIndex, point: vec3f) -> i32 {
    let p = bounded(point);
    let low = floor(p);
    return vdbRow(index, vec3i(low) + vec3i(p - low >= vec3f(0.5)));
}

// The rows of the eight voxels whose centres surround a point, and their weights.
fn vdbCorners(index: VdbIndex, point: vec3f) -> Corners {
    let p = bounded(point);
    let low = floor(p);
    var corners: Corners;
    for (var i = 0; i < 8; i++) {
        corners.row[i] = vdbRow(index, vec3i(low) + sideOf(i));
        corners.weight[i] = weightOf(i, p - low);
    }
    return corners;
}

// Value k at the point, interpolated between its corners.
fn vdbTrilinear(index: VdbIndex, corners: Corners, k: i32) -> f32 {
    var sum = 0.0;
    for (var i = 0; i < 8; i++) { sum += corners.weight[i] * vdbValue(index, corners.row[i], k); }
    return sum;
}
