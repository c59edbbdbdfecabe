// What the package's shaders use of Unity's own includes, as its manual declares it: enough for a compiler to read them.
float4x4 unity_ObjectToWorld, unity_WorldToObject, UNITY_MATRIX_VP, UNITY_MATRIX_V, UNITY_MATRIX_P;
float4 _ProjectionParams, _ZBufferParams;
float3 _WorldSpaceCameraPos;
SamplerState stub_sampler;

#define UNITY_REVERSED_Z 1
#define UNITY_PROJ_COORD(a) a
#define UNITY_DECLARE_TEX2D(name) Texture2D name
#define UNITY_SAMPLE_TEX2D(name, uv) name.Sample(stub_sampler, uv)
#define UNITY_DECLARE_DEPTH_TEXTURE(name) Texture2D name
#define SAMPLE_DEPTH_TEXTURE_PROJ(name, uv) name.Sample(stub_sampler, (uv).xy / (uv).w).r

float4 UnityObjectToClipPos(float4 position) {
    return mul(UNITY_MATRIX_VP, mul(unity_ObjectToWorld, float4(position.xyz, 1.0)));
}

float4 ComputeScreenPos(float4 position) {
    return float4(0.5 * (position.xy + position.w), position.zw);
}

float LinearEyeDepth(float depth) {
    return 1.0 / (_ZBufferParams.z * depth + _ZBufferParams.w);
}

float3 GammaToLinearSpace(float3 colour) {
    return colour * colour;
}

float3 LinearToGammaSpace(float3 colour) {
    return sqrt(colour);
}
