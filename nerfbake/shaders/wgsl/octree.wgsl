// The sparse voxel octree of a .svo.* file: the way down to a voxel, and its values, nearest or trilinear.
// Behind common.wgsl. The struct is that of TR-24-01 (docs/sources.md), listing 2, but for its two buffers, which stand
// beside it.
//
//   nodeChildren  8 int32 a node, the numbers of its children, 0 or -1 where there is none; child x + 2 y + 4 z, where
//                 1 is the upper half. For EVERY node: of a file in the compact layout with zeros behind its own
//   nodeData      dataDim float32 a node: all coefficients of red, of green, of blue, then the density, 1/world unit
//
// Points are in voxels: voxel (0, 0, 0) reaches from 0 to 1 along each axis. world.wgsl leads there.
@group(1) @binding(0) var<storage, read> nodeChildren: array<i32>;
@group(1) @binding(1) var<storage, read> nodeData: array<f32>;

struct SparseVoxelOctree {
    width: i32,     // voxels along x
    height: i32,    // along y
    depth: i32,     // along z
    dataDim: i32,   // numbers a node
    maxLevel: i32,  // levels below the root: the smallest for which 2^maxLevel is no less than width, height and depth
}

fn isLeaf(node: i32) -> bool {
    for (var i = 0; i < 8; i++) {
        if nodeChildren[8 * node + i] > 0 { return false; }
    }
    return true;
}

// The node whose values a voxel has; -1: space is empty there, or outside.
fn octreeRow(octree: SparseVoxelOctree, voxel: vec3i) -> i32 {
    let size = vec3i(octree.width, octree.height, octree.depth);
    if any(voxel < vec3i(0)) || any(voxel >= size) { return -1; }
    var node = 0;
    var child = 0;
    for (var shift = octree.maxLevel - 1; shift >= 0; shift--) {
        let side = (voxel >> vec3u(u32(shift))) & vec3i(1);
        child = nodeChildren[8 * node + side.x + 2 * side.y + 4 * side.z];
        if child <= 0 { break; }
        node = child;
    }
    return select(-1, node, child > 0 || isLeaf(node));
}

// Number k of a node's values; 0 for node -1.
fn octreeValue(octree: SparseVoxelOctree, row: i32, k: i32) -> f32 {
    if row < 0 { return 0.0; }
    return nodeData[row * octree.dataDim + k];
}

// The node of the voxel that holds a point, or -1.
fn octreeNearest(octree: SparseVoxelOctree, point: vec3f) -> i32 {
    return octreeRow(octree, vec3i(floor(bounded(point))));
}

// The nodes of the eight voxels whose centres are around a point.
fn octreeCorners(octree: SparseVoxelOctree, point: vec3f) -> Corners {
    let shifted = bounded(point - 0.5);
    let low = floor(shifted);
    var corners: Corners;
    for (var i = 0; i < 8; i++) {
        corners.row[i] = octreeRow(octree, vec3i(low) + sideOf(i));
        corners.weight[i] = weightOf(i, shifted - low);
    }
    return corners;
}

// Number k of the values at a point between them.
fn octreeTrilinear(octree: SparseVoxelOctree, corners: Corners, k: i32) -> f32 {
    var sum = 0.0;
    for (var i = 0; i < 8; i++) { sum += corners.weight[i] * octreeValue(octree, corners.row[i], k); }
    return sum;
}
