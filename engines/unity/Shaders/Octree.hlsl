// Shared by the passes of an octree's shaders: the uniforms that OctreeBuffers.cs sets, the vertices of a hull, and the
// ray through a pixel, from a camera or from a light that draws its shadow map.
#include "UnityCG.cginc"
#include "Include/common.hlsl"
#include "Include/octree.hlsl"
#include "Include/harmonics.hlsl"
#include "Include/world.hlsl"
#include "March.hlsl"

float4 _OctreeSize;   // width, height, depth, dataDim
float4 _OctreeBasis;  // levels below the root; basis functions per colour, 0 for RGBA
float4 _ToVoxels0, _ToVoxels1, _ToVoxels2;
float _Cut;           // a ray ends when its transmittance is below this

struct Hull {
    float4 position : SV_POSITION;
    float3 world : TEXCOORD0;
    float4 screen : TEXCOORD1;
};

struct Ray {
    float3 origin;
    float3 along;  // unit vector
};

Hull hullVertex(float4 vertex : POSITION) {
    Hull hull;
    hull.position = UnityObjectToClipPos(vertex);
    hull.world = mul(unity_ObjectToWorld, float4(vertex.xyz, 1.0)).xyz;
    hull.screen = ComputeScreenPos(hull.position);
    return hull;
}

float3 forward() {
    return -UNITY_MATRIX_V[2].xyz;
}

bool isOrthographic() {
    return UNITY_MATRIX_P[3].w == 1.0;
}

Ray rayTo(float3 world) {
    Ray ray;
    float3 eye = -(UNITY_MATRIX_V[0].w * UNITY_MATRIX_V[0].xyz + UNITY_MATRIX_V[1].w * UNITY_MATRIX_V[1].xyz +
                   UNITY_MATRIX_V[2].w * UNITY_MATRIX_V[2].xyz);
    ray.origin = eye;
    ray.along = normalize(world - eye);
    if (isOrthographic()) {
        ray.along = forward();
        ray.origin = world - ray.along * dot(world - eye, ray.along);
    }
    return ray;
}

// stop: distance at which the ray ends, in units of Unity's world.
OctreeRay marched(Ray ray, float stop) {
    SparseVoxelOctree octree;
    octree.width = int(_OctreeSize.x);
    octree.height = int(_OctreeSize.y);
    octree.depth = int(_OctreeSize.z);
    octree.dataDim = int(_OctreeSize.w);
    octree.maxLevel = int(_OctreeBasis.x);
    World world;
    world.toObject[0] = unity_WorldToObject[0];
    world.toObject[1] = unity_WorldToObject[1];
    world.toObject[2] = unity_WorldToObject[2];
    world.toVoxels[0] = _ToVoxels0;
    world.toVoxels[1] = _ToVoxels1;
    world.toVoxels[2] = _ToVoxels2;
    world.axes = Y_UP_LEFT;
    float3 along = stepInVoxels(world, ray.along);
    float3 own = along / float3(length(_ToVoxels0.xyz), length(_ToVoxels1.xyz), length(_ToVoxels2.xyz));
    Harmonics basis = octreeBasis(lookInAxes(world, ray.along), int(_OctreeBasis.y));
    return marchOctree(octree, pointInVoxels(world, ray.origin), along, length(own), basis, stop, _Cut);
}

// Convert a field's colour, which is sRGB, to the colour space of the project.
float3 shown(float3 colour) {
#ifdef UNITY_COLORSPACE_GAMMA
    return colour;
#else
    return GammaToLinearSpace(colour);
#endif
}

// The depth buffer's value for a point of the world.
float depthOf(float3 world) {
    float4 clip = mul(UNITY_MATRIX_VP, float4(world, 1.0));
#if defined(SHADER_API_GLCORE) || defined(SHADER_API_GLES3)
    return 0.5 * clip.z / clip.w + 0.5;
#else
    return clip.z / clip.w;
#endif
}
