#version 300 es
// Writes the depth of a pixel that is opaque.
precision highp float;

uniform sampler2D sum;

const float OPEN = 1.0 / 1024.0;  // transmittance: half floats have no value between that and the next below 1

void main() {
  if (texelFetch(sum, ivec2(gl_FragCoord.xy), 0).a < 1.0 - OPEN) discard;
}
