using UnityEngine;

namespace Nerfbake
{
    /// <summary>Makes the meshes whose fragments march an octree, in the object's own axes.</summary>
    public static class Hull
    {
        /// <summary>The box of the whole octree.</summary>
        public static Mesh Box(OctreeNodes octree)
        {
            float[] corners = Placement.Corners(octree);
            Vector3[] vertices = new Vector3[8];
            for (int i = 0; i < 8; i++)
                vertices[i] = new Vector3(corners[3 * i], corners[3 * i + 1], corners[3 * i + 2]);
            return MeshOf(vertices, Placement.Triangles());
        }

        /// <summary>A hull that `nerfbake hull` wrote as .obj. Unity mirrors x when it imports an .obj, and does not
        /// convert z up to y up, so an imported vertex (x, y, z) becomes (-x, z, y).</summary>
        public static Mesh FromObj(Mesh imported)
        {
            Vector3[] vertices = imported.vertices;
            for (int i = 0; i < vertices.Length; i++)
                vertices[i] = new Vector3(-vertices[i].x, vertices[i].z, vertices[i].y);
            return MeshOf(vertices, imported.triangles);
        }

        private static Mesh MeshOf(Vector3[] vertices, int[] triangles)
        {
            Mesh mesh = new Mesh { name = "hull", hideFlags = HideFlags.DontSave };
            mesh.indexFormat = vertices.Length > 65535 ? UnityEngine.Rendering.IndexFormat.UInt32 : UnityEngine.Rendering.IndexFormat.UInt16;
            mesh.vertices = vertices;
            mesh.triangles = triangles;
            mesh.RecalculateBounds();
            return mesh;
        }
    }
}
