// The specular MLP of nerf2mesh's stage 1, to compare it with the atlas that replaces it.
//
//   weights0  6 float32 per hidden unit: for the direction's x, y, z, then for the feature's red, green, blue; unit i
//             has column i of net.0.weight in mlp.json
//   weights1  3 float32 per hidden unit: unit i has row i of net.1.weight
//
// Constants in unrolled code are several times as fast as fetches; docs/formats/realtime.md has both measurements.
#ifndef NERFBAKE_MLP_HLSL
#define NERFBAKE_MLP_HLSL
#include "common.hlsl"

StructuredBuffer<float> weights0;
StructuredBuffer<float> weights1;

// direction: unit vector from the camera to the surface point, in the mesh's own coordinates. feature: 0 to 1.
float3 specularMlp(int units, float3 direction, float3 feature) {
    float3 sum = 0.0;
    for (int unit = 0; unit < units; unit++) {
        float hidden = 0.0;
        for (int i = 0; i < 3; i++) {
            hidden += direction[i] * weights0[6 * unit + i];
            hidden += feature[i] * weights0[6 * unit + 3 + i];
        }
        hidden = max(hidden, 0.0);
        for (int i = 0; i < 3; i++) sum[i] += hidden * weights1[3 * unit + i];
    }
    return 1.0 / (1.0 + exp(-sum));
}
#endif  // NERFBAKE_MLP_HLSL
