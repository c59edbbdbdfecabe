// A mesh with the specular colour of an atlas from `nerfbake atlas`, by any of its three methods: colour = diffuse +
// specular. AtlasRenderer.cs sets the properties.
Shader "Nerfbake/Atlas"
{
    Properties
    {
        [NoScaleOffset] _MainTex ("Diffuse", 2D) = "black" {}
        [NoScaleOffset] atlas ("Atlas", 2D) = "black" {}
        [NoScaleOffset] labels ("Labels", 2D) = "black" {}
        [NoScaleOffset] features ("Features", 2D) = "black" {}
        _AtlasNumbers ("Size of a map, border, maps in a row, slope", Vector) = (64, 1, 8, 1)
        _AtlasNodes ("Nodes along an edge", Float) = 7
        _Axes ("The mesh's own axes: Unity mirrors x of an .obj", Vector) = (-1, 1, 1, 0)
    }
    SubShader
    {
        Tags { "RenderType" = "Opaque" }

        Pass
        {
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex surface
            #pragma fragment shaded
            #pragma multi_compile_local KMEANS AFFINE GRID
            #include "UnityCG.cginc"
            // Unity derives a sampler's filter from its name.
            #define smoothly nerfbake_linear_clamp_sampler
            #define nearest nerfbake_point_clamp_sampler
            #include "Include/atlas.hlsl"

            UNITY_DECLARE_TEX2D(_MainTex);
            float4 _AtlasNumbers, _Axes;
            float _AtlasNodes;

            struct Surface {
                float4 position : SV_POSITION;
                float2 uv : TEXCOORD0;
                float3 local : TEXCOORD1;
            };

            Surface surface(float4 vertex : POSITION, float2 uv : TEXCOORD0) {
                Surface found;
                found.position = UnityObjectToClipPos(vertex);
                found.uv = uv;
                found.local = vertex.xyz;
                return found;
            }

            float4 shaded(Surface found) : SV_Target {
                Atlas a;
                a.mapSize = _AtlasNumbers.x;
                a.border = _AtlasNumbers.y;
                a.tilesPerRow = _AtlasNumbers.z;
                a.slope = _AtlasNumbers.w;
                a.n = _AtlasNodes;
                float3 eye = mul(unity_WorldToObject, float4(_WorldSpaceCameraPos, 1.0)).xyz;
                float3 direction = normalize((found.local - eye) * _Axes.xyz);
                // AtlasTextures.cs flips these textures: v = 0 is their top, but the bottom of Unity's other textures.
                float2 uv = float2(found.uv.x, 1.0 - found.uv.y);
#if defined(GRID)
                float3 specular = specularGrid(a, uv, direction);
#elif defined(AFFINE)
                float3 specular = specularAffine(a, uv, direction);
#else
                float3 specular = specularKmeans(a, uv, direction);
#endif
                float3 diffuse = UNITY_SAMPLE_TEX2D(_MainTex, found.uv).rgb;
#ifdef UNITY_COLORSPACE_GAMMA
                return float4(saturate(diffuse + specular), 1.0);
#else
                // Diffuse and specular are added as display values (sRGB).
                return float4(GammaToLinearSpace(saturate(LinearToGammaSpace(diffuse) + specular)), 1.0);
#endif
            }
            ENDHLSL
        }
    }
    Fallback "VertexLit"
}
