// What the other files include: the bits of a word, the eight voxels around a point.
// HLSL, shader model 5. A buffer of int32 is a StructuredBuffer<int>, pairs of uint32 are a StructuredBuffer<uint2>, and
// four of float32 a StructuredBuffer<float4>; float16 is widened before it is uploaded.
#ifndef NERFBAKE_COMMON_HLSL
#define NERFBAKE_COMMON_HLSL
// How many bits of a word are set.
int count(uint bits) {
    return (int)countbits(bits);
}

static const float FAR = 1e9;  // voxels; what is farther away is taken for this, as a whole number ends at 2^31

float3 bounded(float3 p) {
    return clamp(p, -FAR, FAR);
}

// The eight voxels around a point: rows of a buffer, and their trilinear weights. Number 4 x + 2 y + z is at x, y, z,
// where 1 is the upper one.
struct Corners {
    int row[8];
    float weight[8];
};

int3 sideOf(int i) {
    return int3(i >> 2, i >> 1 & 1, i & 1);
}

// f: how far the point is beyond the lowest of the eight, 0 to 1.
float weightOf(int i, float3 f) {
    float3 weights = lerp(1.0 - f, f, float3(sideOf(i)));
    return weights.x * weights.y * weights.z;
}
#endif  // NERFBAKE_COMMON_HLSL
