using System.IO;
using UnityEditor;
using UnityEngine;

namespace Nerfbake.Editor
{
    /// <summary>
    /// Imports the textures beside an atlas.json as numbers: no mips, no compression, no sRGB, and no filter for labels
    /// and features. Flips them vertically, so that v points down as in the file.
    /// </summary>
    public sealed class AtlasTextures : AssetPostprocessor
    {
        private bool OfAnAtlas(out bool filtered)
        {
            string name = Path.GetFileName(assetPath), folder = Path.GetDirectoryName(assetPath) ?? "";
            filtered = name.StartsWith("atlas_");
            bool named = filtered || name.StartsWith("labels_") || name.StartsWith("features_");
            return named && name.EndsWith(".png") && File.Exists(Path.Combine(folder, "atlas.json"));
        }

        private void OnPreprocessTexture()
        {
            bool filtered;
            if (!OfAnAtlas(out filtered))
                return;
            TextureImporter importer = (TextureImporter)assetImporter;
            importer.sRGBTexture = false;
            importer.mipmapEnabled = false;
            importer.npotScale = TextureImporterNPOTScale.None;
            importer.textureCompression = TextureImporterCompression.Uncompressed;
            importer.filterMode = filtered ? FilterMode.Bilinear : FilterMode.Point;
            importer.wrapMode = TextureWrapMode.Clamp;
            importer.maxTextureSize = 16384;
        }

        private void OnPostprocessTexture(Texture2D texture)
        {
            bool filtered;
            if (!OfAnAtlas(out filtered))
                return;
            Color32[] rows = texture.GetPixels32(), turned = new Color32[rows.Length];
            for (int y = 0; y < texture.height; y++)
                System.Array.Copy(rows, y * texture.width, turned, (texture.height - 1 - y) * texture.width, texture.width);
            texture.SetPixels32(turned);
            texture.Apply(false);
        }
    }
}
