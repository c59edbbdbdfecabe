// An octree as an opaque mesh, for fields that are nearly opaque: a pixel is drawn with the octree's colour if the
// transmittance is below a threshold, else not at all. The depth that it writes is the expected end of its ray.
Shader "Nerfbake/Octree Cutout"
{
    Properties
    {
        _Threshold ("Opaque where less light is left", Range(0.01, 0.99)) = 0.5
        _Cut ("A ray ends where less light is left", Range(0, 0.1)) = 0.0001
    }
    SubShader
    {
        Tags { "Queue" = "AlphaTest" "RenderType" = "TransparentCutout" "IgnoreProjector" = "True" }
        Cull Front

        Pass
        {
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex hullVertex
            #pragma fragment opaque
            #include "Octree.hlsl"

            float _Threshold;

            float4 opaque(Hull hull, out float depth : SV_Depth) : SV_Target {
                Ray ray = rayTo(hull.world);
                OctreeRay found = marched(ray, 1e30);
                clip(_Threshold - found.transmittance);
                depth = depthOf(ray.origin + found.depth * ray.along);
                return float4(shown(found.colour / max(1.0 - found.transmittance, 1e-6)), 1.0);
            }
            ENDHLSL
        }

        Pass
        {
            Tags { "LightMode" = "ShadowCaster" }
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex hullVertex
            #pragma fragment caster
            #include "Caster.hlsl"
            ENDHLSL
        }
    }
}
