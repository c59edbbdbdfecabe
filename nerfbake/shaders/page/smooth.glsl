// The same between the centres of voxels, where density is interpolated, and coefficients by density: what
// nerfbake/kernels/march/traversal_smooth.py does. A ray goes through the cubes between eight centres; along it, density
// is a cubic there, whose integral two Gauss points give exactly.

#if SMOOTH
const float GAUSS = 0.21132486540518712;  // of a stretch: the first of its two points, the other is as far from the end

// Density, and density times what the colour is the sigmoid of (or the normal), at a voxel.
vec4 cornerAt(ivec3 voxel) {
  ivec3 corner;
  int edge;
  if (any(lessThan(voxel, ivec3(0))) || any(greaterThanEqual(voxel, textureSize(top, 0) * 8))) return vec4(0.0);
  int row = look(voxel, corner, edge);
  if (row < 0) return vec4(0.0);
  ivec2 place = placeOf(row);
  vec4 first = headOf(place);
  return mode <= FIRST && !dark ? vec4(first.a * sumOf(first.rgb, place), first.a) : vec4(vec3(0.0), first.a);
}

// How far all of the cubes from this one on are empty: 0, or the edge of the cubes and their lowest corner.
int emptyAt(ivec3 cube, out ivec3 corner) {
  int edge = 0;
  if (any(lessThan(cube, ivec3(0))) || any(greaterThanEqual(cube, textureSize(top, 0) * 8))) return 0;
  if (look(cube, corner, edge) >= 0 || any(greaterThanEqual(cube - corner, ivec3(edge - 1)))) return 0;
  return edge - 1;
}

// Against the interpolated density's gradient in a cube.
vec3 slopeOf(vec4 c[8], vec3 f) {
  vec4 low = vec4(c[0].a, c[1].a, c[2].a, c[3].a), high = vec4(c[4].a, c[5].a, c[6].a, c[7].a);  // of x: y, then z
  vec4 along = low - high, here = mix(low, high, f.x);
  float x = mix(mix(along.x, along.y, f.z), mix(along.z, along.w, f.z), f.y);
  return vec3(x, mix(here.x - here.z, here.y - here.w, f.z), mix(here.x - here.y, here.z - here.w, f.y));
}

Found marchSmooth(vec3 along) {
  Found found = Found(vec3(0.0), 0.0, 0.0, 0);
  vec3 world = normalize(along), d = toVoxels * world;
  float scale = length(d), unit = 1.0 / scale;
  d /= scale;
  d = mix(d, vec3(1e-12), lessThan(abs(d), vec3(1e-12)));
  // Positions count from the first voxel's centre.
  vec3 inverse = 1.0 / d, one = (boxLow - origin) * inverse, other = (boxHigh - origin) * inverse;
  vec3 near = min(one, other), away = max(one, other);
  float start = max(max(near.x, near.y), max(near.z, 0.0)), end = min(min(away.x, stop * scale), min(away.y, away.z)) - start;
  if (end <= 0.0) return found;
  face(normalize(toAxes * world));
  vec3 o = origin - 0.5 + start * d;
  ivec3 low = ivec3(floor(boxLow - 0.5)), high = ivec3(ceil(boxHigh - 0.5)) - 1;
  ivec3 cube = clamp(ivec3(floor(o)), low, high);
  vec4 corners[8];
  int shared = -1;  // the axis along which the cube before lies beside this one; -1: none does
  float t = 0.0, through = 1.0;
  for (int step = 0; step < LIMIT && t < end; step++) {
    found.steps++;
    ivec3 lower = cube;
    int width = emptyAt(cube, lower);
    bool empty = width > 0;
    if (!empty) {
      lower = cube;
      width = 1;
    }
    vec3 exits = (vec3(lower) + mix(vec3(0.0), vec3(width), greaterThan(d, vec3(0.0))) - o) * inverse;
    float ahead = max(min(exits.x, min(exits.y, exits.z)), t);
    if (!empty) {
      bool upward = shared >= 0 && d[max(shared, 0)] > 0.0;
      vec4 old[8] = corners;
      for (int i = 0; i < 8; i++) {
        ivec3 side = ivec3(i >> 2, i >> 1 & 1, i & 1);
        if (shared >= 0 && (side[shared] == 0) == upward) {
          corners[i] = shared == 0 ? old[i ^ 4] : shared == 1 ? old[i ^ 2] : old[i ^ 1];
        } else {
          corners[i] = cornerAt(cube + side);
        }
      }
      float stretch = min(ahead, end) - t;
      for (int point = 0; point < 2; point++) {
        float at = t + stretch * (point == 0 ? GAUSS : 1.0 - GAUSS);
        vec3 f = o + at * d - vec3(cube);
        vec4 a = mix(mix(corners[0], corners[1], f.z), mix(corners[2], corners[3], f.z), f.y);
        vec4 b = mix(mix(corners[4], corners[5], f.z), mix(corners[6], corners[7], f.z), f.y);
        vec4 here = mix(a, b, f.x);
        if (here.a > 0.0) {
          float kept = exp(-here.a * 0.5 * stretch * unit), weight = through * (1.0 - kept);
          if (mode <= FIRST && !dark) found.colour += weight * sigmoid(here.rgb / here.a);
#if NORMALS
          found.colour += weight * slopeOf(corners, f);
#endif
          if (mode == DEPTH || mode == PICK || ztest) found.far += weight * (start + at) * unit;
          through *= kept;
        }
      }
      if (through < cut) break;
    }
    t = ahead;
    ivec3 next = clamp(clamp(ivec3(floor(o + t * d)), lower, lower + width - 1), low, high);
    int axis = exits.x <= exits.y && exits.x <= exits.z ? 0 : exits.y <= exits.z ? 1 : 2;
    next[axis] = d[axis] > 0.0 ? lower[axis] + width : lower[axis] - 1;
    if (next[axis] < low[axis] || next[axis] > high[axis]) break;
    cube = next;
    shared = empty ? -1 : axis;
  }
  found.alpha = 1.0 - through;
  return found;
}
#endif
