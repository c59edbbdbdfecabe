// March a ray through the inner cube and through the shells around it. Each shell lies between a cube and the next smaller
// one, which is half as wide and has the same centre. nerfbake/kernels/fit/rays.py marches shells in the same order.

#if SHELLS
// The lowest (0) or highest (1) corner of a cube, in voxels of the inner cube.
vec3 cornerOf(int number, float end) {
  vec4 frame = frames[max(number - 1, 0)];
  // The inner cube is the middle of the first shell's cube.
  float voxel = 8.0 * float(AROUND) * (number == 0 ? 0.25 + 0.5 * end : end);
  return (voxel - frame.xyz) / frame.w;
}

// From the outermost cube that the ray meets to the innermost one, and back.
void marchAll(vec3 along, inout Found found, inout float through) {
  vec3 d = toVoxels * normalize(along);
  vec3 inverse = 1.0 / mix(d, vec3(1e-12), lessThan(abs(d), vec3(1e-12)));
  float enters[SHELLS + 1], leaves[SHELLS + 1];
  int deepest = SHELLS + 1;
  for (int number = SHELLS; number >= 0; number--) {
    vec3 one = (cornerOf(number, 0.0) - origin) * inverse, other = (cornerOf(number, 1.0) - origin) * inverse;
    vec3 near = min(one, other), away = max(one, other);
    enters[number] = max(max(near.x, near.y), max(near.z, 0.0));
    leaves[number] = min(away.x, min(away.y, away.z));
    if (enters[number] >= leaves[number]) break;
    deepest = number;
  }
  for (int part = 0; deepest <= SHELLS && part <= 2 * (SHELLS - deepest) && through >= cut; part++) {
    bool inward = part < SHELLS - deepest;
    shell = inward ? SHELLS - part : 2 * deepest + part - SHELLS;
    partFrom = inward || shell == deepest ? enters[shell] : leaves[shell - 1];
    partTo = inward ? enters[shell - 1] : leaves[shell];
    if (partFrom < partTo) marchCube(along, found, through);
  }
  shell = 0;
}
#endif

Found march(vec3 along) {
  Found found = Found(vec3(0.0), 0.0, 0.0, 0);
  float through = 1.0;
#if SHELLS
  if (alone) {
    partFrom = 0.0;
    partTo = 1e30;
    marchCube(along, found, through);
  } else {
    marchAll(along, found, through);
  }
#else
  marchCube(along, found, through);
#endif
  found.alpha = 1.0 - through;
  return found;
}
