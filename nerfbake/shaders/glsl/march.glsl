// March a ray through a PageField, the field in the pages of `nerfbake view`: colour, transmittance and depth.
// Density and colour are constant within a voxel, so sums along the ray are exact.
//
//   top     an int32 per cell of 8^3 voxels, z fastest. Negative: the cell is empty, and so is every cell closer than
//           -top cells along all three axes. From 0: the number of a leaf. From 2^30: the whole cell has row top - 2^30
//   blocks  four uint32 for each of the eight 4^3 blocks of a leaf: lower and upper half of its mask, the row of its
//           first voxel, and the number of bits set in the lower half; 255 there: the whole block has that row. Bit
//           8 + 4 x + 2 y + z there: this octant of 2^3 voxels has one row, and one bit in the mask, its lowest voxel's
//   texels  four float16 or float32 each, texelsPerRow per row: red, green, blue of the first coefficient and the
//           density; then red, green, blue of the second, of the third, ..., without gaps
#ifndef NERFBAKE_MARCH_GLSL
#define NERFBAKE_MARCH_GLSL
#include "common.glsl"
#include "harmonics.glsl"

uniform isampler2D top;
uniform usampler2D blocks;
uniform sampler2D texels;

struct Field {
    ivec3 cells;        // size of `top` along x, y, z
    vec3 low;           // the box around everything that is not empty, in voxels
    vec3 high;
    int texelsPerRow;   // 1 + 3 ceil((basis functions - 1) / 4)
    float densityUnit;  // densities are multiples of this, in 1/world unit; divide it by the scale of the object
};

// A cube of voxels with the same contents: their row (-1: empty), and the cube's lowest corner and edge.
struct Cube {
    int row;
    ivec3 corner;
    int edge;
};

struct Marched {
    vec3 colour;          // premultiplied by the field's opacity
    float transmittance;  // the share of the light from behind the field that remains
    float depth;          // E[d]: expected distance from the origin to the ray's end, in world units; 0 for no hit
};

Cube cubeAt(Field field, ivec3 voxel) {
    ivec3 cell = voxel >> 3;
    int here = fetchInt(top, (cell.x * field.cells.y + cell.y) * field.cells.z + cell.z);
    if (here < 0) return Cube(-1, (cell + here + 1) << 3, 8 * (-2 * here - 1));
    if (here >= 1 << 30) return Cube(here - (1 << 30), cell << 3, 8);
    ivec3 part = voxel >> 2 & 1;
    uvec4 block = fetchUint4(blocks, 8 * here + 4 * part.x + 2 * part.y + part.z);
    if ((block.x | block.y) == 0u) return Cube(-1, voxel & ~3, 4);
    if (block.w == 255u) return Cube(int(block.z), voxel & ~3, 4);
    ivec3 i = voxel & 3;
    int edge = 1 + int(block.w >> uint(8 + (2 * (i.x & 2) | i.y & 2 | i.z >> 1)) & 1u);
    i &= 4 - edge;
    bool upper = i.x > 1;
    uint mask = upper ? block.y : block.x, bit = 1u << uint((i.x & 1) << 4 | i.y << 2 | i.z);
    if ((mask & bit) == 0u) return Cube(-1, voxel, 1);
    return Cube(int(block.z) + (upper ? int(block.w & 255u) : 0) + count(mask & (bit - 1u)), voxel & -edge, edge);
}

// The colour of a row in the direction of `basis`. first: red, green and blue of the row's first coefficient.
vec3 colourOf(Field field, int row, vec3 first, Harmonics basis) {
    vec3 sum = basis.f[0] * first;
    for (int i = 1; i < field.texelsPerRow; i += 3) {
        int at = field.texelsPerRow * row + i, k = (4 * i - 1) / 3;
        vec4 a = fetchFloat4(texels, at), b = fetchFloat4(texels, at + 1), c = fetchFloat4(texels, at + 2);
        sum += basis.f[k] * a.rgb + basis.f[k + 1] * vec3(a.a, b.rg);
        sum += basis.f[k + 2] * vec3(b.ba, c.r) + basis.f[k + 3] * c.gba;
    }
    return sigmoid(sum);
}

// origin: in voxels. along: the direction in voxels per world unit, stepInVoxels() of a unit vector. basis: harmonics()
// in that direction. stop: distance at which the ray ends, in world units, for example from a depth buffer. cut: the
// ray also ends when its transmittance is below this value.
Marched march(Field field, vec3 origin, vec3 along, Harmonics basis, float stop, float cut) {
    Marched found = Marched(vec3(0.0), 1.0, 0.0);
    // Replace components near 0 (rays parallel to an axis), to avoid a division by 0.
    vec3 d = mix(along, vec3(1e-12), lessThan(abs(along), vec3(1e-12)));
    vec3 one = (field.low - origin) / d, other = (field.high - origin) / d;
    vec3 near = min(one, other), away = max(one, other);
    float start = max(max(near.x, near.y), max(near.z, 0.0));
    float end = min(min(away.x, away.y), min(away.z, stop)) - start;
    // Distances count from the point where the ray enters the box, so they stay small and exact.
    vec3 entry = origin + start * d, upward = vec3(greaterThan(d, vec3(0.0)));
    ivec3 low = ivec3(floor(field.low)), high = ivec3(ceil(field.high)) - 1;
    ivec3 voxel = clamp(ivec3(floor(entry)), low, high);
    float t = 0.0;
    for (int i = 0; i < 16384 && t < end && found.transmittance >= cut; i++) {
        Cube cube = cubeAt(field, voxel);
        vec3 exits = (vec3(cube.corner) + upward * float(cube.edge) - entry) / d;
        float next = max(min(exits.x, min(exits.y, exits.z)), t);
        if (cube.row >= 0) {
            vec4 first = fetchFloat4(texels, field.texelsPerRow * cube.row);
            float sigma = first.a * field.densityUnit, thick = sigma * (min(next, end) - t), kept = exp(-thick);
            float weight = found.transmittance * (1.0 - kept);
            found.colour += weight * colourOf(field, cube.row, first.rgb, basis);
            found.depth += weight * (start + t);
            found.depth += found.transmittance * (1.0 - kept - thick * kept) / max(sigma, 1e-30);
            found.transmittance *= kept;
        }
        t = next;
        // The next voxel is computed by index. A small step instead could stall the ray or skip a voxel by rounding.
        int axis = exits.x <= exits.y && exits.x <= exits.z ? 0 : exits.y <= exits.z ? 1 : 2;
        voxel = clamp(ivec3(floor(entry + t * d)), max(cube.corner, low), min(cube.corner + cube.edge - 1, high));
        voxel[axis] = d[axis] > 0.0 ? cube.corner[axis] + cube.edge : cube.corner[axis] - 1;
        if (voxel[axis] < low[axis] || voxel[axis] > high[axis]) break;
    }
    found.depth /= max(1.0 - found.transmittance, 1e-30);
    return found;
}

// The colour for a cutout queue: opaque if the transmittance is below `cut`, else nothing (alpha 0). You can pass the
// same `cut` to march().
vec4 cutout(Marched found, float cut) {
    return found.transmittance < cut ? vec4(found.colour / (1.0 - found.transmittance), 1.0) : vec4(0.0);
}
#endif  // NERFBAKE_MARCH_GLSL
