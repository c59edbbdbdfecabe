#version 300 es
// March a ray per pixel through a PageField (nerfbake/scene/page.py describes its arrays). This part has the inputs,
// the basis functions and the lookup of a voxel. march.glsl and smooth.glsl march the ray, shown.glsl computes the
// picture, and shells.glsl combines the parts of a ray in the inner cube and in the shells around it.
//
// The page inserts these definitions before the first line of code:
//   GROUPS   groups of four basis functions after the first one: 0, 1, 2, 4 or 6
//   BASE     the first basis function; 1 for RGBA
//   TEXELS   texels in a row of colours, 1 + 3 GROUPS
//   SHELLS   shells around the inner cube; 0: no scenery. AROUND: top cells along an edge of a shell's cube
//   MESHES   1: the page has triangles, drawn by mesh.glsl; 0: it has none
//   SMOOTH   1: trilinear lookup, march() of smooth.glsl; 0: nearest lookup, march() of march.glsl
//   NORMALS  1: mode is SLOPE
//   BYTES    1: coefficients are bytes, and densities have a texture of their own; 0: all values are float16
precision highp float;
precision highp int;
precision highp isampler3D;
precision highp usampler2D;
precision highp sampler2D;

uniform isampler3D top;     // negative: empty; from 0: a leaf; from WHOLE: row of the whole cell, plus WHOLE
uniform usampler2D blocks;  // eight 4^3 blocks per leaf: both halves of the mask, first row, bits of the lower half and flags
uniform sampler2D texels;   // red, green, blue of the first coefficient and the density; then the other coefficients
uniform sampler2D densities;
uniform vec3 lows[4 * GROUPS + 1];     // for each basis function: a coefficient is lows + widths * texel
uniform float widths[4 * GROUPS + 1];
uniform int blockBits;      // a line of `blocks` has 2^blockBits texels
uniform int rowsAcross;     // rows per line of `texels`
uniform float densityUnit;

uniform vec3 eye;           // position of the camera, in voxels
uniform mat3 toVoxels;      // from the camera to voxels, and to the axes of the spherical harmonics
uniform mat3 toAxes;
uniform mat3 worldToVoxels; // its transpose converts gradients to the world
uniform vec3 boxLow;
uniform vec3 boxHigh;
uniform vec2 size;          // of the picture, in pixels
uniform float focal;        // in pixels
uniform float cut;          // a ray ends when its transmittance is below this
uniform vec3 background;
uniform int rays;           // rays along an edge of a pixel
uniform int mode;           // what to show: one of the modes below
uniform vec2 range;         // of depth, in world units
uniform vec2 aim;           // PICK: the pixel to measure

#if SHELLS
uniform isampler3D around;     // like `top`, for each shell's cube, one after the other along x
uniform vec4 frames[SHELLS];   // voxels of a shell's cube = xyz + w * voxels of the inner cube
uniform bool alone;            // true: only the inner cube is drawn
int shell = 0;                 // the cube that is marched: 0 is the inner cube
float partFrom, partTo;        // the part of the ray in it: distances from the origin, in world units
#endif

#if MESHES
uniform sampler2D meshColour;      // colour of each ray's triangle
uniform highp usampler2D meshFar;  // distance of that triangle, as the bits of a float; infinite: no triangle
uniform ivec2 corner;              // the pixel of the first texel of both
uniform bool ztest;                // true: a ray's triangle hides the whole field, or none of it
uniform vec3 light;                // direction to the light, in camera axes; zero: no shadows
#else
const bool ztest = false;
#endif

out vec4 colour;

const int WHOLE = 1 << 30;
const uint ALL = 255u;      // in place of a block's count of bits: the whole block has one row
const int WIDE = 8;         // a block's lowest flag of an octant that has one row
const int COLOUR = 0, FIRST = 1, DEPTH = 2, STEPS = 3, PICK = 4, SLOPE = 5;
const int LIMIT = 1 << 14;  // maximum number of steps
const float SHADE = 0.4;    // share of a mesh's colour that remains where the field blocks all light from above
float stop = 1e30;          // maximum distance from the origin, in world units
vec3 origin;                // start of the ray, in voxels
bool dark = false;          // true: the ray's colour is not needed

struct Found { vec3 colour; float alpha; float far; int steps; };  // colour: the normal if mode is SLOPE

vec4 basis[GROUPS + 1];     // basis functions in the ray's direction, times `widths`
vec3 base;                  // sum of a colour before its coefficients are added

// The basis functions after the first one, four at a time, as in nerfbake/kernels/march/sh.py.
void fillBasis(vec3 p) {
#if GROUPS > 0
  float x = p.x, y = p.y, z = p.z, xx = x * x, yy = y * y, zz = z * z;
  for (int i = 0; i <= GROUPS; i++) basis[i] = vec4(0.0);
  basis[0].xyz = 0.4886025119029199 * vec3(-y, z, -x);
#endif
#if GROUPS > 1
  const float k = 1.0925484305920792;
  basis[0].w = k * x * y;
  basis[1] = vec4(-k * y * z, 0.31539156525252005 * (2.0 * zz - xx - yy), -k * x * z, 0.5 * k * (xx - yy));
#endif
#if GROUPS > 2
  const float a0 = 0.3731763325901154, a1 = 0.4570457994644658, a2 = 1.445305721320277, a3 = 0.5900435899266435;
  float side = 4.0 * zz - xx - yy;
  basis[2] = vec4(-a3 * y * (3.0 * xx - yy), 2.0 * a2 * x * y * z, -a1 * y * side, a0 * z * (2.0 * zz - 3.0 * (xx + yy)));
  basis[3].xyz = vec3(-a1 * x * side, a2 * z * (xx - yy), -a3 * x * (xx - 3.0 * yy));
#endif
#if GROUPS > 4
  const float b0 = 0.10578554691520431, b1 = 0.6690465435572892, b2 = 0.47308734787878004;
  const float b3 = 1.7701307697799304, b4 = 0.6258357354491761;
  basis[3].w = 4.0 * b4 * x * y * (xx - yy);
  basis[4] = vec4(-b3 * y * z * (3.0 * xx - yy), 2.0 * b2 * x * y * (7.0 * zz - 1.0), -b1 * y * z * (7.0 * zz - 3.0),
                  b0 * (zz * (35.0 * zz - 30.0) + 3.0));
  basis[5] = vec4(-b1 * x * z * (7.0 * zz - 3.0), b2 * (xx - yy) * (7.0 * zz - 1.0), -b3 * x * z * (xx - 3.0 * yy),
                  b4 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)));
#endif
}

// Unrolled, with constant indices: with software rendering, counting in a loop costs more than the body of the loop.
#if GROUPS == 0
#define EACH_GROUP(DO)
#elif GROUPS == 1
#define EACH_GROUP(DO) DO(0)
#elif GROUPS == 2
#define EACH_GROUP(DO) DO(0) DO(1)
#elif GROUPS == 4
#define EACH_GROUP(DO) DO(0) DO(1) DO(2) DO(3)
#else
#define EACH_GROUP(DO) DO(0) DO(1) DO(2) DO(3) DO(4) DO(5)
#endif

// Four basis functions in a ray's direction, times the widths of their coefficients. Adds their lows to `base`.
vec4 weighed(vec4 four, int i) {
  if (mode != FIRST) base += four.x * lows[i + 1] + four.y * lows[i + 2] + four.z * lows[i + 3] + four.w * lows[i + 4];
  return four * vec4(widths[i + 1], widths[i + 2], widths[i + 3], widths[i + 4]);
}

// Compute the basis for a ray's direction, given in the field's own axes.
void face(vec3 along) {
  fillBasis(along);
  base = BASE * lows[0];
#define WEIGH(i) basis[i] = weighed(basis[i], 4 * i);
  EACH_GROUP(WEIGH)
}

// The number of bits that are set. GLSL ES 3.00 has no bitCount.
uint count(uint bits) {
  bits -= bits >> 1 & 0x55555555u;
  bits = (bits & 0x33333333u) + (bits >> 2 & 0x33333333u);
  return (bits + (bits >> 4) & 0x0F0F0F0Fu) * 0x01010101u >> 24;
}

ivec2 placeOf(int row) {
  int line = row / rowsAcross;
  return ivec2((row - line * rowsAcross) * TEXELS, line);
}

// Red, green and blue of a row's first coefficient, and its density per world unit.
vec4 headOf(ivec2 place) {
  vec4 head = texelFetch(texels, place, 0);
#if BYTES
  head.a = texelFetch(densities, ivec2(place.x / TEXELS, place.y), 0).r;
#endif
  head.a *= densityUnit;
  return head;
}

// The part of a row's colour from four coefficients of each colour; place: the first of their texels.
vec3 partOf(vec4 k, ivec2 place) {
  vec4 a = texelFetch(texels, place, 0), b = texelFetch(texels, place + ivec2(1, 0), 0);
  vec4 c = texelFetch(texels, place + ivec2(2, 0), 0);
  return k.x * a.rgb + k.y * vec3(a.a, b.rg) + k.z * vec3(b.ba, c.r) + k.w * c.gba;
}

// The sum whose sigmoid is a row's colour in the ray's direction; first: the row's headOf().
vec3 sumOf(vec3 first, ivec2 place) {
  vec3 sum = base + BASE * widths[0] * first;
#define ADD(i) sum += partOf(basis[i], place + ivec2(3 * i + 1, 0));
  if (mode != FIRST) { EACH_GROUP(ADD) }
  return sum;
}

vec3 sigmoid(vec3 sum) {
  return 1.0 / (1.0 + exp(-sum));
}

int topAt(ivec3 cell) {
#if SHELLS
  if (shell > 0) return texelFetch(around, cell + ivec3((shell - 1) * AROUND, 0, 0), 0).r;
#endif
  return texelFetch(top, cell, 0).r;
}

// The row at a voxel, or -1; and a cube around the voxel with the same contents: its lowest corner and its edge.
int look(ivec3 voxel, out ivec3 corner, out int edge) {
  ivec3 cell = voxel >> 3;
  int here = topAt(cell);
  if (here < 0) {
    int away = -here - 1;
    corner = (cell - away) << 3;
    edge = 8 * (2 * away + 1);
    return -1;
  }
  if (here >= WHOLE) {
    corner = cell << 3;
    edge = 8;
    return here - WHOLE;
  }
  ivec3 part = voxel >> 2 & 1;
  int number = 8 * here + 4 * part.x + 2 * part.y + part.z;
  uvec4 block = texelFetch(blocks, ivec2(number & (1 << blockBits) - 1, number >> blockBits), 0);
  corner = voxel & ~3;
  edge = 4;
  if ((block.x | block.y) == 0u) return -1;
  if (block.w == ALL) return int(block.z);
  ivec3 i = voxel & 3;
  edge = 1 + int(block.w >> WIDE + (2 * (i.x & 2) | i.y & 2 | i.z >> 1) & 1u);
  corner = voxel & -edge;
  i &= 4 - edge;
  bool upper = i.x > 1;
  uint mask = upper ? block.y : block.x, bit = uint((i.x & 1) << 4 | i.y << 2 | i.z);
  if ((mask >> bit & 1u) != 0u) return int(block.z + (upper ? block.w & 255u : 0u) + count(mask & (1u << bit) - 1u));
  if ((mask & 0x00330033u << uint((i.y & 2) << 2 | i.z & 2)) == 0u) {
    corner = voxel & ~1;
    edge = 2;
  }
  return -1;
}

bool outside(ivec3 voxel) {
  ivec3 cells = textureSize(top, 0);
#if SHELLS
  if (shell > 0) cells = ivec3(AROUND);
#endif
  return any(lessThan(voxel, ivec3(0))) || any(greaterThanEqual(voxel, cells * 8));
}

// The row at any voxel; -1 in empty space and outside the grid.
int rowAt(ivec3 voxel) {
  ivec3 corner;
  int edge;
  return outside(voxel) ? -1 : look(voxel, corner, edge);
}
