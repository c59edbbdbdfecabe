#version 300 es
// A picture of triangles alone: the mean over a pixel's rays, coloured by mesh.glsl, on the background.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

uniform sampler2D meshColour;
uniform usampler2D meshFar;  // distances, as the bits of a float; infinite: no triangle
uniform ivec2 corner;        // the pixel of the first texel of both
uniform vec3 background;
uniform int rays;            // rays along an edge of a pixel
uniform int mode;            // what to show: one of the modes below
uniform vec2 range;          // of depth, in world units
uniform vec2 aim;            // PICK: the pixel to measure

out vec4 colour;

const int DEPTH = 2, PICK = 4;

void main() {
  if (mode == PICK) {
    // The distance in 24 bits, as a fraction of the range's end, and whether there is a triangle.
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
