// Convert the data of the page to the arrays that the shader reads. nerfbake/scene/page.py describes these arrays, and
// nerfbake/stages/field_to_page_field.py makes the same ones.

const CELL = 8, WHOLE = 1 << 30, ALL = 255, WIDE = 8, FARTHEST = 15;

// Base64 text -> bytes.
function* bytesOf(text) {
  const STEP = 1 << 20, bytes = new Uint8Array((text.length / 4) * 3 - (text.endsWith("==") ? 2 : text.endsWith("=") ? 1 : 0));
  for (let at = 0, to = 0; at < text.length; at += STEP) {
    const part = atob(text.slice(at, at + STEP));
    for (let i = 0; i < part.length; i++) bytes[to++] = part.charCodeAt(i);
    yield at / text.length;
  }
  return bytes;
}

// A zlib stream -> `size` bytes; told: a function that takes the progress, 0 to 1.
async function inflated(packed, size, told) {
  const bytes = new Uint8Array(size), reader = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate")).getReader();
  for (let at = 0; ; ) {
    const { value, done } = await reader.read();
    if (done && at === size) return bytes;
    if (done || at + value.length > size) throw new Error("the page's data are not whole");
    bytes.set(value, at);
    at += value.length;
    await told(at / size);
  }
}

// Read the arrays in the layout of the page: the grid, the blocks, and the halves of the texels in planes of bytes.
function* arraysOf(bytes, facts) {
  const cells = facts.shape[0] * facts.shape[1] * facts.shape[2], rows = facts.rows, channels = 4 * facts.texels;
  const top = new Int32Array(bytes.slice(0, 4 * cells).buffer);
  const blocks = new Uint32Array(bytes.slice(4 * cells, 4 * cells + 128 * facts.leaves).buffer);
  const texels = new Uint16Array(rows * channels);
  for (let channel = 0, at = 4 * cells + 128 * facts.leaves; channel < channels; channel++, at += 2 * rows) {
    for (let row = 0; row < rows; row++) texels[row * channels + channel] = bytes[at + row] | (bytes[at + rows + row] << 8);
    yield channel / channels;
  }
  return { top, blocks, texels };
}

// A list of leaves, five numbers each: node or row, then x, y, z of the lowest corner, and the edge.
class Leaves {
  constructor() {
    this.count = 0;
    this.held = new Int32Array(5 << 14);
  }

  add(node, x, y, z, edge) {
    if (5 * this.count === this.held.length) {
      const more = new Int32Array(2 * this.held.length);
      more.set(this.held);
      this.held = more;
    }
    const { held } = this, at = 5 * this.count++;
    held[at] = node;
    held[at + 1] = x;
    held[at + 2] = y;
    held[at + 3] = z;
    held[at + 4] = edge;
  }

  get all() {
    return this.held.subarray(0, 5 * this.count);
  }
}

// The same arrays for an octree, from the bytes of its .svoq.
function* arraysOfSvoq(bytes, facts) {
  const octree = yield* scaled(readSvoq(bytes), 0, 0.8), { start, edge } = facts, C = octree.C;
  const density = (v) => Math.fround(octree.densityScale * Math.expm1(Math.max(v, 0)));
  // Collect the leaves that are visible.
  let leaves = new Leaves();
  const visit = (node, x, y, z, width, held, at) => {
    if (density(held[at]) > 0) leaves.add(node, x - start[0], y - start[1], z - start[2], width);
  };
  yield* scaled(eachLeaf(octree, edge, C - 1, visit), 0.8, 0.85);
  const { top, blocks, rows } = structureOf(leaves.all, facts);
  leaves = null;
  const channels = 4 * facts.texels, texels = new Uint16Array(rows * channels), own = new Uint16Array(channels);
  const write = (_node, x0, y0, z0, _width, held, at) => {
    const sigma = density(held[at + C - 1]);
    if (!(sigma > 0)) return;
    const x = x0 - start[0], y = y0 - start[1], z = z0 - start[2], end = facts.box[1];
    if (x >= end[0] || y >= end[1] || z >= end[2]) return;
    fillRow(own, octree, held, at, sigma / facts.densityUnit);
    texels.set(own, rowAt(top, blocks, facts.shape, x, y, z) * channels);
  };
  yield* scaled(eachLeaf(octree, edge, 0, write), 0.85, 1);
  return { top, blocks, texels };
}

// Fill the row of a leaf, in halves: red, green, blue of the first coefficient and the density, then all other
// coefficients.
function fillRow(own, octree, held, at, sigma) {
  const { B, C, mixing } = octree, wide = C - 1;
  for (let k = 0; k < B; k++) {
    // Three independent sums, so that none waits for another.
    let red = 0, green = 0, blue = 0;
    for (let i = 0, r = k * wide, g = (B + k) * wide, b = (2 * B + k) * wide; i < wide; i++) {
      const value = held[at + i];
      red += value * mixing[r + i];
      green += value * mixing[g + i];
      blue += value * mixing[b + i];
    }
    own[channelOf(k, 0)] = halfOf(red);
    own[channelOf(k, 1)] = halfOf(green);
    own[channelOf(k, 2)] = halfOf(blue);
  }
  own[3] = halfOf(sigma);
}

const _float = new Float32Array(1), _bits = new Uint32Array(_float.buffer);

// Round a number to float32, then to float16, and return the bits. Numbers out of range give the largest float16.
function halfOf(value) {
  _float[0] = value;
  const sign = (_bits[0] >>> 16) & 0x8000, size = _bits[0] & 0x7fffffff;
  if (size >= 0x477fe000) return sign | 0x7bff;
  if (size < 0x38800000) {
    const scaledUp = Math.abs(_float[0]) * 16777216, whole = Math.floor(scaledUp), rest = scaledUp - whole;
    return sign | (rest > 0.5 || (rest === 0.5 && whole & 1) ? whole + 1 : whole);
  }
  return sign | ((size + 0xfff + ((size >>> 13) & 1) - 0x38000000) >>> 13);
}

// The number with these float16 bits. Shifted to the places of a float32's bits, it is too small by a factor of 2^112.
function numberOf(half) {
  _bits[0] = (half & 0x7fff) << 13;
  return (half & 0x8000 ? -1 : 1) * 2 ** 112 * _float[0];
}

// -- the grid and the blocks for leaves (node, x, y, z, edge), and the number of rows ------------------------------
function structureOf(leaves, facts) {
  const [, Y, Z] = facts.shape, end = facts.box[1], top = new Int32Array(facts.shape[0] * Y * Z).fill(-1);
  const cellOf = (x, y, z) => ((x >> 3) * Y + (y >> 3)) * Z + (z >> 3);
  const whole = [];
  let count = 0;
  for (let i = 0; i < leaves.length; i += 5) {
    const x = leaves[i + 1], y = leaves[i + 2], z = leaves[i + 3], width = leaves[i + 4];
    if (x >= end[0] || y >= end[1] || z >= end[2]) continue;
    if (width >= 4) whole.push(i);
    if (width < 8) top[cellOf(x, y, z)] = 0;
  }
  for (let i = 0; i < top.length; i++) if (top[i] === 0) top[i] = count++;
  const blocks = new Uint32Array(32 * count);
  for (let i = 0; i < leaves.length; i += 5) {
    const x = leaves[i + 1], y = leaves[i + 2], z = leaves[i + 3], width = leaves[i + 4];
    if (width >= 4 || x >= end[0] || y >= end[1] || z >= end[2]) continue;
    const at = 4 * blockAt(top[cellOf(x, y, z)], x, y, z);
    blocks[at + ((x >> 1) & 1)] |= 1 << bitAt(x, y, z);
    if (width === 2) blocks[at + 3] |= 1 << (WIDE + octantAt(x, y, z));
  }
  let rows = 0;
  for (let at = 0; at < blocks.length; at += 4) {
    blocks[at + 2] = rows;
    const lower = bitsIn(blocks[at]);
    blocks[at + 3] += lower;
    rows += lower + bitsIn(blocks[at + 1]);
  }
  // Number whole leaves in the order of their nodes, which is the order of the octree's rows.
  for (const i of whole.sort((a, b) => leaves[a] - leaves[b])) {
    const [, x, y, z, width] = leaves.subarray(i, i + 5);
    if (width === 4) blocks.set([0xffffffff, 0xffffffff, rows, ALL], 4 * blockAt(top[cellOf(x, y, z)], x, y, z));
    else fillCells(top, facts.shape, [x >> 3, y >> 3, z >> 3], width >> 3, WHOLE + rows);
    rows++;
  }
  fillDistances(top, facts.shape);
  return { top, blocks, rows };
}

function blockAt(leaf, x, y, z) {
  return 8 * leaf + 4 * ((x >> 2) & 1) + 2 * ((y >> 2) & 1) + ((z >> 2) & 1);
}

function bitAt(x, y, z) {
  return ((x & 1) << 4) | ((y & 3) << 2) | (z & 3);
}

function octantAt(x, y, z) {
  return 2 * (x & 2) + (y & 2) + ((z >> 1) & 1);
}

function bitsIn(word) {
  return BITS[word & 255] + BITS[(word >>> 8) & 255] + BITS[(word >>> 16) & 255] + BITS[word >>> 24];
}

function fillCells(top, [X, Y, Z], corner, width, value) {
  const to = [X, Y, Z].map((edge, axis) => Math.min(edge, corner[axis] + width));
  for (let x = corner[0]; x < to[0]; x++) {
    for (let y = corner[1]; y < to[1]; y++) top.fill(value, (x * Y + y) * Z + corner[2], (x * Y + y) * Z + to[2]);
  }
}

// The row of a leaf, from its lowest voxel.
function rowAt(top, blocks, [, Y, Z], x, y, z) {
  const here = top[((x >> 3) * Y + (y >> 3)) * Z + (z >> 3)];
  if (here >= WHOLE) return here - WHOLE;
  const at = 4 * blockAt(here, x, y, z), upper = (x >> 1) & 1, first = blocks[at + 2];
  if (blocks[at + 3] === ALL) return first;
  return first + (upper ? blocks[at + 3] & 255 : 0) + bitsIn(blocks[at + upper] & ((1 << bitAt(x, y, z)) - 1));
}

// Store in each empty cell the distance to the nearest cell that is not empty: the largest of its distances along the
// axes.
function fillDistances(top, [X, Y, Z]) {
  let reached = Uint8Array.from(top, (value) => (value >= 0 ? 1 : 0));
  for (let distance = 1; distance <= FARTHEST; distance++) {
    for (let i = 0; i < top.length; i++) if (!reached[i]) top[i] = -distance;
    for (const [stride, edge] of [[Y * Z, X], [Z, Y], [1, Z]]) {
      const grown = reached.slice();
      for (let i = 0; i < top.length; i++) {
        const at = Math.floor(i / stride) % edge;
        if ((at > 0 && reached[i - stride]) || (at < edge - 1 && reached[i + stride])) grown[i] = 1;
      }
      reached = grown;
    }
    if (!reached.includes(0)) break;
  }
}
