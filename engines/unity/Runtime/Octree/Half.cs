using System.Runtime.InteropServices;

namespace Nerfbake
{
    /// <summary>Conversion of IEEE 754 halves.</summary>
    internal static class Half
    {
        [StructLayout(LayoutKind.Explicit)]
        private struct Bits
        {
            [FieldOffset(0)] public int Whole;
            [FieldOffset(0)] public float Number;
        }

        /// <summary>The float that equals a half, given by its 16 bits.</summary>
        public static float ToFloat(int half)
        {
            int sign = (half & 0x8000) << 16, exponent = half >> 10 & 31, fraction = half & 1023;
            if (exponent == 0)
                return (sign < 0 ? -1f : 1f) * fraction * (1f / 16777216);
            int wide = exponent == 31 ? 255 : exponent + 112;
            return new Bits { Whole = sign | wide << 23 | fraction << 13 }.Number;
        }
    }
}
