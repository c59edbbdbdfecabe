// The colour and the distance of the triangle that a ray meets, as `nerfbake render` draws a mesh, nerf2mesh's stage 1
// (the MLP) and the atlas baked from it.
//
// The page inserts before this file: the version, the precisions, nerfbake/shaders/glsl/atlas.glsl, and one of these
// definitions, or none of them if there is only the diffuse colour:
//   KMEANS, AFFINE, GRID    the atlas, by its method
//   MLP_TEXTURES            the MLP with a texture fetch for each weight, as in nerf2mesh's viewer
//   MLP_CONSTANTS           the MLP as an unrolled function `mlp`, with its weights as constants
// MLP_DEEP: this function takes texture coordinates instead of a feature, and reads the features itself. HOLES: some
// parts have texels that rays pass through.

in vec3 along;
in vec2 place;
in vec3 share;

uniform sampler2D diffuse;
uniform float lit;  // 1: lit by a light at the camera; 0: unlit
uniform Atlas numbers;
uniform sampler2D atlas;
uniform sampler2D labels;
uniform sampler2D atlasFeatures;
uniform sampler2D mlpFeatures;
uniform sampler2D opaque;  // 0 in holes
uniform sampler2D weights0;  // (h, 6): for each hidden unit three for the direction, then three for the feature
uniform sampler2D weights1;  // (h, 3)

layout(location = 0) out vec4 colour;
layout(location = 1) out uint far;  // the bits of a float: not every device can draw to a texture of floats

const float AMBIENT = 0.25;  // share of the colour that remains where a surface is seen edge-on

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
#elif defined(MLP_DEEP)
  return 1.0 / (1.0 + exp(-mlp(direction, place)));
#elif defined(MLP_TEXTURES) || defined(MLP_CONSTANTS)
  return 1.0 / (1.0 + exp(-mlp(direction, texture(mlpFeatures, place).rgb)));
#else
  return vec3(0.0);
#endif
}

void main() {
  float distance = length(along);
  vec3 direction = along / distance, across = cross(dFdx(along), dFdy(along));
#ifdef HOLES
  if (texture(opaque, place).r < 0.5) discard;
#endif
  float facing = abs(dot(across, direction)) / max(length(across), 1e-30);
  vec3 base = texture(diffuse, place).rgb * share * mix(1.0, AMBIENT + (1.0 - AMBIENT) * facing, lit);
  colour = vec4(clamp(base + specular(direction), 0.0, 1.0), 1.0);
  far = floatBitsToUint(distance);
}
