using System;

namespace Nerfbake
{
    /// <summary>
    /// The nodes of a sparse voxel octree and their lookup, as in listing 1 of TR-24-01 (docs/sources.md), with the
    /// additional rules of docs/formats/octree.md. Right-handed; octant = x + 2y + 4z, 1 is the upper half. A node
    /// without children is a leaf and fills its cube; in a node with children, an octant without a child is empty.
    /// </summary>
    public class OctreeNodes
    {
        public const int MaxSize = 4096;

        public int Width { get; private set; }
        public int Height { get; private set; }
        public int Depth { get; private set; }

        /// <summary>Eight per node, 0 for no child. Nodes of the last level may have no entries (`compact`).</summary>
        public int[] NodeChildren { get; private set; }

        /// <summary>The number of nodes; every node has values.</summary>
        public int Count { get; private set; }

        /// <summary>The number of nodes of each level, starting with the root's level.</summary>
        public int[] LevelSizes { get; private set; }

        /// <summary>The level of single voxels: the root's cube has 2^GridLevel voxels along an edge.</summary>
        public int GridLevel { get; private set; }

        /// <summary>world = origin + voxel * voxelSize; voxel (0, 0, 0) starts at origin.</summary>
        public double[] Origin { get; private set; }

        public double[] VoxelSize { get; private set; }

        /// <summary>Validates the children: every node except the root is the child of exactly one node, and its level
        /// exists in the grid. Throws OctreeException.</summary>
        protected OctreeNodes(int[] size, int[] children, int count, double[] origin, double[] voxelSize)
        {
            for (int axis = 0; axis < 3; axis++)
                if (size[axis] < 1 || size[axis] > MaxSize)
                    throw new OctreeException("size", "is " + string.Join("x", size), "1 to 4096 voxels an axis");
            Width = size[0];
            Height = size[1];
            Depth = size[2];
            while (1 << GridLevel < Math.Max(Width, Math.Max(Height, Depth)))
                GridLevel++;
            if (children.Length % 8 != 0 || children.Length / 8 > count)
                throw new OctreeException("node_children", "has " + children.Length + " numbers", "8 for each of " + count + " nodes at most");
            NodeChildren = children;
            Count = count;
            Origin = origin;
            VoxelSize = voxelSize;
            LevelSizes = Levels();
        }

        protected OctreeNodes(OctreeNodes other)
        {
            Width = other.Width;
            Height = other.Height;
            Depth = other.Depth;
            GridLevel = other.GridLevel;
            NodeChildren = other.NodeChildren;
            Count = other.Count;
            Origin = other.Origin;
            VoxelSize = other.VoxelSize;
            LevelSizes = other.LevelSizes;
        }

        private int[] Levels()
        {
            int[] sizes = new int[GridLevel + 1], met = new int[Count];
            bool[] seen = new bool[Count];
            int begin = 0, end = 1, level = 0;
            seen[0] = true;
            for (; begin < end; level++)
            {
                if (level > GridLevel)
                    throw new OctreeException("node_children", "has more than " + GridLevel + " levels below the root", "as many as the size has");
                sizes[level] = end - begin;
                int last = end;
                for (; begin < last; begin++)
                    end = MeetChildren(met[begin], met, end, seen);
            }
            if (end < Count)
                throw new OctreeException("node_children", "leads to " + end + " of " + Count + " nodes", "a way from the root to every node");
            Array.Resize(ref sizes, level);
            return sizes;
        }

        private int MeetChildren(int node, int[] met, int end, bool[] seen)
        {
            for (int slot = 8 * node; slot < 8 * node + 8 && slot < NodeChildren.Length; slot++)
            {
                int child = NodeChildren[slot];
                if (child == 0)
                    continue;
                if (child < 0 || child >= Count)
                    throw new OctreeException("node_children[" + node + "]", "points to node " + child, "0 to " + (Count - 1) + ", or -1");
                if (seen[child])
                    throw new OctreeException("node_children[" + node + "]", "points to node " + child + ", which has a parent already", "one parent each");
                seen[child] = true;
                met[end++] = child;
            }
            return end;
        }

        /// <summary>Eight children for every node, for the shaders; a compact octree is padded with zeros.</summary>
        public int[] ChildrenOfAll()
        {
            int[] all = new int[8 * Count];
            NodeChildren.CopyTo(all, 0);
            return all;
        }

        /// <summary>The leaf that contains a voxel; -1 in empty space and outside the grid.</summary>
        public int NodeAt(int x, int y, int z)
        {
            if (x < 0 || y < 0 || z < 0 || x >= Width || y >= Height || z >= Depth)
                return -1;
            int node = 0;
            for (int shift = GridLevel - 1; shift >= 0; shift--)
            {
                int first = 8 * node;
                if (first >= NodeChildren.Length)
                    return node;
                int child = NodeChildren[first + (x >> shift & 1) + 2 * (y >> shift & 1) + 4 * (z >> shift & 1)];
                if (child == 0)
                    return HasChildren(first) ? -1 : node;
                node = child;
            }
            return node;
        }

        private bool HasChildren(int first)
        {
            for (int slot = first; slot < first + 8; slot++)
                if (NodeChildren[slot] != 0)
                    return true;
            return false;
        }

        /// <summary>The leaf around a point in voxels; -1 in empty space, outside the grid, and for NaN.</summary>
        public int NearestNode(float x, float y, float z)
        {
            if (!(x >= 0 && y >= 0 && z >= 0 && x < Width && y < Height && z < Depth))
                return -1;
            return NodeAt((int)x, (int)y, (int)z);
        }

        /// <summary>
        /// Writes the leaves and the weights of the voxels that are not empty, among the eight whose centres surround a
        /// point in voxels, to arrays of eight, and returns their number. The weights of all eight add up to 1.
        /// </summary>
        public int Neighbours(float x, float y, float z, int[] nodes, float[] weights)
        {
            float sx = x - 0.5f, sy = y - 0.5f, sz = z - 0.5f;
            if (!(sx > -1 && sy > -1 && sz > -1 && sx < Width && sy < Height && sz < Depth))
                return 0;
            int lowX = (int)Math.Floor(sx), lowY = (int)Math.Floor(sy), lowZ = (int)Math.Floor(sz);
            float farX = sx - lowX, farY = sy - lowY, farZ = sz - lowZ;
            int count = 0;
            for (int corner = 0; corner < 8; corner++)
            {
                int dx = corner & 1, dy = corner >> 1 & 1, dz = corner >> 2;
                float weight = (dx == 1 ? farX : 1 - farX) * (dy == 1 ? farY : 1 - farY) * (dz == 1 ? farZ : 1 - farZ);
                int node = weight > 0 ? NodeAt(lowX + dx, lowY + dy, lowZ + dz) : -1;
                if (node < 0)
                    continue;
                nodes[count] = node;
                weights[count++] = weight;
            }
            return count;
        }
    }
}
