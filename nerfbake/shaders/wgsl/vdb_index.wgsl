// A VDB tree of a .vdb.npz: masks and ranks lead from a voxel to its row of a table, nearest or trilinear.
// Behind common.wgsl. Names are those of the file, without `tree_{t}_` and `grid_{g}_`.
//
//   rootOrigin  3 int32 an upper node: root_origin
//   upper       a pair of uint32 for each of an upper node's 1024 words: upper_mask and upper_rank beside each other
//   lower       the same of a lower node's 128 words
//   leaf        the same of a leaf's 16 words
//   table       `channels` float32 a row; row 0 is the background
//
// Points are in voxels whose CENTRES are whole numbers, as NanoVDB's are. Tiles, which no grid of nerfbake's own has,
// are not read.
@group(1) @binding(2) var<storage, read> rootOrigin: array<i32>;
@group(1) @binding(3) var<storage, read> upper: array<vec2u>;
@group(1) @binding(4) var<storage, read> lower: array<vec2u>;
@group(1) @binding(5) var<storage, read> leaf: array<vec2u>;
@group(1) @binding(6) var<storage, read> table: array<f32>;

struct VdbIndex {
    uppers: i32,    // upper nodes
    channels: i32,  // numbers a row
}

// What a slot leads to: -1 where its bit is not set, else the word's rank and how many bits are below.
fn childOf(word: vec2u, slot: i32) -> i32 {
    let bit = 1u << u32(slot & 31);
    if (word.x & bit) == 0u { return -1; }
    return i32(word.y) + count(word.x & (bit - 1u));
}

// The row of a voxel; 0 where it is not active.
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

// Number k of a row.
fn vdbValue(index: VdbIndex, row: i32, k: i32) -> f32 {
    return table[row * index.channels + k];
}

// The row of the voxel that holds a point.
fn vdbNearest(index: VdbIndex, point: vec3f) -> i32 {
    let p = bounded(point);
    let low = floor(p);
    return vdbRow(index, vec3i(low) + vec3i(p - low >= vec3f(0.5)));
}

// The rows of the eight voxels whose centres are around a point.
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

// Number k of the values at a point between them.
fn vdbTrilinear(index: VdbIndex, corners: Corners, k: i32) -> f32 {
    var sum = 0.0;
    for (var i = 0; i < 8; i++) { sum += corners.weight[i] * vdbValue(index, corners.row[i], k); }
    return sum;
}
