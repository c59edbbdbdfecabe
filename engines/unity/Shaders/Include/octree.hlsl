// The sparse voxel octree of a .svo.* file: find the leaf of a voxel, and read its values, nearest or trilinear.
// The struct is listing 2 of TR-24-01 (docs/sources.md), except that its two buffers are globals: not every compiler
// accepts buffers in a struct.
//
//   nodeChildren  8 int32 per node: the numbers of its children, 0 or -1 for no child. Child x + 2 y + 4 z; 1 is the
//                 upper half. EVERY node needs 8 entries: pad the array of a file in the compact layout with zeros
//   nodeData      dataDim float32 per node: all coefficients of red, of green, of blue, then the density in 1/world
//                 unit
//
// Points are in voxels: voxel (0, 0, 0) extends from 0 to 1 along each axis. world.hlsl converts points to voxels.
#ifndef NERFBAKE_OCTREE_HLSL
#define NERFBAKE_OCTREE_HLSL
#include "common.hlsl"

StructuredBuffer<int> nodeChildren;
StructuredBuffer<float> nodeData;

struct SparseVoxelOctree {
    int width;     // voxels along x
    int height;    // along y
    int depth;     // along z
    int dataDim;   // values per node
    int maxLevel;  // levels below the root: the smallest number with 2^maxLevel >= width, height and depth
};

bool isLeaf(int node) {
    for (int i = 0; i < 8; i++) {
        if (nodeChildren[8 * node + i] > 0) return false;
    }
    return true;
}

// The leaf that contains a voxel; -1 in empty space and outside the grid.
int octreeRow(SparseVoxelOctree octree, int3 voxel) {
    int3 size = int3(octree.width, octree.height, octree.depth);
    if (any(voxel < 0) || any(voxel >= size)) return -1;
    int node = 0, child = 0;
    for (int shift = octree.maxLevel - 1; shift >= 0; shift--) {
        int3 side = voxel >> shift & 1;
        child = nodeChildren[8 * node + side.x + 2 * side.y + 4 * side.z];
        if (child <= 0) break;
        node = child;
    }
    return child > 0 || isLeaf(node) ? node : -1;
}

// Value k of a node; 0 for node -1.
float octreeValue(SparseVoxelOctree octree, int row, int k) {
    if (row < 0) return 0.0;
    return nodeData[row * octree.dataDim + k];
}

// The leaf that contains a point, or -1.
int octreeNearest(SparseVoxelOctree octree, float3 p) {
    return octreeRow(octree, int3(floor(bounded(p))));
}

// The leaves of the eight voxels whose centres surround a point, and their weights.
Corners octreeCorners(SparseVoxelOctree octree, float3 p) {
    float3 shifted = bounded(p - 0.5), low = floor(shifted);
    Corners corners;
    for (int i = 0; i < 8; i++) {
        corners.row[i] = octreeRow(octree, int3(low) + sideOf(i));
        corners.weight[i] = weightOf(i, shifted - low);
    }
    return corners;
}

// Value k at the point, interpolated between its corners.
float octreeTrilinear(SparseVoxelOctree octree, Corners corners, int k) {
    float sum = 0.0;
    for (int i = 0; i < 8; i++) sum += corners.weight[i] * octreeValue(octree, corners.row[i], k);
    return sum;
}
#endif  // NERFBAKE_OCTREE_HLSL
