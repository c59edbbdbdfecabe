// The colour of what a ray meets of the triangles, and how far away it is: what `nerfbake render` shows of a mesh, of
// nerf2mesh's stage 1 (the MLP) and of the atlas baked from it.
//
// The page puts before this: the version, the precisions, nerfbake/shaders/glsl/atlas.glsl, and one of these, or none of
// them, where the diffuse colour is all there is:
//   KMEANS, AFFINE, GRID    the atlas, by its method
//   MLP_TEXTURES            the MLP, with a texture fetch for each of its weights, as nerf2mesh's viewer has it
//   MLP_CONSTANTS           the MLP as a function `mlp`, unrolled, with its weights as constants

in vec3 along;
in vec2 place;
in vec3 share;

uniform sampler2D diffuse;
uniform float lit;  // 1: by a light at the camera; 0: as it is
uniform Atlas numbers;
uniform sampler2D atlas;
uniform sampler2D labels;
uniform sampler2D atlasFeatures;
uniform sampler2D mlpFeatures;
uniform sampler2D weights0;  // (h, 6): of a hidden unit the direction's three, then the feature's
uniform sampler2D weights1;  // (h, 3)

layout(location = 0) out vec4 colour;
layout(location = 1) out uint far;  // a float's bits: this is the only such texture that every device can draw to

const float AMBIENT = 0.25;  // of the colour, where a surface is seen edge-on

#ifdef MLP_TEXTURES
vec3 mlp(vec3 direction, vec3 feature) {
  float given[6] = float[6](direction.x, direction.y, direction.z, feature.r, feature.g, feature.b);
  vec3 sum = vec3(0.0);
  int units = textureSize(weights0, 0).y;
  for (int unit = 0; unit < units; unit++) {
    float hidden = 0.0;
    for (int i = 0; i < 6; i++) hidden += given[i] * texelFetch(weights0, ivec2(i, unit), 0).r;
    hidden = max(hidden, 0.0);
    for (int i = 0; i < 3; i++) sum[i] += hidden * texelFetch(weights1, ivec2(i, unit), 0).r;
  }
  return sum;
}
#endif

vec3 specular(vec3 direction) {
#if defined(KMEANS)
  return specularKmeans(atlas, labels, numbers, place, direction);
#elif defined(AFFINE)
  return specularAffine(atlas, labels, atlasFeatures, numbers, place, direction);
#elif defined(GRID)
  return specularGrid(atlas, atlasFeatures, numbers, place, direction);
#elif defined(MLP_TEXTURES) || defined(MLP_CONSTANTS)
  return 1.0 / (1.0 + exp(-mlp(direction, texture(mlpFeatures, place).rgb)));
#else
  return vec3(0.0);
#endif
}

void main() {
  float distance = length(along);
  vec3 direction = along / distance, across = cross(dFdx(along), dFdy(along));
  float facing = abs(dot(across, direction)) / max(length(across), 1e-30);
  vec3 base = texture(diffuse, place).rgb * share * mix(1.0, AMBIENT + (1.0 - AMBIENT) * facing, lit);
  colour = vec4(clamp(base + specular(direction), 0.0, 1.0), 1.0);
  far = floatBitsToUint(distance);
}
