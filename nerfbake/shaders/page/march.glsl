// March from voxel to voxel; steps through empty space are as large as the grid allows. Density and colour are constant
// within a voxel, so sums along the ray are exact. `nerfbake render` computes the same in float64; this is float32.

// The part of a ray inside the box. Positions and distances are in voxels.
struct Way {
  vec3 d, inverse;  // unit direction of the ray, and 1 / d
  vec3 upward;      // 1 where d is positive, else 0
  vec3 from;        // where the ray enters the box; distances count from here, so they stay small and exact
  float start;      // distance from the ray's origin to `from`
  float end;        // distance from `from` to where the ray leaves the box or stops
  float unit;       // length of one voxel along the ray, in world units
  vec3 low, high;   // the lowest and the highest cube that the ray can reach
};

// Compute the way of a ray. along: its direction in camera axes; shift: offset of the cubes' lower corners from
// integers. Returns false if the ray misses the box.
bool enter(vec3 along, float shift, out Way way) {
  vec3 world = normalize(along), d = toVoxels * world;
  float scale = length(d);
  d /= scale;
  // Replace components near 0 (rays parallel to an axis), to avoid a division by 0.
  way.d = d = mix(d, vec3(1e-12), lessThan(abs(d), vec3(1e-12)));
  way.inverse = 1.0 / d;
  vec3 from = origin, low = boxLow, high = boxHigh;
#if SHELLS
  if (shell > 0) {
    from = frames[shell - 1].xyz + frames[shell - 1].w * origin;
    scale *= frames[shell - 1].w;
    low = vec3(0.0);
    high = vec3(8 * AROUND);
  }
#endif
  vec3 one = (low - from) * way.inverse, other = (high - from) * way.inverse;
  vec3 near = min(one, other), away = max(one, other);
  way.start = max(max(near.x, near.y), max(near.z, 0.0));
  float last = stop;
#if SHELLS
  way.start = max(way.start, partFrom * scale);
  last = min(last, partTo);
#endif
  way.end = min(min(away.x, last * scale), min(away.y, away.z)) - way.start;
  way.upward = vec3(greaterThan(d, vec3(0.0)));
  way.from = from - shift + way.start * d;
  way.unit = 1.0 / scale;
  way.low = floor(low - shift);
  way.high = ceil(high - shift) - 1.0;
  if (way.end <= 0.0) return false;
  face(normalize(toAxes * world));
  return true;
}

// Step from a cube, given by its lowest corner, to the next one along the ray. The next cube is computed by index. A
// small step instead could stall the ray or skip a cube by rounding. t: distance to the next cube; axis: the axis that
// the step crosses. Returns false if there is no next cube.
bool leave(Way way, ivec3 corner, int edge, inout float t, inout ivec3 cube, out int axis) {
  vec3 lower = vec3(corner), exits = (lower + way.upward * float(edge) - way.from) * way.inverse;
  t = max(min(exits.x, min(exits.y, exits.z)), t);
  vec3 next = clamp(clamp(floor(way.from + t * way.d), lower, lower + float(edge - 1)), way.low, way.high);
  axis = exits.x <= exits.y && exits.x <= exits.z ? 0 : exits.y <= exits.z ? 1 : 2;
  next = mix(next, lower - 1.0 + way.upward * float(edge + 1), equal(ivec3(axis), ivec3(0, 1, 2)));
  cube = ivec3(next);
  return all(greaterThanEqual(next, way.low)) && all(lessThanEqual(next, way.high)) && t < way.end;
}

#if !SMOOTH
#if NORMALS
// The density at a voxel, in 1/world unit.
float densityAt(ivec3 voxel) {
  int row = rowAt(voxel);
  return row < 0 ? 0.0 : headOf(placeOf(row)).a;
}

// A vector opposite to the gradient of the density, in voxels, from the six voxels beside this one.
vec3 slopeAt(ivec3 voxel) {
  const ivec3 x = ivec3(1, 0, 0), y = ivec3(0, 1, 0), z = ivec3(0, 0, 1);
  return vec3(densityAt(voxel - x) - densityAt(voxel + x), densityAt(voxel - y) - densityAt(voxel + y),
              densityAt(voxel - z) - densityAt(voxel + z));
}
#endif

// March a ray through one cube: add what it meets to `found`, and multiply its transmittance `through`.
void marchCube(vec3 along, inout Found found, inout float through) {
  Way way;
  if (!enter(along, 0.0, way)) return;
  ivec3 next = ivec3(clamp(floor(way.from), way.low, way.high)), voxel, corner;
  int row, edge, axis;
  float t = 0.0, near;
  for (bool inside = true; inside && through >= cut;) {
    // Cross all empty cubes first: neighbouring rays wait for each other, and the code below the loop costs most.
    do {
      found.steps++;
      voxel = next;
      near = t;
      row = look(voxel, corner, edge);
      inside = leave(way, corner, edge, t, next, axis) && found.steps < LIMIT;
    } while (row < 0 && inside);
    if (row >= 0) {
      ivec2 place = placeOf(row);
      vec4 first = headOf(place);
      float sigma = first.a, depth = sigma * (min(t, way.end) - near) * way.unit, kept = exp(-depth);
      float weight = through * (1.0 - kept);
      if (mode <= FIRST && !dark) found.colour += weight * sigmoid(sumOf(first.rgb, place));
#if NORMALS
      found.colour += weight * slopeAt(voxel);
#endif
      if (mode == DEPTH || mode == PICK || ztest) found.far += weight * (way.start + near) * way.unit + through * (1.0 - kept - depth * kept) / max(sigma, 1e-30);
      through *= kept;
    }
  }
}
#endif
