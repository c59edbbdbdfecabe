// March with interpolation between the centres of voxels, as nerfbake/kernels/march/traversal_smooth.py does: density
// is trilinear, and coefficients are weighted by density. A ray crosses the cubes between eight centres. Along the ray,
// density is a cubic within each cube, and two Gauss points integrate it exactly.

#if SMOOTH
const float GAUSS = 0.21132486540518712;  // of an interval: its first Gauss point; the second is as far from the end

// At a voxel: density times the sum whose sigmoid is the colour (0 if no colour is needed), then density.
vec4 cornerAt(ivec3 voxel) {
  int row = rowAt(voxel);
  if (row < 0) return vec4(0.0);
  ivec2 place = placeOf(row);
  vec4 first = headOf(place);
  return mode <= FIRST && !dark ? vec4(first.a * sumOf(first.rgb, place), first.a) : vec4(vec3(0.0), first.a);
}

// The edge of a cube of empty cubes that contains this one, and its lowest corner; 0 if there is none.
int emptyAt(ivec3 cube, out ivec3 corner) {
  int edge = 0;
  if (outside(cube) || look(cube, corner, edge) >= 0 || any(greaterThanEqual(cube - corner, ivec3(edge - 1)))) return 0;
  return edge - 1;
}

// A vector opposite to the gradient of the interpolated density in a cube.
vec3 slopeOf(vec4 c[8], vec3 f) {
  vec4 low = vec4(c[0].a, c[1].a, c[2].a, c[3].a), high = vec4(c[4].a, c[5].a, c[6].a, c[7].a);  // at lower, upper x
  vec4 along = low - high, here = mix(low, high, f.x);
  float x = mix(mix(along.x, along.y, f.z), mix(along.z, along.w, f.z), f.y);
  return vec3(x, mix(here.x - here.z, here.y - here.w, f.z), mix(here.x - here.y, here.z - here.w, f.y));
}

void marchCube(vec3 along, inout Found found, inout float through) {
  Way way;
  // Positions count from the centre of the first voxel.
  if (!enter(along, 0.5, way)) return;
  ivec3 next = ivec3(clamp(floor(way.from), way.low, way.high)), cube, lower;
  vec4 corners[8];
  int width, axis, shared, came = -1;  // the axis along which the cube before this one shares corners; -1: none
  float t = 0.0, near;
  for (bool inside = true; inside && through >= cut;) {
    do {
      found.steps++;
      cube = next;
      near = t;
      shared = came;
      width = emptyAt(cube, lower);
      inside = leave(way, width > 0 ? lower : cube, max(width, 1), t, next, axis) && found.steps < LIMIT;
      came = width > 0 ? -1 : axis;
    } while (width > 0 && inside);
    if (width > 0) break;
    bool upward = shared >= 0 && way.d[max(shared, 0)] > 0.0;
    vec4 old[8] = corners;
    for (int i = 0; i < 8; i++) {
      ivec3 side = ivec3(i >> 2, i >> 1 & 1, i & 1);
      if (shared >= 0 && (side[shared] == 0) == upward) {
        corners[i] = shared == 0 ? old[i ^ 4] : shared == 1 ? old[i ^ 2] : old[i ^ 1];
      } else {
        corners[i] = cornerAt(cube + side);
      }
    }
    float stretch = min(t, way.end) - near;
    for (int point = 0; point < 2; point++) {
      float at = near + stretch * (point == 0 ? GAUSS : 1.0 - GAUSS);
      vec3 f = way.from + at * way.d - vec3(cube);
      vec4 a = mix(mix(corners[0], corners[1], f.z), mix(corners[2], corners[3], f.z), f.y);
      vec4 b = mix(mix(corners[4], corners[5], f.z), mix(corners[6], corners[7], f.z), f.y);
      vec4 here = mix(a, b, f.x);
      if (here.a > 0.0) {
        float kept = exp(-here.a * 0.5 * stretch * way.unit), weight = through * (1.0 - kept);
        if (mode <= FIRST && !dark) found.colour += weight * sigmoid(here.rgb / here.a);
#if NORMALS
        found.colour += weight * slopeOf(corners, f);
#endif
        if (mode == DEPTH || mode == PICK || ztest) found.far += weight * (way.start + at) * way.unit;
        through *= kept;
      }
    }
  }
}
#endif
