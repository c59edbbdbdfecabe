using UnityEngine;

namespace Nerfbake
{
    /// <summary>A .svo.pb as an asset: the bytes of the file, proved sound when it was imported.</summary>
    public sealed class OctreeAsset : ScriptableObject
    {
        [SerializeField, HideInInspector] private byte[] bytes;
        [SerializeField] private string content;

        /// <summary>What the file holds, in words.</summary>
        public string Content
        {
            get { return content; }
        }

        /// <summary>Throws OctreeException, one line, for bytes that are no octree.</summary>
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
