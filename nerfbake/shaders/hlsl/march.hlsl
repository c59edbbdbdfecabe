// A ray through a PageField, which the pages of `nerfbake view` show: its colour, its depth, and what light is left.
// Density and colour are constant in a voxel: sums along the ray are exact.
//
//   top     an int32 for each cell of 8^3 voxels, z fastest: below 0 empty, and so is every cell nearer than minus this
//           number of cells; from 0 the number of a leaf; from 2^30 a row for all of the cell, plus 2^30
//   blocks  four uint32 for each of the eight 4^3 blocks of a leaf: lower and upper half of its mask, the row of its
//           first voxel, and how many bits the lower half has; 255 there: the whole block has that row
//   texels  four float32 each, texelsPerRow in a row: red, green, blue of the first coefficient and the
//           density; then red, green, blue of the second, of the third, ..., without a gap
#ifndef NERFBAKE_MARCH_HLSL
#define NERFBAKE_MARCH_HLSL
#include "common.hlsl"
#include "harmonics.hlsl"

StructuredBuffer<int> top;
StructuredBuffer<uint4> blocks;
StructuredBuffer<float4> texels;

struct Field {
    int3 cells;         // of `top`, along x, y, z
    float3 low;         // the box around all that is not empty, in voxels
    float3 high;
    int texelsPerRow;   // 1 + 3 ceil((size of the basis - 1) / 4)
    float densityUnit;  // densities are multiples of this, in 1/world unit; divide it by the scale of a scaled object
};

// Voxels that are alike: a row, or -1 where they are empty, and the lowest corner and the edge of their cube.
struct Cube {
    int row;
    int3 corner;
    int edge;
};

struct Marched {
    float3 colour;        // what the field adds to a picture, times its opacity
    float transmittance;  // the share of what is behind that is added to it
    float depth;          // E[d]: where the ray is expected to end, from its origin, in world units; 0 where nothing is
};

Cube cubeOf(int row, int3 corner, int edge) {
    Cube cube = {row, corner, edge};
    return cube;
}

Cube cubeAt(Field field, int3 voxel) {
    int3 cell = voxel >> 3;
    int here = top[(cell.x * field.cells.y + cell.y) * field.cells.z + cell.z];
    if (here < 0) return cubeOf(-1, (cell + here + 1) << 3, 8 * (-2 * here - 1));
    if (here >= 1 << 30) return cubeOf(here - (1 << 30), cell << 3, 8);
    int3 part = voxel >> 2 & 1;
    uint4 block = blocks[8 * here + 4 * part.x + 2 * part.y + part.z];
    if ((block.x | block.y) == 0u) return cubeOf(-1, voxel & ~3, 4);
    if (block.w == 255u) return cubeOf(int(block.z), voxel & ~3, 4);
    int3 i = voxel & 3;
    bool upper = i.x > 1;
    uint mask = upper ? block.y : block.x, bit = 1u << uint((i.x & 1) << 4 | i.y << 2 | i.z);
    if ((mask & bit) == 0u) return cubeOf(-1, voxel, 1);
    return cubeOf(int(block.z) + (upper ? int(block.w) : 0) + count(mask & (bit - 1u)), voxel, 1);
}

// The colour of a row in the direction that the harmonics are of.
float3 colourOf(Field field, int row, float3 first, Harmonics basis) {
    float3 sum = basis.f[0] * first;
    for (int i = 1; i < field.texelsPerRow; i += 3) {
        int at = field.texelsPerRow * row + i, k = (4 * i - 1) / 3;
        float4 a = texels[at], b = texels[at + 1], c = texels[at + 2];
        sum += basis.f[k] * a.rgb + basis.f[k + 1] * float3(a.a, b.rg);
        sum += basis.f[k + 2] * float3(b.ba, c.r) + basis.f[k + 3] * c.gba;
    }
    return sigmoid(sum);
}

// origin: in voxels. along: how many voxels a step of one world unit is (stepInVoxels() of a unit vector). basis: the
// harmonics in that direction. stop: no light from farther away, in world units: of a Z-buffer, say. cut: the ray ends
// where less light is left.
Marched march(Field field, float3 origin, float3 along, Harmonics basis, float stop, float cut) {
    Marched found = {float3(0.0, 0.0, 0.0), 1.0, 0.0};
    // Parallel to an axis: a hair's breadth beside it, so that nothing is divided by 0.
    float3 d = lerp(along, 1e-12, float3(abs(along) < 1e-12));
    float3 one = (field.low - origin) / d, other = (field.high - origin) / d;
    float3 near = min(one, other), away = max(one, other);
    float start = max(max(near.x, near.y), max(near.z, 0.0));
    float end = min(min(away.x, away.y), min(away.z, stop)) - start;
    // Distances count from where the ray enters the box: they stay small, and exact.
    float3 entry = origin + start * d, upward = float3(d > 0.0);
    int3 low = int3(floor(field.low)), high = int3(ceil(field.high)) - 1;
    int3 voxel = clamp(int3(floor(entry)), low, high);
    float t = 0.0;
    for (int i = 0; i < 16384 && t < end && found.transmittance >= cut; i++) {
        Cube cube = cubeAt(field, voxel);
        float3 exits = (float3(cube.corner) + upward * float(cube.edge) - entry) / d;
        float next = max(min(exits.x, min(exits.y, exits.z)), t);
        if (cube.row >= 0) {
            float4 first = texels[field.texelsPerRow * cube.row];
            float sigma = first.a * field.densityUnit, thick = sigma * (min(next, end) - t), kept = exp(-thick);
            float weight = found.transmittance * (1.0 - kept);
            found.colour += weight * colourOf(field, cube.row, first.rgb, basis);
            found.depth += weight * (start + t);
            found.depth += found.transmittance * (1.0 - kept - thick * kept) / max(sigma, 1e-30);
            found.transmittance *= kept;
        }
        t = next;
        // The voxel behind is found by number and not by a small step: rounding can neither hold a ray up nor skip one.
        int axis = exits.x <= exits.y && exits.x <= exits.z ? 0 : exits.y <= exits.z ? 1 : 2;
        voxel = clamp(int3(floor(entry + t * d)), max(cube.corner, low), min(cube.corner + cube.edge - 1, high));
        voxel[axis] = d[axis] > 0.0 ? cube.corner[axis] + cube.edge : cube.corner[axis] - 1;
        if (voxel[axis] < low[axis] || voxel[axis] > high[axis]) break;
    }
    found.depth /= max(1.0 - found.transmittance, 1e-30);
    return found;
}

// What is drawn of it in a cutout queue: an opaque colour where less light than `cut` is left, else nothing, alpha 0.
// The same `cut` can end the ray.
float4 cutout(Marched found, float cut) {
    if (found.transmittance >= cut) return 0.0;
    return float4(found.colour / (1.0 - found.transmittance), 1.0);
}
#endif  // NERFBAKE_MARCH_HLSL
