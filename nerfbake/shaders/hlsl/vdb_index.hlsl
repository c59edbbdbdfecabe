// A VDB tree of a .vdb.npz: masks and ranks lead from a voxel to its row of a table, nearest or trilinear.
// Names are those of the file, without `tree_{t}_` and `grid_{g}_`.
//
//   rootOrigin  3 int32 an upper node: root_origin
//   upper       a pair of uint32 for each of an upper node's 1024 words: upper_mask and upper_rank beside each other
//   lower       the same of a lower node's 128 words
//   leaf        the same of a leaf's 16 words
//   table       `channels` float32 a row; row 0 is the background
//
// Points are in voxels whose CENTRES are whole numbers, as NanoVDB's are. Tiles, which no grid of nerfbake's own has,
// are not read.
#ifndef NERFBAKE_VDB_INDEX_HLSL
#define NERFBAKE_VDB_INDEX_HLSL
#include "common.hlsl"

StructuredBuffer<int> rootOrigin;
StructuredBuffer<uint2> upper;
StructuredBuffer<uint2> lower;
StructuredBuffer<uint2> leaf;
StructuredBuffer<float> table;

struct VdbIndex {
    int uppers;    // upper nodes
    int channels;  // numbers a row
};

// What a slot leads to: -1 where its bit is not set, else the word's rank and how many bits are below.
int childOf(uint2 word, int slot) {
    uint bit = 1u << uint(slot & 31);
    return (word.x & bit) == 0u ? -1 : int(word.y) + count(word.x & (bit - 1u));
}

// The row of a voxel; 0 where it is not active.
int vdbRow(VdbIndex index, int3 voxel) {
    int3 tile = voxel & ~4095;
    int node = -1;
    for (int i = 0; i < index.uppers && node < 0; i++) {
        int3 origin = int3(rootOrigin[3 * i], rootOrigin[3 * i + 1], rootOrigin[3 * i + 2]);
        if (all(origin == tile)) node = i;
    }
    if (node < 0) return 0;
    int3 at = voxel >> 7 & 31;
    int slot = at.x << 10 | at.y << 5 | at.z;
    node = childOf(upper[1024 * node + (slot >> 5)], slot);
    if (node < 0) return 0;
    at = voxel >> 3 & 15;
    slot = at.x << 8 | at.y << 4 | at.z;
    node = childOf(lower[128 * node + (slot >> 5)], slot);
    if (node < 0) return 0;
    at = voxel & 7;
    slot = at.x << 6 | at.y << 3 | at.z;
    return max(childOf(leaf[16 * node + (slot >> 5)], slot), 0);
}

// Number k of a row.
float vdbValue(VdbIndex index, int row, int k) {
    return table[row * index.channels + k];
}

// The row of the voxel that holds a point.
int vdbNearest(VdbIndex index, float3 p) {
    p = bounded(p);
    float3 low = floor(p);
    return vdbRow(index, int3(low) + int3(p - low >= 0.5));
}

// The rows of the eight voxels whose centres are around a point.
Corners vdbCorners(VdbIndex index, float3 p) {
    p = bounded(p);
    float3 low = floor(p);
    Corners corners;
    for (int i = 0; i < 8; i++) {
        corners.row[i] = vdbRow(index, int3(low) + sideOf(i));
        corners.weight[i] = weightOf(i, p - low);
    }
    return corners;
}

// Number k of the values at a point between them.
float vdbTrilinear(VdbIndex index, Corners corners, int k) {
    float sum = 0.0;
    for (int i = 0; i < 8; i++) sum += corners.weight[i] * vdbValue(index, corners.row[i], k);
    return sum;
}
#endif  // NERFBAKE_VDB_INDEX_HLSL
