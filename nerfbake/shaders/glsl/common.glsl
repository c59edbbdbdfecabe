// Shared by the other files: buffers in textures, bit counts, the eight voxels around a point.
// GLSL ES 3.00 (WebGL 2) and GLSL 3.30.
//
// These versions have no storage buffers, so each buffer is a texture of any width. Entry i is texel
// (i % width, i / width); the rest of the last line is never read. Formats: R32I for int32, RG32UI for pairs of uint32,
// RGBA32UI for four uint32, R32F for float32, RGBA16F for four float16. The filter is NEAREST.
#ifndef NERFBAKE_COMMON_GLSL
#define NERFBAKE_COMMON_GLSL
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp isampler2D;
precision highp usampler2D;

ivec2 placeOf(int i, int width) {
    return ivec2(i % width, i / width);
}

int fetchInt(isampler2D words, int i) {
    return texelFetch(words, placeOf(i, textureSize(words, 0).x), 0).r;
}

uvec2 fetchUint2(usampler2D words, int i) {
    return texelFetch(words, placeOf(i, textureSize(words, 0).x), 0).rg;
}

uvec4 fetchUint4(usampler2D words, int i) {
    return texelFetch(words, placeOf(i, textureSize(words, 0).x), 0);
}

float fetchFloat(sampler2D words, int i) {
    return texelFetch(words, placeOf(i, textureSize(words, 0).x), 0).r;
}

vec4 fetchFloat4(sampler2D words, int i) {
    return texelFetch(words, placeOf(i, textureSize(words, 0).x), 0);
}

// The number of bits that are set in a word. GLSL ES 3.00 has no bitCount.
int count(uint bits) {
    bits -= bits >> 1 & 0x55555555u;
    bits = (bits & 0x33333333u) + (bits >> 2 & 0x33333333u);
    return int(((bits + (bits >> 4)) & 0x0F0F0F0Fu) * 0x01010101u >> 24);
}

const float FAR = 1e9;  // voxels; coordinates are clamped to this, because an int32 ends at 2^31

vec3 bounded(vec3 point) {
    return clamp(point, -FAR, FAR);
}

// The eight voxels around a point: their rows in a buffer, and their trilinear weights. Entry 4 x + 2 y + z is the
// voxel at offset (x, y, z) from the lowest of the eight; each offset is 0 or 1.
struct Corners {
    int row[8];
    float weight[8];
};

ivec3 sideOf(int i) {
    return ivec3(i >> 2, i >> 1 & 1, i & 1);
}

// The trilinear weight of voxel i. f: offset of the point from the centre of the lowest of the eight voxels, 0 to 1.
float weightOf(int i, vec3 f) {
    vec3 weights = mix(1.0 - f, f, vec3(sideOf(i)));
    return weights.x * weights.y * weights.z;
}
#endif  // NERFBAKE_COMMON_GLSL
