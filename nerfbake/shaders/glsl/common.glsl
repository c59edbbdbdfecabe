// What the other files include: buffers, the bits of a word, the eight voxels around a point.
// GLSL ES 3.00 (WebGL 2) and GLSL 3.30.
//
// These have no storage buffers: entry i of a buffer is texel (i % width, i / width) of a texture of any width, and the
// rest of its last line is never read. The texture of int32 is R32I, of pairs of uint32 RG32UI, of four RGBA32UI, of
// float32 R32F, of four float16 RGBA16F; its filter is NEAREST.
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

// How many bits of a word are set; GLSL ES 3.00 has no bitCount.
int count(uint bits) {
    bits -= bits >> 1 & 0x55555555u;
    bits = (bits & 0x33333333u) + (bits >> 2 & 0x33333333u);
    return int(((bits + (bits >> 4)) & 0x0F0F0F0Fu) * 0x01010101u >> 24);
}

const float FAR = 1e9;  // voxels; what is farther away is taken for this, as a whole number ends at 2^31

vec3 bounded(vec3 point) {
    return clamp(point, -FAR, FAR);
}

// The eight voxels around a point: rows of a buffer, and their trilinear weights. Number 4 x + 2 y + z is at x, y, z,
// where 1 is the upper one.
struct Corners {
    int row[8];
    float weight[8];
};

ivec3 sideOf(int i) {
    return ivec3(i >> 2, i >> 1 & 1, i & 1);
}

// f: how far the point is beyond the lowest of the eight, 0 to 1.
float weightOf(int i, vec3 f) {
    vec3 weights = mix(1.0 - f, f, vec3(sideOf(i)));
    return weights.x * weights.y * weights.z;
}
#endif  // NERFBAKE_COMMON_GLSL
