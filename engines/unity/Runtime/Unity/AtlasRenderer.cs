using UnityEngine;

namespace Nerfbake
{
    /// <summary>
    /// Shows a mesh with an atlas baked by `nerfbake atlas`: passes the textures of one cascade and the numbers of
    /// atlas.json to the material, which must use the shader Nerfbake/Atlas.
    /// </summary>
    [ExecuteAlways]
    [RequireComponent(typeof(MeshRenderer))]
    public sealed class AtlasRenderer : MonoBehaviour
    {
        [Tooltip("atlas.json")]
        [SerializeField] private TextAsset document;
        [SerializeField] private int cascade;

        [Tooltip("feat0_{cascade}")]
        [SerializeField] private Texture2D diffuse;

        [Tooltip("atlas_{cascade}.png, labels_{cascade}.png and features_{cascade}.png; the method decides which there are")]
        [SerializeField] private Texture2D atlas, labels, features;

        private void OnEnable()
        {
            Refresh();
        }

        private void OnValidate()
        {
            if (isActiveAndEnabled)
                Refresh();
        }

        private void Refresh()
        {
            Material material = GetComponent<MeshRenderer>().sharedMaterial;
            if (document == null || material == null)
                return;
            AtlasDocument.Cascade own = AtlasDocument.Parse(document.text).cascades[cascade];
            foreach (string method in new[] { "kmeans", "affine", "grid" })
            {
                if (own.method == method)
                    material.EnableKeyword(method.ToUpperInvariant());
                else
                    material.DisableKeyword(method.ToUpperInvariant());
            }
            material.SetVector("_AtlasNumbers", new Vector4(own.map_size, own.border, own.tiles_per_row, own.slope));
            material.SetFloat("_AtlasNodes", own.n);
            material.SetTexture("_MainTex", diffuse);
            material.SetTexture("atlas", atlas);
            material.SetTexture("labels", labels);
            material.SetTexture("features", features);
        }
    }
}
