using System;

namespace Nerfbake
{
    /// <summary>
    /// A .svo.pb: the message of schemas/svo.proto in both profiles and both layouts, with 0 or -1 for "no child", in
    /// float32 or float16, with or without the fields that nerfbake adds to the report's six. Throws an OctreeException
    /// of one line for any other bytes.
    /// </summary>
    public sealed class OctreeFile : OctreeNodes
    {
        /// <summary>type.googleapis.com/...: the type of a value, or of a whole voxel.</summary>
        public string TypeUrl { get; private set; }

        /// <summary>"SH9", "RGBA", ... from the file, or derived from the number of values; "" if unknown.</summary>
        public string DataFormat { get; private set; }

        /// <summary>Values per node.</summary>
        public int DataDim { get; private set; }

        /// <summary>Whether the file contains float16.</summary>
        public bool HasHalves { get; private set; }

        private readonly ArraySegment<byte> nodeData;

        public static OctreeFile Read(byte[] data)
        {
            ProtobufMessage message = new ProtobufMessage(data);
            int[] levels = message.WholeNumbers(9), children = ChildrenOf(message);
            VoxelType type = VoxelType.Of(message.Text(1), message.Text(7));
            int count = CountOf(levels, children, message.Last(6).Count);
            int[] size = { message.Number(2), message.Number(3), message.Number(4) };
            OctreeFile file = new OctreeFile(message, type, size, children, count);
            file.RequireLevels(levels);
            return file;
        }

        private OctreeFile(ProtobufMessage message, VoxelType type, int[] size, int[] children, int count)
            : base(size, children, count, Place(message, 10, "origin", 0), Place(message, 11, "voxel_size", 1))
        {
            nodeData = message.Last(6);
            HasHalves = type.IsHalf;
            TypeUrl = message.Text(1);
            int values = nodeData.Count / type.ItemSize;
            if (nodeData.Count % type.ItemSize != 0 || values % count != 0 || values == 0)
                throw new OctreeException("node_data", "has " + nodeData.Count + " bytes for " + count + " nodes", "a multiple of " + type.ItemSize * (long)count + ", not 0");
            DataDim = values / count;
            DataFormat = type.FormatFor(DataDim);
            int declared = message.Number(8);
            if (declared != 0 && declared != DataDim)
                throw new OctreeException("data_dim", "is " + declared, DataDim + ", as many values as a node has");
            foreach (double edge in VoxelSize)
                if (!(edge >= 1e-15 && edge <= 1e15))
                    throw new OctreeException("voxel_size", "has an edge of " + edge, "a finite number above 0, 1e-15 to 1e15");
        }

        /// <summary>The octree with all values as plain floats, DataDim per node.</summary>
        public SparseVoxelOctree<float> ToNumbers()
        {
            return new SparseVoxelOctree<float>(this, Values());
        }

        /// <summary>The octree with one struct per node, which contains the node's floats in their order. A struct of
        /// this package must match the format of the file: SH9Voxel reads only SH9. Throws OctreeException.</summary>
        public SparseVoxelOctree<T> ToVoxels<T>() where T : struct
        {
            int floats = VoxelMemory.FloatsIn<T>();
            string own = typeof(T).Namespace == "Nerfbake" ? typeof(T).Name : null;
            if (floats != DataDim || (own != null && own != DataFormat + "Voxel"))
                throw new OctreeException("node_data", "has " + DataDim + " values a node, " + DataFormat, floats + " in a " + typeof(T).Name);
            return new SparseVoxelOctree<T>(this, VoxelMemory.FromFloats<T>(Values()));
        }

        private float[] Values()
        {
            float[] values = new float[Count * DataDim];
            if (!HasHalves)
                Buffer.BlockCopy(nodeData.Array, nodeData.Offset, values, 0, nodeData.Count);
            else
                for (int i = 0, at = nodeData.Offset; i < values.Length; i++, at += 2)
                    values[i] = Half.ToFloat(nodeData.Array[at] | nodeData.Array[at + 1] << 8);
            return values;
        }

        private static int[] ChildrenOf(ProtobufMessage message)
        {
            int[] children = message.WholeNumbers(5);
            ArraySegment<byte> bulk = message.Last(13);
            if (children.Length > 0 && bulk.Count > 0)
                throw new OctreeException("message", "has fields 5 and 13", "the children once");
            if (bulk.Count % 32 != 0)
                throw new OctreeException("node_children", "has " + bulk.Count + " bytes", "a multiple of 32");
            if (bulk.Count > 0)
            {
                children = new int[bulk.Count / 4];
                Buffer.BlockCopy(bulk.Array, bulk.Offset, children, 0, bulk.Count);
            }
            if (children.Length % 8 != 0)
                throw new OctreeException("node_children", "has " + children.Length + " numbers", "a multiple of 8");
            for (int slot = 0; slot < children.Length; slot++)
                if (children[slot] == -1)
                    children[slot] = 0;
            return children;
        }

        private static int CountOf(int[] levels, int[] children, int bytes)
        {
            long count = levels.Length == 0 ? children.Length / 8 : 0;
            foreach (int size in levels)
            {
                if (size < 0)
                    throw new OctreeException("level_sizes", "has a level of " + size + " nodes", "0 or more");
                count += size;
            }
            if (count < 1 || count > bytes / 2)
                throw new OctreeException("level_sizes", "adds up to " + count + " nodes", "1 to " + bytes / 2 + " for " + bytes + " bytes of node_data");
            return (int)count;
        }

        private void RequireLevels(int[] levels)
        {
            bool same = levels.Length == 0 || levels.Length == LevelSizes.Length;
            for (int level = 0; same && level < levels.Length; level++)
                same = levels[level] == LevelSizes[level];
            if (!same)
                throw new OctreeException("level_sizes", "has " + levels.Length + " levels", string.Join(", ", LevelSizes) + ", as node_children says");
        }

        private static double[] Place(ProtobufMessage message, int number, string name, double missing)
        {
            double[] found = message.Doubles(number, name);
            if (found.Length == 0)
                return new[] { missing, missing, missing };
            if (found.Length != 3)
                throw new OctreeException(name, "has " + found.Length + " numbers", "3");
            foreach (double part in found)
                if (!(Math.Abs(part) <= 1e15))
                    throw new OctreeException(name, "has a number " + part, "a finite number, up to 1e15");
            return found;
        }
    }
}
