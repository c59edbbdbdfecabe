// Spherical harmonics of 1, 4, 9, 16 or 25 functions, in the order and with the signs of PlenOctrees; no buffers.
// HLSL, shader model 5.
//
// The constants are indices: SH_2_M1 is the index of f2^-1 in the coefficients of a colour. Value channel * size +
// SH_2_M1 of a voxel is that coefficient of red (0), green (1) or blue (2), and value 3 * size is the density. A colour
// is the sigmoid of the sum of coefficients times functions. RGBA has no functions: its colour is the sigmoid of its
// only coefficient, as if there were a single function equal to 1.
#ifndef NERFBAKE_HARMONICS_HLSL
#define NERFBAKE_HARMONICS_HLSL
static const int SH_0_0 = 0;
static const int SH_1_M1 = 1, SH_1_0 = 2, SH_1_P1 = 3;
static const int SH_2_M2 = 4, SH_2_M1 = 5, SH_2_0 = 6, SH_2_P1 = 7, SH_2_P2 = 8;
static const int SH_3_M3 = 9, SH_3_M2 = 10, SH_3_M1 = 11, SH_3_0 = 12, SH_3_P1 = 13, SH_3_P2 = 14, SH_3_P3 = 15;
static const int SH_4_M4 = 16, SH_4_M3 = 17, SH_4_M2 = 18, SH_4_M1 = 19, SH_4_0 = 20,
    SH_4_P1 = 21, SH_4_P2 = 22, SH_4_P3 = 23, SH_4_P4 = 24;

struct Harmonics {
    float f[25];
};

// The first `size` functions in a unit direction, given in the field's own axes; the other entries are 0.
Harmonics harmonics(float3 direction, int size) {
    float x = direction.x, y = direction.y, z = direction.z, xx = x * x, yy = y * y, zz = z * z;
    Harmonics h;
    for (int i = 0; i < 25; i++) h.f[i] = 0.0;
    h.f[SH_0_0] = 0.28209479177387814;
    if (size > 1) {
        float k = 0.4886025119029199;
        h.f[SH_1_M1] = -k * y;
        h.f[SH_1_0] = k * z;
        h.f[SH_1_P1] = -k * x;
    }
    if (size > 4) {
        float k = 1.0925484305920792;
        h.f[SH_2_M2] = k * x * y;
        h.f[SH_2_M1] = -k * y * z;
        h.f[SH_2_0] = 0.31539156525252005 * (2.0 * zz - xx - yy);
        h.f[SH_2_P1] = -k * x * z;
        h.f[SH_2_P2] = 0.5 * k * (xx - yy);
    }
    if (size > 9) {
        float k1 = 0.4570457994644658;
        float k2 = 1.445305721320277;
        float k3 = 0.5900435899266435;
        float side = 4.0 * zz - xx - yy;
        h.f[SH_3_M3] = -k3 * y * (3.0 * xx - yy);
        h.f[SH_3_M2] = 2.0 * k2 * x * y * z;
        h.f[SH_3_M1] = -k1 * y * side;
        h.f[SH_3_0] = 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
        h.f[SH_3_P1] = -k1 * x * side;
        h.f[SH_3_P2] = k2 * z * (xx - yy);
        h.f[SH_3_P3] = -k3 * x * (xx - 3.0 * yy);
    }
    if (size > 16) {
        float k1 = 0.6690465435572892;
        float k2 = 0.47308734787878004;
        float k3 = 1.7701307697799304;
        float k4 = 0.6258357354491761;
        h.f[SH_4_M4] = 4.0 * k4 * x * y * (xx - yy);
        h.f[SH_4_M3] = -k3 * y * z * (3.0 * xx - yy);
        h.f[SH_4_M2] = 2.0 * k2 * x * y * (7.0 * zz - 1.0);
        h.f[SH_4_M1] = -k1 * y * z * (7.0 * zz - 3.0);
        h.f[SH_4_0] = 0.10578554691520431 * (zz * (35.0 * zz - 30.0) + 3.0);
        h.f[SH_4_P1] = -k1 * x * z * (7.0 * zz - 3.0);
        h.f[SH_4_P2] = k2 * (xx - yy) * (7.0 * zz - 1.0);
        h.f[SH_4_P3] = -k3 * x * z * (xx - 3.0 * yy);
        h.f[SH_4_P4] = k4 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy));
    }
    return h;
}

float3 sigmoid(float3 sum) {
    return 1.0 / (1.0 + exp(-sum));
}
#endif  // NERFBAKE_HARMONICS_HLSL
