// Decode a .svoq. schemas/svoq.md describes the format, and nerfbake/kernels/coding is the same in Python. Generators
// yield the progress of their work, 0 to 1, so that the page stays responsive.

const EVEN = 1 << 29; // an initial model: probability in units of 1/2^22, then 8 bits of count
const ROWS_AT_ONCE = 512;

const SQUASH = new Uint16Array(4096);
const STRETCH = new Int16Array(4096);
const RATES = new Uint16Array(251);
const SIZES = bucketsOf([1, 2, 3, 5, 7, 10, 15, 23, 36, 60, 120]);
const MATCHES = bucketsOf([1, 2, 3, 5, 8, 14, 24, 44, 90]);
const BITS = new Uint8Array(256);
const SHARES = [0, 12, 6, 4, 3]; // 12 / number of references
const AXES = [2, 1, 1, 0, 0, 0, 0]; // of each slot
const FIRST_SLOT = [3, 1, 0]; // of each axis
const WIDTHS = [8, 4, 4, 2, 2, 2, 2], LOWS = [0, 0, 4, 0, 2, 4, 6]; // of each slot, in octants

function fillTables() {
  const anchors = [22, 36, 60, 98, 162, 267, 439, 720, 1179, 1921, 3108, 4971, 7812, 11955, 17625, 24743, 32768];
  for (let i = 15; i >= 0; i--) anchors.push(65536 - anchors[i]);
  for (let i = 0; i < 4096; i++) {
    const t = Math.max(i, 1);
    SQUASH[i] = (anchors[t >> 7] * (128 - (t & 127)) + anchors[(t >> 7) + 1] * (t & 127) + 64) >> 7;
  }
  for (let q = 0, t = 1; q < 4096; q++) {
    while (t < 4095 && SQUASH[t] < 16 * q + 8) t++;
    STRETCH[q] = t - 2048;
  }
  for (let n = 0; n < 251; n++) RATES[n] = Math.floor(131072 / (2 * n + 3));
  for (let i = 1; i < 256; i++) BITS[i] = BITS[i >> 1] + (i & 1);
}

function bucketsOf(steps) {
  const last = steps[steps.length - 1];
  return Uint8Array.from({ length: last + 1 }, (_, value) => steps.filter((step) => step <= value).length);
}

function sizeBucket(value) {
  return SIZES[value > 120 ? 120 : value];
}

function clipped(value) {
  return value > 255 ? 255 : value < -255 ? -255 : value;
}

function signOf(value) {
  return value > 0 ? 2 : value < 0 ? 0 : 1;
}

// -- the range coder -------------------------------------------------------------------------------------------
class Stream {
  constructor(bytes) {
    this.bytes = bytes;
    this.state = new Uint32Array([0, 0xffffffff, 4]); // code, range, position
    for (let i = 0; i < 4; i++) this.state[0] = this.state[0] * 256 + (i < bytes.length ? bytes[i] : 0);
  }

  bit(p) {
    const state = this.state;
    let code = state[0], range = state[1], bit = 0;
    const bound = (Math.imul(range >>> 16, p) + (Math.imul(range & 0xffff, p) >>> 16)) >>> 0;
    if (code < bound) {
      bit = 1;
      range = bound;
    } else {
      code -= bound;
      range -= bound;
    }
    while (range < 0x1000000) {
      const place = state[2]++;
      code = ((code << 8) | (place < this.bytes.length ? this.bytes[place] : 0)) >>> 0;
      range = (range << 8) >>> 0;
    }
    state[0] = code;
    state[1] = range;
    return bit;
  }

  requireWhole() {
    if (this.state[2] - 3 !== this.bytes.length) throw new Error("a stream of the octree is not whole");
  }
}

// error * rate >> 16 needs 38 bits. With the lower byte of the error separate, 32-bit integers suffice.
function learnt(model, bit) {
  const n = model & 255, rate = RATES[n], error = (bit ? 4194303 : 0) - (model >> 8);
  const step = (Math.imul(error >> 8, rate) + (Math.imul(error & 255, rate) >> 8)) >> 8;
  return model + (step << 8) + (n < 250 ? 1 : 0);
}

// Models of four kinds, one kind after the other, with `values` models each; and `sets` sets of weights.
class Mixer {
  constructor(stream, values, sets) {
    this.stream = stream;
    this.values = values;
    this.models = new Int32Array(4 * values).fill(EVEN);
    this.weights = new Float64Array(4 * sets).fill(19661);
  }

  bit(set, a, b, c, d) {
    const { models, values, weights: w } = this, i = 4 * set;
    b += values;
    c += 2 * values;
    d += 3 * values;
    const ma = models[a], mb = models[b], mc = models[c], md = models[d];
    const xa = STRETCH[ma >> 18], xb = STRETCH[mb >> 18], xc = STRETCH[mc >> 18], xd = STRETCH[md >> 18];
    let x = Math.floor((w[i] * xa + w[i + 1] * xb + w[i + 2] * xc + w[i + 3] * xd) / 65536) | 0;
    x = x > 2047 ? 2047 : x < -2047 ? -2047 : x;
    const p = SQUASH[x + 2048], bit = this.stream.bit(p), error = 3 * ((bit ? 65535 : 0) - p);
    w[i] += (Math.imul(xa, error) + 32768) >> 16;
    w[i + 1] += (Math.imul(xb, error) + 32768) >> 16;
    w[i + 2] += (Math.imul(xc, error) + 32768) >> 16;
    w[i + 3] += (Math.imul(xd, error) + 32768) >> 16;
    models[a] = learnt(ma, bit);
    models[b] = learnt(mb, bit);
    models[c] = learnt(mc, bit);
    models[d] = learnt(md, bit);
    return bit;
  }
}

// -- topology --------------------------------------------------------------------------------------------------
// Nodes that have masks: number of the first child, level, and neighbours at -x, -y, -z, +x, +y, +z (-1: none).
function newNodes(c) {
  return {
    masks: new Uint8Array(c),
    first: new Int32Array(c),
    level: new Uint8Array(c),
    parent: new Int32Array(c),
    octant: new Uint8Array(c),
    beside: new Int32Array(6 * c).fill(-1),
  };
}

function childOf(nodes, node, octant) {
  const mask = nodes.masks[node];
  return (mask >> octant) & 1 ? nodes.first[node] + BITS[mask & ((1 << octant) - 1)] : -1;
}

function meet(nodes, node) {
  if (!node) return;
  const parent = nodes.parent[node], octant = nodes.octant[node];
  for (let axis = 0; axis < 3; axis++) {
    const upper = (octant >> axis) & 1, inner = upper ? axis : axis + 3, outer = upper ? axis + 3 : axis;
    const uncle = nodes.beside[6 * parent + outer];
    nodes.beside[6 * node + inner] = childOf(nodes, parent, octant ^ (1 << axis));
    nodes.beside[6 * node + outer] = uncle < 0 ? -1 : childOf(nodes, uncle, octant ^ (1 << axis));
  }
}

function addChildren(nodes, node, count) {
  const c = nodes.masks.length;
  nodes.first[node] = count;
  for (let octant = 0; octant < 8; octant++) {
    if (!((nodes.masks[node] >> octant) & 1)) continue;
    if (count < c) {
      nodes.parent[count] = node;
      nodes.octant[count] = octant;
      nodes.level[count] = nodes.level[node] + 1;
    }
    count++;
  }
  return count;
}

function touching(nodes, node, octant) {
  let found = 0;
  for (let axis = 0; axis < 3; axis++) {
    const near = nodes.beside[6 * node + axis + 3 * ((octant >> axis) & 1)], mask = near < 0 ? 0 : nodes.masks[near];
    const state = near < 0 ? 0 : near > node ? 1 : !mask || (mask >> (octant ^ (1 << axis))) & 1 ? 3 : 2;
    found = 4 * found + state;
  }
  return found;
}

function* readNodes(bytes, c) {
  const nodes = newNodes(c), stream = new Stream(bytes), mixer = new Mixer(stream, 1 << 14, 9);
  for (let node = 0, count = 1; node < c; node++) {
    if (node === count) throw new Error("the octree has more masks than nodes");
    meet(nodes, node);
    const level = Math.min(nodes.level[node], 15);
    let faces = 0, leaves = 0;
    for (let side = 0; side < 6; side++) {
      const near = nodes.beside[6 * node + side];
      if (near < 0) continue;
      faces |= 1 << side;
      leaves += near < node && !nodes.masks[near] ? 1 : 0;
    }
    leaves = Math.min(leaves, 3);
    let mask = 0;
    if (!mixer.bit(8, level * 4 + leaves, faces * 4 + leaves, level, leaves)) {
      for (let octant = 0; octant < 8; octant++) {
        if (octant === 7 && !mask) {
          mask = 128; // a node that is not a leaf has at least one child
          break;
        }
        const outside = touching(nodes, node, octant), before = (1 << octant) | mask, known = BITS[mask];
        const one = 256 + (octant * 64 + outside) * 8 + known, other = 64 + (octant * 16 + level) * 8 + known;
        mask |= mixer.bit(octant, before * 64 + faces, one, before * 64 + outside, other) << octant;
      }
    }
    nodes.masks[node] = mask;
    count = addChildren(nodes, node, count);
    if (node % 4096 === 0) yield node / c;
  }
  stream.requireWhole();
  return nodes;
}

// -- pairs and their references -----------------------------------------------------------------------------------
function bothHalves(mask, slot) {
  if (slot === 0) return (mask & 15) !== 0 && (mask & 240) !== 0;
  if (slot < 3) return ((mask >> (4 * (slot - 1))) & 3) !== 0 && ((mask >> (4 * (slot - 1))) & 12) !== 0;
  return ((mask >> (2 * (slot - 3))) & 3) === 3;
}

// rows: for each of a node's seven slots the row of its pair, or 0; slots and references (4) of each row.
function pairsOf(nodes, m) {
  const c = nodes.masks.length, rows = new Int32Array(7 * c), above = new Int32Array(3 * c);
  const slots = new Uint8Array(m), references = new Int32Array(4 * m);
  for (let begin = 0, end = 0, row = 1; begin < c; begin = end) {
    while (end < c && nodes.level[end] === nodes.level[begin]) end++;
    for (const [from, to] of [[0, 1], [1, 3], [3, 7]]) {
      for (let node = begin; node < end; node++) {
        for (let slot = from; slot < to; slot++) {
          if (!bothHalves(nodes.masks[node], slot)) continue;
          if (row >= m) throw new Error("the octree has more pairs than leaves");
          slots[row] = slot;
          rows[7 * node + slot] = row++;
        }
      }
    }
    for (let node = begin; node < end; node++) {
      for (let slot = 0; slot < 7; slot++) if (rows[7 * node + slot]) refer(nodes, node, slot, rows, above, references);
      for (let octant = 0; octant < 8; octant++) {
        const below = childOf(nodes, node, octant);
        if (below < 0 || below >= c) continue;
        for (let axis = 0; axis < 3; axis++) {
          const own = rows[7 * node + [3 + (octant >> 1), 1 + (octant >> 2), 0][axis]];
          above[3 * below + axis] = own || above[3 * node + axis];
        }
      }
    }
  }
  return { rows, slots, references };
}

function refer(nodes, node, slot, rows, above, references) {
  const axis = AXES[slot], first = FIRST_SLOT[axis], at = 4 * rows[7 * node + slot];
  for (let side = 0; side < 3; side++) {
    // Pairs inside the same node are adjacent along the axes above the pair's axis.
    const bit = side > axis ? 1 << (side - axis - 1) : 0, inside = bit & (slot - first);
    const near = inside ? node : nodes.beside[6 * node + side];
    if (near >= 0) references[at + side] = rows[7 * near + first + ((slot - first) ^ bit)];
  }
  references[at + 3] = above[3 * node + axis];
}

fillTables();
