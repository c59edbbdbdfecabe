// The sparse voxel octree of a .svo.* file: find the leaf of a voxel, and read its values, nearest or trilinear. The
// struct is listing 2 of TR-24-01 (docs/sources.md), except that its two buffers are globals. Paste common.wgsl above
// this file.
//
//   nodeChildren  8 int32 per node: the numbers of its children, 0 or -1 for no child. Child x + 2 y + 4 z; 1 is the
//                 upper half. EVERY node needs 8 entries: pad the array of a file in the compact layout with zeros
//   nodeData      dataDim float32 per node: all coefficients of red, of green, of blue, then the density in 1/world
//                 unit
//
// Points are in voxels: voxel (0, 0, 0) extends from 0 to 1 along each axis. world.wgsl converts points to voxels.
@group(1) @binding(0) var<storage, read> nodeChildren: array<i32>;
@group(1) @binding(1) var<storage, read> nodeData: array<f32>;

struct SparseVoxelOctree {
    width: i32,     // voxels along x
    height: i32,    // along y
    depth: i32,     // along z
    dataDim: i32,   // values per node
    maxLevel: i32,  // levels below the root: the smallest number with 2^maxLevel >= width, height and depth
}

fn isLeaf(node: i32) -> bool {
    for (var i = 0; i < 8; i++) {
        if nodeChildren[8 * node + i] > 0 { return false; }
    }
    return true;
}

// The leaf that contains a voxel; -1 in empty space and outside the grid.
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

// Value k of a node; 0 for node -1.
fn octreeValue(octree: SparseVoxelOctree, row: i32, k: i32) -> f32 {
    if row < 0 { return 0.0; }
    return nodeData[row * octree.dataDim + k];
}

// The leaf that contains a point, or -1.
fn octreeNearest(octree: SparseVoxelOctree, point: vec3f) -> i32 {
    return octreeRow(octree, vec3i(floor(bounded(point))));
}

// The leaves of the eight voxels whose centres surround a point, and their weights.
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

// Value k at the point, interpolated between its corners.
fn octreeTrilinear(octree: SparseVoxelOctree, corners: Corners, k: i32) -> f32 {
    var sum = 0.0;
    for (var i = 0; i < 8; i++) { sum += corners.weight[i] * octreeValue(octree, corners.row[i], k); }
    return sum;
}
