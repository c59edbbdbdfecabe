// The sparse voxel octree of a .svo.* file: the way down to a voxel, and its values, nearest or trilinear.
// The struct is that of TR-24-01 (docs/sources.md), listing 2; its two buffers stand beside it, because not every
// compiler takes buffers in a struct.
//
//   nodeChildren  8 int32 a node, the numbers of its children, 0 or -1 where there is none; child x + 2 y + 4 z, where
//                 1 is the upper half. For EVERY node: of a file in the compact layout with zeros behind its own
//   nodeData      dataDim float32 a node: all coefficients of red, of green, of blue, then the density, 1/world unit
//
// Points are in voxels: voxel (0, 0, 0) reaches from 0 to 1 along each axis. world.hlsl leads there.
#ifndef NERFBAKE_OCTREE_HLSL
#define NERFBAKE_OCTREE_HLSL
#include "common.hlsl"

StructuredBuffer<int> nodeChildren;
StructuredBuffer<float> nodeData;

struct SparseVoxelOctree {
    int width;     // voxels along x
    int height;    // along y
    int depth;     // along z
    int dataDim;   // numbers a node
    int maxLevel;  // levels below the root: the smallest for which 2^maxLevel is no less than width, height and depth
};

bool isLeaf(int node) {
    for (int i = 0; i < 8; i++) {
        if (nodeChildren[8 * node + i] > 0) return false;
    }
    return true;
}

// The node whose values a voxel has; -1: space is empty there, or outside.
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

// Number k of a node's values; 0 for node -1.
float octreeValue(SparseVoxelOctree octree, int row, int k) {
    if (row < 0) return 0.0;
    return nodeData[row * octree.dataDim + k];
}

// The node of the voxel that holds a point, or -1.
int octreeNearest(SparseVoxelOctree octree, float3 p) {
    return octreeRow(octree, int3(floor(bounded(p))));
}

// The nodes of the eight voxels whose centres are around a point.
Corners octreeCorners(SparseVoxelOctree octree, float3 p) {
    float3 shifted = bounded(p - 0.5), low = floor(shifted);
    Corners corners;
    for (int i = 0; i < 8; i++) {
        corners.row[i] = octreeRow(octree, int3(low) + sideOf(i));
        corners.weight[i] = weightOf(i, shifted - low);
    }
    return corners;
}

// Number k of the values at a point between them.
float octreeTrilinear(SparseVoxelOctree octree, Corners corners, int k) {
    float sum = 0.0;
    for (int i = 0; i < 8; i++) sum += corners.weight[i] * octreeValue(octree, corners.row[i], k);
    return sum;
}
#endif  // NERFBAKE_OCTREE_HLSL
