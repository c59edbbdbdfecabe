using System;
using System.Runtime.InteropServices;

namespace Nerfbake
{
    /// <summary>Converts floats to structs of floats and back, without code for each struct.</summary>
    internal static class VoxelMemory
    {
        /// <summary>The number of floats in a T. Throws ArgumentException if T does not consist of floats.</summary>
        public static int FloatsIn<T>() where T : struct
        {
            int size = Marshal.SizeOf(typeof(T));
            if (size % 4 != 0)
                throw new ArgumentException(typeof(T).Name + " has " + size + " bytes; allowed: floats alone");
            return size / 4;
        }

        public static T[] FromFloats<T>(float[] values) where T : struct
        {
            T[] found = new T[values.Length / FloatsIn<T>()];
            GCHandle pin = GCHandle.Alloc(found, GCHandleType.Pinned);
            try
            {
                Marshal.Copy(values, 0, pin.AddrOfPinnedObject(), values.Length);
            }
            finally
            {
                pin.Free();
            }
            return found;
        }

        /// <summary>Writes `count` floats to `values`, starting at data[first].</summary>
        public static void ToFloats<T>(T[] data, int first, float[] values, int count) where T : struct
        {
            float[] plain = data as float[];
            if (plain != null)
            {
                Array.Copy(plain, first, values, 0, count);
                return;
            }
            GCHandle pin = GCHandle.Alloc(data, GCHandleType.Pinned);
            try
            {
                long place = pin.AddrOfPinnedObject().ToInt64() + (long)first * Marshal.SizeOf(typeof(T));
                Marshal.Copy(new IntPtr(place), values, 0, count);
            }
            finally
            {
                pin.Free();
            }
        }
    }
}
