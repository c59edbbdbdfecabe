#version 300 es
// Project the vertices of triangles for a camera that looks along -z.
precision highp float;

in vec3 position;  // in the world
in vec2 uv;
in vec3 tint;

uniform vec3 eye;
uniform mat3 toCamera;  // from the world to right, up, back
uniform vec2 lens;      // share of half the picture that a slope of 1 covers, across and up
uniform vec2 range;     // the nearest and the farthest depth that can be represented

out vec3 along;  // from the camera to the vertex, in the world
out vec2 place;
out vec3 share;

void main() {
  along = position - eye;
  place = uv;
  share = tint;
  vec3 seen = toCamera * along;
  float depth = (range.y + range.x) * seen.z + 2.0 * range.x * range.y;
  gl_Position = vec4(lens * seen.xy, depth / (range.x - range.y), -seen.z);
}
