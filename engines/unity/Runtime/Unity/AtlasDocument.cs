using System;
using UnityEngine;

namespace Nerfbake
{
    /// <summary>The parts of the atlas.json from `nerfbake atlas` that a shader needs.</summary>
    [Serializable]
    public sealed class AtlasDocument
    {
        /// <summary>One of the meshes; each has its own textures. The names are those of the file.</summary>
        [Serializable]
        public sealed class Cascade
        {
            public string method;
            public int map_size, border, tiles_per_row, n;
            public float slope;
        }

        public int nerfbake_atlas;
        public Cascade[] cascades;

        public static AtlasDocument Parse(string json)
        {
            AtlasDocument found = JsonUtility.FromJson<AtlasDocument>(json);
            if (found == null || found.nerfbake_atlas != 1 || found.cascades == null || found.cascades.Length == 0)
                throw new FormatException("atlas.json is none of version 1 with a cascade");
            return found;
        }
    }
}
