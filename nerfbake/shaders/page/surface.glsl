#version 300 es
// A picture of triangles alone: the mean of a pixel's rays, which mesh.glsl has coloured, over the background.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

uniform sampler2D meshColour;
uniform usampler2D meshFar;  // distances as a float's bits; infinite where there is no triangle
uniform ivec2 corner;        // the pixel that their first texel belongs to
uniform vec3 background;
uniform int rays;            // along an edge of a pixel
uniform int mode;            // what is shown: one of those below
uniform vec2 range;          // of depth, in world units
uniform vec2 aim;            // PICK: the pixel

out vec4 colour;

const int DEPTH = 2, PICK = 4;

void main() {
  if (mode == PICK) {
    // The distance as 24 bits of the range's end, and whether there is anything.
    float far = uintBitsToFloat(texelFetch(meshFar, ivec2(aim) - corner, 0).r);
    vec3 digits = floor(fract(clamp(far / range.y, 0.0, 0.9999999) * vec3(1.0, 256.0, 65536.0)) * 256.0);
    colour = vec4(digits / 255.0, isinf(far) ? 0.0 : 1.0);
    return;
  }
  vec3 sum = vec3(0.0);
  ivec2 first = (ivec2(gl_FragCoord.xy) - corner) * rays;
  for (int i = 0; i < rays * rays; i++) {
    ivec2 texel = first + ivec2(i % rays, i / rays);
    float far = uintBitsToFloat(texelFetch(meshFar, texel, 0).r);
    if (isinf(far)) sum += background;
    else if (mode == DEPTH) sum += 1.0 - 0.85 * clamp((far - range.x) / (range.y - range.x), 0.0, 1.0);
    else sum += texelFetch(meshColour, texel, 0).rgb;
  }
  colour = vec4(sum / float(rays * rays), 1.0);
}
