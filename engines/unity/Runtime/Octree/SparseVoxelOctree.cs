using System;

namespace Nerfbake
{
    /// <summary>
    /// Listing 1 of TR-24-01 (docs/sources.md): an octree with node values of type T. T is either float, with DataDim
    /// values per node, or a struct with a name for each of a node's floats (SH9Voxel and the others of this package,
    /// or your own struct), with one struct per node.
    /// </summary>
    public sealed class SparseVoxelOctree<T> : OctreeNodes where T : struct
    {
        /// <summary>The values, node after node. Halves of a file become floats, which is exact.</summary>
        public T[] NodeData { get; private set; }

        /// <summary>The number of T per node.</summary>
        public int PerNode { get; private set; }

        /// <summary>The number of floats per node: the coefficients of red, green and blue, then sigma.</summary>
        public int DataDim { get; private set; }

        /// <summary>The layout of these floats, in svox's names: "SH9", "RGBA", ...; "" if unknown.</summary>
        public string DataFormat { get; private set; }

        internal SparseVoxelOctree(OctreeFile file, T[] data) : base(file)
        {
            NodeData = data;
            PerNode = data.Length / file.Count;
            DataDim = file.DataDim;
            DataFormat = file.DataFormat;
        }

        /// <summary>The value of the voxel around a point in voxels; zeros in empty space or outside.</summary>
        public T Nearest(float x, float y, float z)
        {
            if (PerNode != 1)
                throw new InvalidOperationException("a node holds " + PerNode + " values: ask for an array of floats");
            int node = NearestNode(x, y, z);
            return node < 0 ? default(T) : NodeData[node];
        }

        /// <summary>Writes the same value as DataDim floats.</summary>
        public void Nearest(float x, float y, float z, float[] values)
        {
            int node = NearestNode(x, y, z);
            if (node < 0)
                Array.Clear(values, 0, DataDim);
            else
                VoxelMemory.ToFloats(NodeData, node * PerNode, values, DataDim);
        }

        /// <summary>Interpolates between the eight voxels whose centres surround a point in voxels, as DataDim floats.
        /// Empty space and voxels outside the grid count as zeros.</summary>
        public void Trilinear(float x, float y, float z, float[] values)
        {
            int[] nodes = new int[8];
            float[] weights = new float[8], own = new float[DataDim];
            int count = Neighbours(x, y, z, nodes, weights);
            Array.Clear(values, 0, DataDim);
            for (int i = 0; i < count; i++)
            {
                VoxelMemory.ToFloats(NodeData, nodes[i] * PerNode, own, DataDim);
                for (int k = 0; k < DataDim; k++)
                    values[k] += weights[i] * own[k];
            }
        }
    }
}
