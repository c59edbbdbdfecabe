using System;

namespace Nerfbake
{
    /// <summary>
    /// Listing 1 of TR-24-01 (docs/sources.md): an octree whose nodes hold values of type T. T is float, and then
    /// a node has DataDim of them; or a struct of a node's floats with names, SH9Voxel and its like or one of your own, and then it has one.
    /// </summary>
    public sealed class SparseVoxelOctree<T> : OctreeNodes where T : struct
    {
        /// <summary>Node after node. Halves of a file are floats here, which is exact.</summary>
        public T[] NodeData { get; private set; }

        /// <summary>How many T a node has.</summary>
        public int PerNode { get; private set; }

        /// <summary>How many floats a node has: the coefficients of red, green and blue, then sigma.</summary>
        public int DataDim { get; private set; }

        /// <summary>How they are laid out, as svox names it: "SH9", "RGBA", ...; "" if nobody knows.</summary>
        public string DataFormat { get; private set; }

        internal SparseVoxelOctree(OctreeFile file, T[] data) : base(file)
        {
            NodeData = data;
            PerNode = data.Length / file.Count;
            DataDim = file.DataDim;
            DataFormat = file.DataFormat;
        }

        /// <summary>What the voxel around a point in voxels holds; all zeros in empty space and outside.</summary>
        public T Nearest(float x, float y, float z)
        {
            if (PerNode != 1)
                throw new InvalidOperationException("a node holds " + PerNode + " values: ask for an array of floats");
            int node = NearestNode(x, y, z);
            return node < 0 ? default(T) : NodeData[node];
        }

        /// <summary>The same as DataDim floats.</summary>
        public void Nearest(float x, float y, float z, float[] values)
        {
            int node = NearestNode(x, y, z);
            if (node < 0)
                Array.Clear(values, 0, DataDim);
            else
                VoxelMemory.ToFloats(NodeData, node * PerNode, values, DataDim);
        }

        /// <summary>Between the eight voxels whose centres surround a point in voxels, as DataDim floats; what is empty or
        /// outside counts as zeros.</summary>
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
