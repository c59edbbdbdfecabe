using System;
using System.Globalization;

namespace Nerfbake
{
    /// <summary>
    /// Real spherical harmonics in the order and with the signs of PlenOctrees: f0^0, f1^-1, f1^0, f1^1, f2^-2, ...;
    /// docs/conventions.md. Directions are unit vectors from the camera to the scene, in the octree's own axes.
    /// </summary>
    public static class SphericalHarmonics
    {
        /// <summary>The first 1, 4, 9, 16 or 25 functions in a direction.</summary>
        public static void Fill(float x, float y, float z, int count, float[] basis)
        {
            float xx = x * x, yy = y * y, zz = z * z;
            basis[0] = 0.28209479177387814f;
            if (count > 1)
                FillFirst(x, y, z, basis);
            if (count > 4)
            {
                const float k = 1.0925484305920792f;
                basis[4] = k * x * y;
                basis[5] = -k * y * z;
                basis[6] = 0.31539156525252005f * (2 * zz - xx - yy);
                basis[7] = -k * x * z;
                basis[8] = 0.5f * k * (xx - yy);
            }
            if (count > 9)
                FillThird(x, y, z, basis);
            if (count > 16)
                FillFourth(x, y, z, basis);
        }

        private static void FillFirst(float x, float y, float z, float[] basis)
        {
            const float k = 0.4886025119029199f;
            basis[1] = -k * y;
            basis[2] = k * z;
            basis[3] = -k * x;
        }

        private static void FillThird(float x, float y, float z, float[] basis)
        {
            const float k0 = 0.3731763325901154f, k1 = 0.4570457994644658f, k2 = 1.445305721320277f, k3 = 0.5900435899266435f;
            float xx = x * x, yy = y * y, zz = z * z, side = 4 * zz - xx - yy;
            basis[9] = -k3 * y * (3 * xx - yy);
            basis[10] = 2 * k2 * x * y * z;
            basis[11] = -k1 * y * side;
            basis[12] = k0 * z * (2 * zz - 3 * xx - 3 * yy);
            basis[13] = -k1 * x * side;
            basis[14] = k2 * z * (xx - yy);
            basis[15] = -k3 * x * (xx - 3 * yy);
        }

        private static void FillFourth(float x, float y, float z, float[] basis)
        {
            const float k0 = 0.10578554691520431f, k1 = 0.6690465435572892f, k2 = 0.47308734787878004f;
            const float k3 = 1.7701307697799304f, k4 = 0.6258357354491761f;
            float xx = x * x, yy = y * y, zz = z * z;
            basis[16] = 4 * k4 * x * y * (xx - yy);
            basis[17] = -k3 * y * z * (3 * xx - yy);
            basis[18] = 2 * k2 * x * y * (7 * zz - 1);
            basis[19] = -k1 * y * z * (7 * zz - 3);
            basis[20] = k0 * (zz * (35 * zz - 30) + 3);
            basis[21] = -k1 * x * z * (7 * zz - 3);
            basis[22] = k2 * (xx - yy) * (7 * zz - 1);
            basis[23] = -k3 * x * z * (xx - 3 * yy);
            basis[24] = k4 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy));
        }

        /// <summary>
        /// The colour of a node's floats in a direction, red, green and blue in 0..1, sRGB: the sigmoid of each
        /// colour's coefficients times the basis. RGBA has one number per colour, and no basis. Throws OctreeException
        /// for lobes, which cannot be drawn.
        /// </summary>
        public static void Colour(string dataFormat, float[] values, float x, float y, float z, float[] colour)
        {
            bool plain = dataFormat == "RGBA";
            if (!plain && !dataFormat.StartsWith("SH", StringComparison.Ordinal))
                throw new OctreeException("data_format", "is '" + dataFormat + "'", "SHk or RGBA can be drawn");
            int count = plain ? 1 : int.Parse(dataFormat.Substring(2), CultureInfo.InvariantCulture);
            float[] basis = { 1 };
            if (!plain)
                Fill(x, y, z, count, basis = new float[count]);
            for (int c = 0; c < 3; c++)
            {
                float sum = 0;
                for (int k = 0; k < count; k++)
                    sum += basis[k] * values[c * count + k];
                colour[c] = (float)(1 / (1 + Math.Exp(-sum)));
            }
        }
    }
}
