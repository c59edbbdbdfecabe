// An octree that blends with the objects behind it, after all opaque meshes: rays end at the camera's depth.
Shader "Nerfbake/Octree"
{
    Properties
    {
        _Cut ("A ray ends where less light is left", Range(0, 0.1)) = 0.0001
    }
    SubShader
    {
        Tags { "Queue" = "Transparent" "RenderType" = "Transparent" "IgnoreProjector" = "True" }
        // Draw the far sides of the hull: they are also visible from inside it.
        Cull Front

        Pass
        {
            ZWrite Off
            ZTest Always
            Blend One OneMinusSrcAlpha
            HLSLPROGRAM
            #pragma target 4.5
            #pragma vertex hullVertex
            #pragma fragment blended
            #include "Octree.hlsl"

            UNITY_DECLARE_DEPTH_TEXTURE(_CameraDepthTexture);

            // The distance along a ray to the nearest opaque mesh.
            float meshAlong(Ray ray, float4 screen) {
                float depth = SAMPLE_DEPTH_TEXTURE_PROJ(_CameraDepthTexture, UNITY_PROJ_COORD(screen));
                if (!isOrthographic()) return LinearEyeDepth(depth) / dot(ray.along, forward());
#if defined(UNITY_REVERSED_Z)
                depth = 1.0 - depth;
#endif
                return lerp(_ProjectionParams.y, _ProjectionParams.z, depth);
            }

            float4 blended(Hull hull) : SV_Target {
                Ray ray = rayTo(hull.world);
                OctreeRay found = marched(ray, meshAlong(ray, hull.screen));
                float alpha = 1.0 - found.transmittance;
                return float4(alpha * shown(found.colour / max(alpha, 1e-6)), alpha);
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
