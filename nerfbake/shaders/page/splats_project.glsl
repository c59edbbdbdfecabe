// The ellipse and the colour of each splat in a picture, in the order of depth: docs/conventions.md, "How a picture of
// splats is made". The page inserts before this file: the version, nerfbake/shaders/glsl/harmonics.glsl, and
//   FUNCTIONS  coefficients of a colour: 1, 4, 9, 16 or 25
//   TEXELS     texels of a splat in `rest`
precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D words;  // two texels a splat, as splatsOf() in splats.js packs them
uniform usampler2D rest;   // TEXELS texels a splat: a byte for each higher coefficient
uniform usampler2D order;  // the numbers of the splats, nearest first
uniform int bits;          // 2^bits splats in a line of each texture
uniform int count;         // of the splats in the order
uniform int line;          // of the order's texture, at which it starts
uniform float times;       // each splat stands for so many
uniform vec3 eye;
uniform mat3 axes;      // right, up, back of the camera, as columns
uniform vec2 size;      // of the picture, in pixels
uniform float focal;    // in pixels
uniform float blur;     // square pixels that the splats were trained with; 0: their opacity compensates for the blur
uniform int mode;       // what to show
uniform float farthest; // the depth that becomes 1
uniform mat4x3 place;   // from the world to the crop box
uniform vec3 lowest;    // of the crop box
uniform vec3 highest;

layout(location = 0) out uvec4 first;   // bits of floats: centre x, y in pixels, inverse covariance xx, xy
layout(location = 1) out uvec4 second;  // yy, and the determinant of the covariance; halves: opacity, red, green, blue

const int FIRST = 1, DEPTH = 2, PICK = 4;
const float NEAR = 0.01, BLUR = 0.3, SEEN = 1.0 / 255.0, LEAST_SHARE = 2.5e-5, MARGIN = 1.3, MOST = 6e4;
const float DENSE = 0.9;  // opacity up to which a splat that stands for several becomes denser, and then larger

int signedAt(uint word, int shift, int width) {
  return int(word << uint(32 - width - shift)) >> (32 - width);
}

#if FUNCTIONS > 1
float restAt(ivec2 texel, int k) {
  return float(signedAt(texelFetch(rest, texel + ivec2(k >> 4, 0), 0)[(k >> 2) & 3], 8 * (k & 3), 8)) / 32.0;
}
#endif

// The columns of the rotation from a splat's own axes to the world.
mat3 turnOf(uint word) {
  vec3 others = (vec3((uvec3(word) >> uvec3(8u, 16u, 24u)) & 255u) - 127.0) / (127.0 * sqrt(2.0));
  float largest = sqrt(max(1.0 - dot(others, others), 0.0));
  uint at = word & 255u;
  vec4 q = at == 0u ? vec4(largest, others) : at == 1u ? vec4(others.x, largest, others.yz)
      : at == 2u ? vec4(others.xy, largest, others.z) : vec4(others, largest);
  q = normalize(q);
  float w = q.x, a = q.y, b = q.z, c = q.w;
  return mat3(
      1.0 - 2.0 * (b * b + c * c), 2.0 * (a * b + w * c), 2.0 * (a * c - w * b),
      2.0 * (a * b - w * c), 1.0 - 2.0 * (a * a + c * c), 2.0 * (b * c + w * a),
      2.0 * (a * c + w * b), 2.0 * (b * c - w * a), 1.0 - 2.0 * (a * a + b * b));
}

void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  first = second = uvec4(0u);
  if ((pixel.y << bits) + pixel.x >= count) return;
  int splat = int(texelFetch(order, pixel + ivec2(0, line), 0).r);
  ivec2 at = ivec2(splat & ((1 << bits) - 1), splat >> bits);
  uvec4 word = texelFetch(words, ivec2(2 * at.x, at.y), 0), more = texelFetch(words, ivec2(2 * at.x + 1, at.y), 0);
  vec3 mean = uintBitsToFloat(word.xyz), away = mean - eye, seen = away * axes;
  float z = -seen.z, opacity = float(more.z >> 16) / 255.0;
  vec3 inBox = place * vec4(mean, 1.0);
  if (z <= NEAR || opacity < SEEN || any(lessThan(inBox, lowest)) || any(greaterThan(inBox, highest))) return;
  vec2 slope = seen.xy / z, most = MARGIN * size / (2.0 * focal), bent = clamp(slope, -most, most);
  // The rows of the Jacobian times the camera's axes, then times the axes of the splat.
  vec3 across = (axes[0] + bent.x * axes[2]) * (focal / z), down = (axes[1] + bent.y * axes[2]) * (focal / z);
  float dense = min(times * opacity, max(opacity, DENSE)), larger = sqrt(times * opacity / dense);
  opacity = dense;
  vec3 scale = larger * exp((vec3((uvec3(more.x) >> uvec3(0u, 10u, 20u)) & 1023u) - 640.0) / 16.0);
  mat3 turn = turnOf(word.w);
  vec3 p = scale * (across * turn), q = scale * (down * turn), minors = cross(p, q);
  // dot(p, p) dot(q, q) - dot(p, q)^2, without the cancellation of large numbers.
  float xx = dot(p, p), xy = dot(p, q), yy = dot(q, q), sharp = dot(minors, minors);
  float det = sharp + BLUR * (xx + yy) + BLUR * BLUR, sharper = sharp + blur * (xx + yy) + blur * blur;
  opacity *= sqrt(max(LEAST_SHARE, sharper / det));
  if (opacity < SEEN) return;
  xx += BLUR;
  yy += BLUR;
  vec2 centre = focal * slope + 0.5 * size, reach = sqrt(2.0 * log(255.0 * opacity) * vec2(xx, yy)) + 1.0;
  if (any(greaterThan(abs(centre - 0.5 * size), 0.5 * size + reach))) return;
  vec3 colour = vec3(z / farthest);
  if (mode != DEPTH && mode != PICK) {
    vec3 dc = vec3(signedAt(more.y, 0, 16), signedAt(more.y, 16, 16), signedAt(more.z, 0, 16)) / 64.0;
    Harmonics h = harmonics(normalize(away), mode == FIRST ? 1 : FUNCTIONS);
    colour = 0.5 + h.f[0] * dc;
#if FUNCTIONS > 1
    ivec2 texel = ivec2(at.x * TEXELS, at.y);
    if (mode != FIRST) {
      for (int k = 0; k < FUNCTIONS - 1; k++) {
        colour += h.f[k + 1] * vec3(restAt(texel, 3 * k), restAt(texel, 3 * k + 1), restAt(texel, 3 * k + 2));
      }
    }
#endif
    colour = clamp(colour, 0.0, MOST);
  }
  first = floatBitsToUint(vec4(centre, yy / det, -xy / det));
  second = uvec4(floatBitsToUint(vec2(xx / det, det)), packHalf2x16(vec2(opacity, colour.r)), packHalf2x16(colour.gb));
}
