// Shared by the other files: bit counts, the eight voxels around a point. HLSL, shader model 5.
//
// A buffer of int32 is a StructuredBuffer<int>, pairs of uint32 are a StructuredBuffer<uint2>, and groups of four
// float32 are a StructuredBuffer<float4>. Convert float16 to float32 before you upload it.
#ifndef NERFBAKE_COMMON_HLSL
#define NERFBAKE_COMMON_HLSL
// The number of bits that are set in a word.
int count(uint bits) {
    return (int)countbits(bits);
}

static const float FAR = 1e9;  // voxels; coordinates are clamped to this, because an int32 ends at 2^31

float3 bounded(float3 p) {
    return clamp(p, -FAR, FAR);
}

// The eight voxels around a point: their rows in a buffer, and their trilinear weights. Entry 4 x + 2 y + z is the
// voxel at offset (x, y, z) from the lowest of the eight; each offset is 0 or 1.
struct Corners {
    int row[8];
    float weight[8];
};

int3 sideOf(int i) {
    return int3(i >> 2, i >> 1 & 1, i & 1);
}

// The trilinear weight of voxel i. f: offset of the point from the centre of the lowest of the eight voxels, 0 to 1.
float weightOf(int i, float3 f) {
    float3 weights = lerp(1.0 - f, f, float3(sideOf(i)));
    return weights.x * weights.y * weights.z;
}
#endif  // NERFBAKE_COMMON_HLSL
