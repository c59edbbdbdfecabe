using UnityEngine;

namespace Nerfbake
{
    /// <summary>
    /// Draws an octree: the shader marches a ray in each fragment of a hull. The material selects the shader:
    /// Nerfbake/Octree blends with the objects behind it, Nerfbake/Octree Cutout writes depth like an opaque mesh. Both
    /// cast shadows.
    /// </summary>
    [ExecuteAlways]
    [RequireComponent(typeof(MeshFilter), typeof(MeshRenderer))]
    public sealed class OctreeRenderer : MonoBehaviour
    {
        [SerializeField] private OctreeAsset octree;

        [Tooltip("The .obj that `nerfbake hull` wrote, as Unity imports it. None: the octree's box.")]
        [SerializeField] private Mesh hull;

        private OctreeBuffers buffers;
        private Mesh mesh;
        private bool stale;

        /// <summary>The octree to draw; null draws nothing.</summary>
        public OctreeAsset Octree
        {
            get { return octree; }
            set
            {
                octree = value;
                Refresh();
            }
        }

        private void OnEnable()
        {
            Refresh();
        }

        private void OnDisable()
        {
            Release();
        }

        // Unity does not allow a change of the mesh here, so Update() makes it.
        private void OnValidate()
        {
            stale = true;
        }

        private void Update()
        {
            if (stale)
                Refresh();
        }

        // Rays end at the opaque meshes that the camera sees, so the camera has to draw their depth.
        private void OnWillRenderObject()
        {
            Camera.current.depthTextureMode |= DepthTextureMode.Depth;
        }

        private void Refresh()
        {
            Release();
            stale = false;
            if (octree == null)
                return;
            OctreeFile file = octree.Read();
            buffers = new OctreeBuffers(file);
            mesh = hull == null ? Hull.Box(file) : Hull.FromObj(hull);
            GetComponent<MeshFilter>().sharedMesh = mesh;
            MaterialPropertyBlock block = new MaterialPropertyBlock();
            buffers.Bind(block);
            GetComponent<MeshRenderer>().SetPropertyBlock(block);
        }

        private void Release()
        {
            if (buffers != null)
                buffers.Dispose();
            buffers = null;
            if (mesh != null)
                DestroyImmediate(mesh);
            mesh = null;
        }
    }
}
