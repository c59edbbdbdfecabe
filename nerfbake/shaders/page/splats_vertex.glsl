#version 300 es
// A corner of the triangle around the ellipse in which a splat's alpha is at least 1/255. Two triangles around a
// parallelogram would cover a quarter less, but take more time than that where splats are small.
precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D first;   // splats_project.glsl has written both
uniform usampler2D second;
uniform int bits;
uniform vec2 size;     // of the picture, in pixels
uniform vec2 corner;   // the picture's pixel at the lower left of what is drawn to
uniform ivec2 range;   // the first splat, and the one after the last

flat out vec2 centre;
flat out vec3 inverse;  // of the covariance: xx, xy, yy
flat out vec4 shade;    // red, green, blue, opacity

const int SPLATS = 4096;  // of an instance
const float PAD = 0.0625;  // pixels: the rasteriser rounds corners

void main() {
  int splat = range.x + gl_InstanceID * SPLATS + gl_VertexID / 3;
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  centre = vec2(0.0);
  inverse = vec3(0.0);
  shade = vec4(0.0);
  if (splat >= range.y) return;
  ivec2 texel = ivec2(splat & ((1 << bits) - 1), splat >> bits);
  uvec4 b = texelFetch(second, texel, 0);
  if (b.z == 0u) return;
  vec4 a = uintBitsToFloat(texelFetch(first, texel, 0));
  vec2 more = uintBitsToFloat(b.xy), thick = unpackHalf2x16(b.z), others = unpackHalf2x16(b.w);
  inverse = vec3(a.zw, more.x);
  shade = vec4(thick.y, others, thick.x);
  // An ellipse is the image of the unit circle under two conjugate vectors. The longer axis has no part of the shorter.
  vec3 covariance = more.y * vec3(more.x, -a.w, a.z);
  float reach = 2.0 * max(log(255.0 * thick.x), 0.0) + 0.05;
  bool wide = covariance.x >= covariance.z;
  float longest = wide ? covariance.x : covariance.z, length = sqrt(reach * longest);
  vec2 along = vec2(length + PAD, (length + PAD) * covariance.y / longest), beside = vec2(0.0, sqrt(reach * more.y / longest) + 2.0 * PAD);
  // The corners of an equilateral triangle around the unit circle.
  int side = gl_VertexID % 3;
  vec2 at = side == 0 ? vec2(0.0, 2.0) : vec2(side == 1 ? -sqrt(3.0) : sqrt(3.0), -1.0), from = at.x * along + at.y * beside;
  centre = a.xy - corner;
  gl_Position = vec4(2.0 * (a.xy + (wide ? from : from.yx)) / size - 1.0, 0.5, 1.0);
}
