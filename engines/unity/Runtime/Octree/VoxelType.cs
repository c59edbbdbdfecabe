using System;
using System.Globalization;

namespace Nerfbake
{
    /// <summary>The type of a node's values, from type_url and data_format.</summary>
    internal struct VoxelType
    {
        private const string Home = "type.googleapis.com/";
        private static readonly string[] Named = { "RGBA", "SH1", "SH4", "SH9", "SH16", "SH25" };

        public bool IsHalf { get; private set; }
        public string Format { get; private set; }

        public int ItemSize
        {
            get { return IsHalf ? 2 : 4; }
        }

        public static VoxelType Of(string typeUrl, string dataFormat)
        {
            bool half = typeUrl == Home + "svo.protobuf.Float16Value";
            if (half || typeUrl == "" || typeUrl == Home + "google.protobuf.FloatValue")
                return new VoxelType { IsHalf = half, Format = dataFormat };
            foreach (string name in Named)
            {
                half = typeUrl == Home + "svo.protobuf." + name + "HalfVoxel";
                if (!half && typeUrl != Home + "svo.protobuf." + name + "Voxel")
                    continue;
                if (dataFormat != "" && dataFormat != name)
                    throw new OctreeException("type_url", "names a voxel of " + name, "that of data_format");
                return new VoxelType { IsHalf = half, Format = name };
            }
            throw new OctreeException("type_url", "is none that is known", "FloatValue, Float16Value, or a voxel of schemas/voxels.proto");
        }

        /// <summary>The file's format, or the format derived from this number of values. Throws if the two do not
        /// match.</summary>
        public string FormatFor(int dataDim)
        {
            if (Format == "")
            {
                foreach (string name in Named)
                    if (3 * Colours(name) + 1 == dataDim)
                        return name;
                return "";
            }
            if (3 * (long)Colours(Format) + 1 != dataDim)
                throw new OctreeException("node_data", "has " + dataDim + " values a node", "those of its data_format");
            return Format;
        }

        /// <summary>Coefficients per colour: 9 for "SH9", 1 for "RGBA". Throws for names that svox lacks.</summary>
        private static int Colours(string format)
        {
            if (format == "RGBA")
                return 1;
            string digits = format.StartsWith("ASG", StringComparison.Ordinal) ? format.Substring(3) : format.Length > 2 ? format.Substring(2) : "";
            int size;
            bool whole = int.TryParse(digits, NumberStyles.None, CultureInfo.InvariantCulture, out size);
            bool lobes = format == "SG" + size || format == "ASG" + size;
            if (whole && size > 0 && size < 10000 && (lobes || Array.IndexOf(Named, format) > 0))
                return size;
            throw new OctreeException("data_format", "is none that svox knows", "RGBA, SGk, ASGk, or SHk with k of 1, 4, 9, 16, 25");
        }
    }
}
