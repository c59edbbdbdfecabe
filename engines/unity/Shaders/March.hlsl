// A ray through the octree of Include/octree.hlsl, as TR-24-01 (docs/sources.md) has it in 3.4: its colour, the light
// that is left, and where it is expected to end. Behind Include/common.hlsl, octree.hlsl and harmonics.hlsl; knows
// nothing of Unity.
// Density and colour are constant in a leaf, so that sums along the ray are exact; what is empty is crossed in one step.

// Voxels that are alike: a node, or -1 where they are empty, and the lowest corner and the edge of their cube.
struct OctreeCube {
    int row;
    int3 corner;
    int edge;
};

struct OctreeRay {
    float3 colour;        // what the field adds to a picture, times its opacity
    float transmittance;  // the share of what is behind that is added to it
    float depth;          // E[d]: where the ray is expected to end, in steps from its origin; 0 where nothing is
};

OctreeCube octreeCube(SparseVoxelOctree octree, int3 voxel) {
    OctreeCube cube;
    int node = 0, shift = octree.maxLevel;
    while (shift > 0) {
        int3 side = voxel >> (shift - 1) & 1;
        int child = nodeChildren[8 * node + side.x + 2 * side.y + 4 * side.z];
        if (child <= 0) break;
        node = child;
        shift--;
    }
    bool leaf = shift == 0 || isLeaf(node);
    cube.row = leaf ? node : -1;
    if (!leaf) shift--;
    cube.corner = voxel >> shift << shift;
    cube.edge = 1 << shift;
    return cube;
}

// size: functions a colour; 0: RGBA, which has none.
Harmonics octreeBasis(float3 direction, int size) {
    Harmonics basis = harmonics(direction, size);
    if (size == 0) basis.f[0] = 1.0;
    return basis;
}

float3 octreeColour(SparseVoxelOctree octree, int row, Harmonics basis) {
    int size = (octree.dataDim - 1) / 3, at = row * octree.dataDim;
    float3 sum = float3(0.0, 0.0, 0.0);
    for (int k = 0; k < size; k++) {
        sum += basis.f[k] * float3(nodeData[at + k], nodeData[at + size + k], nodeData[at + 2 * size + k]);
    }
    return sigmoid(sum);
}

// origin: in voxels. along: how many voxels a step is, and unit: how many of the field's world units. basis: in that
// direction. stop: no light from farther away, in steps: of a Z-buffer, say. cut: the ray ends where less light is left.
OctreeRay marchOctree(SparseVoxelOctree octree, float3 origin, float3 along, float unit, Harmonics basis, float stop, float cut) {
    OctreeRay found;
    found.colour = float3(0.0, 0.0, 0.0);
    found.transmittance = 1.0;
    found.depth = 0.0;
    // Parallel to an axis: a hair's breadth beside it, so that nothing is divided by 0.
    float3 d = abs(along) < 1e-12 ? float3(1e-12, 1e-12, 1e-12) : along;
    int3 high = int3(octree.width, octree.height, octree.depth) - 1;
    float3 one = -origin / d, other = (float3(high + 1) - origin) / d;
    float3 near = min(one, other), away = max(one, other);
    float start = max(max(near.x, near.y), max(near.z, 0.0));
    float end = min(min(away.x, away.y), min(away.z, stop)) - start;
    // Distances count from where the ray enters the box: they stay small, and exact.
    float3 from = origin + start * d, upward = float3(d > 0.0);
    int3 voxel = clamp(int3(floor(from)), 0, high);
    float t = 0.0;
    [loop] for (int n = 0; n < 16384 && t < end && found.transmittance >= cut; n++) {
        OctreeCube cube = octreeCube(octree, voxel);
        float3 exits = (float3(cube.corner) + upward * float(cube.edge) - from) / d;
        float next = max(min(exits.x, min(exits.y, exits.z)), t);
        float sigma = octreeValue(octree, cube.row, octree.dataDim - 1) * unit;
        if (sigma > 0.0) {
            float thick = sigma * (min(next, end) - t), kept = exp(-thick), weight = found.transmittance * (1.0 - kept);
            found.colour += weight * octreeColour(octree, cube.row, basis);
            found.depth += weight * (start + t) + found.transmittance * (1.0 - kept - thick * kept) / sigma;
            found.transmittance *= kept;
        }
        t = next;
        // The voxel behind is found by number and not by a small step: rounding can neither hold a ray up nor skip one.
        int axis = exits.x <= exits.y && exits.x <= exits.z ? 0 : exits.y <= exits.z ? 1 : 2;
        voxel = clamp(int3(floor(from + t * d)), cube.corner, min(cube.corner + cube.edge - 1, high));
        int3 across = d > 0.0 ? cube.corner + cube.edge : cube.corner - 1;
        voxel = bool3(axis == 0, axis == 1, axis == 2) ? across : voxel;
        if (any(voxel < 0) || any(voxel > high)) break;
    }
    found.depth /= max(1.0 - found.transmittance, 1e-30);
    return found;
}
