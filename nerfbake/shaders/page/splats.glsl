#version 300 es
// A splat's share of a pixel. It is blended with what is before it.
precision highp float;

flat in vec2 centre;
flat in vec3 inverse;
flat in vec4 shade;

out vec4 colour;

void main() {
  vec2 d = gl_FragCoord.xy - centre;
  float alpha = min(shade.a * exp(-0.5 * (inverse.x * d.x * d.x + inverse.z * d.y * d.y) - inverse.y * d.x * d.y), 0.99);
  if (alpha < 1.0 / 255.0) discard;
  colour = vec4(alpha * shade.rgb, alpha);
}
