// Compute the picture: colours or a diagnostic view, of the field and of triangles beside it.

vec3 heat(float part) {
  return clamp(vec3(3.0 * part, 3.0 * part - 1.0, 3.0 * part - 2.0), 0.0, 1.0);
}

// March the ray through a point of the picture: what it meets of the field, and of the triangle behind it, if any.
Found meet(vec2 place) {
  vec3 along = vec3((place - 0.5 * size) / focal, -1.0);
  origin = eye;
#if MESHES
  ivec2 texel = ivec2(place * float(rays)) - corner * rays;
  float far = uintBitsToFloat(texelFetch(meshFar, texel, 0).r);
  bool solid = !isinf(far);
  if (solid && !ztest) stop = far;
  Found found = march(along);
  stop = 1e30;
  if (!solid) return found;
  if (ztest && found.far >= far * found.alpha) found = Found(vec3(0.0), 0.0, 0.0, found.steps);
  float left = 1.0 - found.alpha, lit = 1.0;
  if (light != vec3(0.0) && mode <= FIRST && left > cut) {
    dark = true;
    origin = eye + far * (toVoxels * normalize(along));
    lit = mix(1.0, SHADE, march(light).alpha);
    dark = false;
  }
  // Only the field has normals.
  if (mode <= FIRST) found.colour += left * lit * texelFetch(meshColour, texel, 0).rgb;
  found.far += left * far;
  found.alpha = 1.0;
  return found;
#else
  return march(along);
#endif
}

vec3 shown(vec2 pixel) {
  Found found = meet(pixel);
  if (mode == STEPS) return heat(float(found.steps) / 160.0);
  if (mode == SLOPE) {
    vec3 normal = found.colour * worldToVoxels;
    return mix(background, 0.5 + 0.5 * normal / max(length(normal), 1e-30), found.alpha);
  }
  if (mode == DEPTH) {
    float depth = (found.far / max(found.alpha, 1e-6) - range.x) / (range.y - range.x);
    return mix(background, vec3(1.0 - 0.85 * clamp(depth, 0.0, 1.0)), found.alpha);
  }
  return found.colour + (1.0 - found.alpha) * background;
}

void main() {
  if (mode == PICK) {
    // The mean distance in 24 bits, as a fraction of the range's end, and the opacity.
    Found found = meet(aim);
    float part = clamp(found.far / max(found.alpha, 1e-6) / range.y, 0.0, 0.9999999);
    vec3 digits = floor(fract(part * vec3(1.0, 256.0, 65536.0)) * 256.0);
    colour = vec4(digits / 255.0, found.alpha);
    return;
  }
  vec3 sum = vec3(0.0);
  vec2 pixel = floor(gl_FragCoord.xy);
  for (int i = 0; i < rays * rays; i++) {
    sum += shown(pixel + (vec2(i % rays, i / rays) + 0.5) / float(rays));
  }
  colour = vec4(sum / float(rays * rays), 1.0);
}
