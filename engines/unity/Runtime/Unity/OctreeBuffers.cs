using System;
using UnityEngine;

namespace Nerfbake
{
    /// <summary>An octree on the graphics card: the buffers and uniforms that Shaders/Octree.hlsl reads.</summary>
    public sealed class OctreeBuffers : IDisposable
    {
        private static readonly int Children = Shader.PropertyToID("nodeChildren"), Data = Shader.PropertyToID("nodeData");
        private static readonly int Size = Shader.PropertyToID("_OctreeSize"), Basis = Shader.PropertyToID("_OctreeBasis");
        private static readonly int[] Rows =
        {
            Shader.PropertyToID("_ToVoxels0"), Shader.PropertyToID("_ToVoxels1"), Shader.PropertyToID("_ToVoxels2"),
        };

        private readonly ComputeBuffer children, data;
        private readonly Vector4 size, basis;
        private readonly float[] toVoxels;

        /// <summary>Throws OctreeException for values that cannot be drawn: lobes, and unknown formats.</summary>
        public OctreeBuffers(OctreeFile file)
        {
            bool plain = file.DataFormat == "RGBA";
            if (!plain && !file.DataFormat.StartsWith("SH", StringComparison.Ordinal))
                throw new OctreeException("data_format", "is '" + file.DataFormat + "'", "SHk or RGBA can be drawn");
            SparseVoxelOctree<float> octree = file.ToNumbers();
            children = new ComputeBuffer(8 * octree.Count, sizeof(int));
            children.SetData(octree.ChildrenOfAll());
            data = new ComputeBuffer(octree.NodeData.Length, sizeof(float));
            data.SetData(octree.NodeData);
            size = new Vector4(octree.Width, octree.Height, octree.Depth, octree.DataDim);
            basis = new Vector4(octree.GridLevel, plain ? 0 : (octree.DataDim - 1) / 3, 0, 0);
            toVoxels = Placement.ToVoxels(octree);
        }

        public void Bind(MaterialPropertyBlock block)
        {
            block.SetBuffer(Children, children);
            block.SetBuffer(Data, data);
            block.SetVector(Size, size);
            block.SetVector(Basis, basis);
            for (int i = 0; i < 3; i++)
                block.SetVector(Rows[i], new Vector4(toVoxels[4 * i], toVoxels[4 * i + 1], toVoxels[4 * i + 2], toVoxels[4 * i + 3]));
        }

        public void Dispose()
        {
            children.Release();
            data.Release();
        }
    }
}
