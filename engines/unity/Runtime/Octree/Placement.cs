namespace Nerfbake
{
    /// <summary>
    /// Places an octree in a left-handed world with y up, like Unity's: (x, y, z) there is (x, z, y) in the octree's
    /// own axes, which are right-handed with z up. The same as Y_UP_LEFT in world.hlsl.
    /// </summary>
    public static class Placement
    {
        /// <summary>The three rows of the 3 x 4 matrix from the octree's own world to voxels.</summary>
        public static float[] ToVoxels(OctreeNodes octree)
        {
            float[] rows = new float[12];
            for (int axis = 0; axis < 3; axis++)
            {
                rows[5 * axis] = (float)(1 / octree.VoxelSize[axis]);
                rows[4 * axis + 3] = (float)(-octree.Origin[axis] / octree.VoxelSize[axis]);
            }
            return rows;
        }

        /// <summary>The eight corners of the octree's box, x, y, z each. Corner i has the upper x if bit 1 of i is set,
        /// the upper y if bit 2 is set, and the upper z if bit 4 is set.</summary>
        public static float[] Corners(OctreeNodes octree)
        {
            int[] size = { octree.Width, octree.Height, octree.Depth }, own = { 0, 2, 1 };
            float[] corners = new float[24];
            for (int i = 0; i < 24; i++)
            {
                int axis = own[i % 3];
                double voxels = (i / 3 >> i % 3 & 1) * size[axis];
                corners[i] = (float)(octree.Origin[axis] + voxels * octree.VoxelSize[axis]);
            }
            return corners;
        }

        /// <summary>The twelve triangles of that box by its corners, clockwise from outside as in Unity.</summary>
        public static int[] Triangles()
        {
            return new[]
            {
                0, 4, 6, 0, 6, 2, 1, 3, 7, 1, 7, 5, // x
                0, 1, 5, 0, 5, 4, 2, 6, 7, 2, 7, 3, // y
                0, 2, 3, 0, 3, 1, 4, 5, 7, 4, 7, 6, // z
            };
        }
    }
}
