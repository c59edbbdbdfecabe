using UnityEngine;

namespace Nerfbake
{
    /// <summary>A .svo.pb as an asset: the bytes of the file, which were validated at the import.</summary>
    public sealed class OctreeAsset : ScriptableObject
    {
        [SerializeField, HideInInspector] private byte[] bytes;
        [SerializeField] private string content;

        /// <summary>A description of the contents.</summary>
        public string Content
        {
            get { return content; }
        }

        /// <summary>Throws an OctreeException of one line for bytes that are not a valid octree.</summary>
        public static OctreeAsset From(byte[] bytes)
        {
            OctreeFile file = OctreeFile.Read(bytes);
            OctreeAsset asset = CreateInstance<OctreeAsset>();
            asset.bytes = bytes;
            asset.content = file.DataFormat + " octree of " + file.Width + "x" + file.Height + "x" + file.Depth + ", " + file.Count + " nodes";
            return asset;
        }

        public OctreeFile Read()
        {
            return OctreeFile.Read(bytes);
        }
    }
}
