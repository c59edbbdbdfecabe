using System;
using System.IO;
using UnityEditor.AssetImporters;

namespace Nerfbake.Editor
{
    /// <summary>Imports .svo.pb. Unity selects importers by the text after the last dot, so this one receives every
    /// .pb. It imports no other .pb, and logs an error.</summary>
    [ScriptedImporter(1, "pb")]
    public sealed class OctreeImporter : ScriptedImporter
    {
        public override void OnImportAsset(AssetImportContext context)
        {
            try
            {
                if (!context.assetPath.EndsWith(".svo.pb", StringComparison.OrdinalIgnoreCase))
                    throw new OctreeException("the name", "ends with .pb", ".svo.pb");
                OctreeAsset asset = OctreeAsset.From(File.ReadAllBytes(context.assetPath));
                asset.name = Path.GetFileName(context.assetPath);
                context.AddObjectToAsset("octree", asset);
                context.SetMainObject(asset);
            }
            catch (OctreeException error)
            {
                context.LogImportError(context.assetPath + ": " + error.Message);
            }
        }
    }
}
