// Unpack the splats of the page. nerfbake/formats/page/splats.py describes their planes of bytes.

const WORDS = 8; // of a splat, without its higher coefficients
const SIZE_CODES = 0x3ff; // a scale has ten bits

// Texels of four words for the higher coefficients of a splat, a byte each: red, green, blue of the second, ...
function restTexels(functions) {
  return Math.ceil((3 * (functions - 1)) / 16);
}

const signed = (code) => (code >>> 1) ^ -(code & 1);

// Bytes -> {means: x, y, z of each splat; words, rest: of each splat, as splats_project.glsl reads them}.
function* splatsOf(bytes, facts) {
  const { splats: n, functions, low, step } = facts, texels = restTexels(functions);
  const means = new Float32Array(3 * n), words = new Uint32Array(WORDS * n), rest = new Uint32Array(4 * texels * n);
  const bits = new Uint32Array(means.buffer), plane = (k) => bytes.subarray(k * n, (k + 1) * n);
  for (let axis = 0; axis < 3; axis++) {
    const [p0, p1, p2, p3] = [0, 1, 2, 3].map((k) => plane(4 * axis + k));
    for (let i = 0, place = 0; i < n; i++) {
      place += signed(p0[i] | (p1[i] << 8) | (p2[i] << 16) | (p3[i] << 24));
      means[3 * i + axis] = low[axis] + step * place;
    }
    yield 0.1 * (axis + 1);
  }
  const [sizes, sizesHigh] = [0, 1].map((high) => [12, 14, 16].map((k) => plane(k + high)));
  const turns = [18, 19, 20, 21].map(plane), opacity = plane(22), [colours, coloursHigh] = [23, 24].map((from) => [0, 2, 4].map((k) => plane(from + k)));
  for (let i = 0, at = 0; i < n; i++, at += WORDS) {
    for (let axis = 0; axis < 3; axis++) {
      words[at + axis] = bits[3 * i + axis];
      words[at + 4] |= ((sizes[axis][i] | (sizesHigh[axis][i] << 8)) & SIZE_CODES) << (10 * axis);
    }
    words[at + 3] = turns[0][i] | (turns[1][i] << 8) | (turns[2][i] << 16) | (turns[3][i] << 24);
    const [red, green, blue] = [0, 1, 2].map((k) => signed(colours[k][i] | (coloursHigh[k][i] << 8)) & 0xffff);
    words[at + 5] = red | (green << 16);
    words[at + 6] = blue | (opacity[i] << 16);
    if (i % 65536 === 65535) yield 0.3 + (0.3 * i) / n;
  }
  const held = new Uint8Array(rest.buffer); // little-endian, as all browsers are
  for (let k = 0; k < 3 * (functions - 1); k++) {
    const codes = plane(29 + k);
    for (let i = 0, at = k; i < n; i++, at += 16 * texels) held[at] = signed(codes[i]);
    yield 0.6 + (0.4 * k) / (3 * functions);
  }
  return { means, words, rest };
}
