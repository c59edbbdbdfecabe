// March a ray through the octree of Include/octree.hlsl, as in 3.4 of TR-24-01 (docs/sources.md): colour, transmittance
// and depth. Include Include/common.hlsl, octree.hlsl and harmonics.hlsl before this file. It does not depend on Unity.
// Density and colour are constant within a leaf, so sums along the ray are exact; an empty cube is crossed in one step.

// A cube of voxels with the same contents: their node (-1: empty), and the cube's lowest corner and edge.
struct OctreeCube {
    int row;
    int3 corner;
    int edge;
};

struct OctreeRay {
    float3 colour;        // premultiplied by the field's opacity
    float transmittance;  // the share of the light from behind the field that remains
    float depth;          // E[d]: expected distance from the origin to the ray's end, in steps; 0 for no hit
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

// size: basis functions per colour; 0 for RGBA, which has none.
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

// origin: in voxels. along: a step of the ray in voxels. unit: length of a step in the field's world units. basis:
// octreeBasis() in that direction. stop: distance at which the ray ends, in steps, for example from a depth buffer.
// cut: the ray also ends when its transmittance is below this value.
OctreeRay marchOctree(SparseVoxelOctree octree, float3 origin, float3 along, float unit, Harmonics basis, float stop, float cut) {
    OctreeRay found;
    found.colour = float3(0.0, 0.0, 0.0);
    found.transmittance = 1.0;
    found.depth = 0.0;
    // Replace components near 0 (rays parallel to an axis), to avoid a division by 0.
    float3 d = abs(along) < 1e-12 ? float3(1e-12, 1e-12, 1e-12) : along;
    int3 high = int3(octree.width, octree.height, octree.depth) - 1;
    float3 one = -origin / d, other = (float3(high + 1) - origin) / d;
    float3 near = min(one, other), away = max(one, other);
    float start = max(max(near.x, near.y), max(near.z, 0.0));
    float end = min(min(away.x, away.y), min(away.z, stop)) - start;
    // Distances count from the point where the ray enters the box, so they stay small and exact.
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
        // The next voxel is computed by index. A small step instead could stall the ray or skip a voxel by rounding.
        int axis = exits.x <= exits.y && exits.x <= exits.z ? 0 : exits.y <= exits.z ? 1 : 2;
        voxel = clamp(int3(floor(from + t * d)), cube.corner, min(cube.corner + cube.edge - 1, high));
        int3 across = d > 0.0 ? cube.corner + cube.edge : cube.corner - 1;
        voxel = bool3(axis == 0, axis == 1, axis == 2) ? across : voxel;
        if (any(voxel < 0) || any(voxel > high)) break;
    }
    found.depth /= max(1.0 - found.transmittance, 1e-30);
    return found;
}
