using System.Runtime.InteropServices;

// Structs that name a node's floats: the messages of schemas/voxels.proto. F1_m1 is f1^-1: degree 1, order -1.
namespace Nerfbake
{
    /// <summary>Coefficients of one colour: 1 spherical harmonic.</summary>
    [StructLayout(LayoutKind.Sequential, Pack = 4)]
    public struct SH1
    {
        public float F0_0;
    }

    /// <summary>Coefficients of one colour: 4 spherical harmonics.</summary>
    [StructLayout(LayoutKind.Sequential, Pack = 4)]
    public struct SH4
    {
        public float F0_0;
        public float F1_m1, F1_0, F1_p1;
    }

    /// <summary>Coefficients of one colour: 9 spherical harmonics.</summary>
    [StructLayout(LayoutKind.Sequential, Pack = 4)]
    public struct SH9
    {
        public float F0_0;
        public float F1_m1, F1_0, F1_p1;
        public float F2_m2, F2_m1, F2_0, F2_p1, F2_p2;
    }

    /// <summary>Coefficients of one colour: 16 spherical harmonics.</summary>
    [StructLayout(LayoutKind.Sequential, Pack = 4)]
    public struct SH16
    {
        public float F0_0;
        public float F1_m1, F1_0, F1_p1;
        public float F2_m2, F2_m1, F2_0, F2_p1, F2_p2;
        public float F3_m3, F3_m2, F3_m1, F3_0, F3_p1, F3_p2, F3_p3;
    }

    /// <summary>Coefficients of one colour: 25 spherical harmonics.</summary>
    [StructLayout(LayoutKind.Sequential, Pack = 4)]
    public struct SH25
    {
        public float F0_0;
        public float F1_m1, F1_0, F1_p1;
        public float F2_m2, F2_m1, F2_0, F2_p1, F2_p2;
        public float F3_m3, F3_m2, F3_m1, F3_0, F3_p1, F3_p2, F3_p3;
        public float F4_m4, F4_m3, F4_m2, F4_m1, F4_0, F4_p1, F4_p2, F4_p3, F4_p4;
    }

    [StructLayout(LayoutKind.Sequential, Pack = 4)]
    public struct SH1Voxel
    {
        public SH1 Red, Green, Blue;
        public float Sigma;
    }

    [StructLayout(LayoutKind.Sequential, Pack = 4)]
    public struct SH4Voxel
    {
        public SH4 Red, Green, Blue;
        public float Sigma;
    }

    [StructLayout(LayoutKind.Sequential, Pack = 4)]
    public struct SH9Voxel
    {
        public SH9 Red, Green, Blue;
        public float Sigma;
    }

    [StructLayout(LayoutKind.Sequential, Pack = 4)]
    public struct SH16Voxel
    {
        public SH16 Red, Green, Blue;
        public float Sigma;
    }

    [StructLayout(LayoutKind.Sequential, Pack = 4)]
    public struct SH25Voxel
    {
        public SH25 Red, Green, Blue;
        public float Sigma;
    }

    /// <summary>Colours that do not depend on the view.</summary>
    [StructLayout(LayoutKind.Sequential, Pack = 4)]
    public struct RGBAVoxel
    {
        public float Red, Green, Blue, Sigma;
    }
}
