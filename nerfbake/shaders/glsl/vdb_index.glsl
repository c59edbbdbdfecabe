// A VDB tree of a .vdb.npz: find the table row of a voxel through masks and ranks, nearest or trilinear.
// Names are those of the file, without the prefixes `tree_{t}_` and `grid_{g}_`.
//
//   rootOrigin  3 int32 per upper node: root_origin
//   upper       a pair of uint32 for each of the 1024 words of an upper node: upper_mask and upper_rank, interleaved
//   lower       the same for the 128 words of a lower node
//   leaf        the same for the 16 words of a leaf
//   table       `channels` float32 per row; row 0 is the background
//
// Points are in voxels whose CENTRES are at integers, as in NanoVDB. Tiles are not read; grids that nerfbake makes have
// none.
#ifndef NERFBAKE_VDB_INDEX_GLSL
#define NERFBAKE_VDB_INDEX_GLSL
#include "common.glsl"

uniform isampler2D rootOrigin;
uniform usampler2D upper;
uniform usampler2D lower;
uniform usampler2D leaf;
uniform sampler2D table;

struct VdbIndex {
    int uppers;    // upper nodes
    int channels;  // values per row
};

// The child (in a leaf: the table row) of a slot: the word's rank plus the number of set bits below the slot's bit; -1
// if that bit is not set.
int childOf(uvec2 word, int slot) {
    uint bit = 1u << uint(slot & 31);
    return (word.x & bit) == 0u ? -1 : int(word.y) + count(word.x & (bit - 1u));
}

// The row of a voxel; 0 if the voxel is not active.
int vdbRow(VdbIndex index, ivec3 voxel) {
    ivec3 tile = voxel & ~4095;
    int node = -1;
    for (int i = 0; i < index.uppers && node < 0; i++) {
        ivec3 origin;
        for (int axis = 0; axis < 3; axis++) origin[axis] = fetchInt(rootOrigin, 3 * i + axis);
        if (origin == tile) node = i;
    }
    if (node < 0) return 0;
    ivec3 at = voxel >> 7 & 31;
    int slot = at.x << 10 | at.y << 5 | at.z;
    node = childOf(fetchUint2(upper, 1024 * node + (slot >> 5)), slot);
    if (node < 0) return 0;
    at = voxel >> 3 & 15;
    slot = at.x << 8 | at.y << 4 | at.z;
    node = childOf(fetchUint2(lower, 128 * node + (slot >> 5)), slot);
    if (node < 0) return 0;
    at = voxel & 7;
    slot = at.x << 6 | at.y << 3 | at.z;
    return max(childOf(fetchUint2(leaf, 16 * node + (slot >> 5)), slot), 0);
}

// Value k of a row.
float vdbValue(VdbIndex index, int row, int k) {
    return fetchFloat(table, row * index.channels + k);
}

// The row of the voxel that contains a point.
int vdbNearest(VdbIndex index, vec3 point) {
    vec3 p = bounded(point), low = floor(p);
    return vdbRow(index, ivec3(low) + ivec3(greaterThanEqual(p - low, vec3(0.5))));
}

// The rows of the eight voxels whose centres surround a point, and their weights.
Corners vdbCorners(VdbIndex index, vec3 point) {
    vec3 p = bounded(point), low = floor(p);
    Corners corners;
    for (int i = 0; i < 8; i++) {
        corners.row[i] = vdbRow(index, ivec3(low) + sideOf(i));
        corners.weight[i] = weightOf(i, p - low);
    }
    return corners;
}

// Value k at the point, interpolated between its corners.
float vdbTrilinear(VdbIndex index, Corners corners, int k) {
    float sum = 0.0;
    for (int i = 0; i < 8; i++) sum += corners.weight[i] * vdbValue(index, corners.row[i], k);
    return sum;
}
#endif  // NERFBAKE_VDB_INDEX_GLSL
