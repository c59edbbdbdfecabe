#version 300 es
// The picture of splats: their sum on the background, or their depth.
precision highp float;

uniform sampler2D sum;     // premultiplied by alpha
uniform vec3 background;
uniform int mode;          // what to show: one of the modes below
uniform vec2 range;        // of depth, in world units
uniform vec2 size;         // of the picture, in pixels
uniform vec2 corner;       // the picture's pixel at the lower left
uniform float focal;       // in pixels

out vec4 colour;

const int DEPTH = 2, PICK = 4;

void main() {
  vec4 found = texelFetch(sum, ivec2(gl_FragCoord.xy), 0);
  // Depths were blended as shares of the farthest one, along the optical axis.
  vec2 slope = (gl_FragCoord.xy + corner - 0.5 * size) / focal;
  float part = found.r / max(found.a, 1e-6) * length(vec3(slope, 1.0));
  if (mode == PICK) {
    vec3 digits = floor(fract(clamp(part, 0.0, 0.9999999) * vec3(1.0, 256.0, 65536.0)) * 256.0);
    colour = vec4(digits / 255.0, found.a);
  } else if (mode == DEPTH) {
    float depth = (part * range.y - range.x) / (range.y - range.x);
    colour = vec4(mix(background, vec3(1.0 - 0.85 * clamp(depth, 0.0, 1.0)), found.a), 1.0);
  } else {
    colour = vec4(min(found.rgb + (1.0 - found.a) * background, 1.0), 1.0);
  }
}
