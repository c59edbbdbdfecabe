// Decode the coefficients of a .svoq, and compute the leaves from them: the second half of schemas/svoq.md.

const GROUP_AT = 9, GROUP_OF = 6; // channels
const SIZE_BUCKETS = 12, MATCH_BUCKETS = 10;

// A reader of channels first .. last - 1 of all rows except row 0, into values (m, C).
class Coefficients {
  // values has one more row, of zeros, for references that do not exist.
  constructor(bytes, values, C, pairs, first, last) {
    this.stream = new Stream(bytes);
    this.values = values;
    this.C = C;
    this.pairs = pairs;
    this.first = first;
    this.last = last;
    const groups = Math.floor(C / GROUP_OF) + 1, sizes = SIZE_BUCKETS ** 2, matches = 2 * MATCH_BUCKETS;
    this.groups = new Mixer(this.stream, Math.max(groups, SIZE_BUCKETS) * sizes, groups);
    this.zeros = new Mixer(this.stream, Math.max(C, SIZE_BUCKETS) * sizes, C);
    this.signs = new Mixer(this.stream, Math.max(C * 9 * matches, C * 81, matches * 81), C);
    this.sizes = new Mixer(this.stream, Math.max(C * matches * SIZE_BUCKETS, SIZE_BUCKETS * sizes) * 16, C * 16);
    this.bits = new Int32Array(38 * C).fill(EVEN);
    this.beside = new Int32Array(4); // offsets of the four references' values
    this.firstGroup = GROUP_AT + GROUP_OF * Math.max(Math.ceil((first - GROUP_AT) / GROUP_OF), 0);
  }

  readRow(row) {
    const { values, C, beside, first, last, pairs } = this, own = row * C, slot = pairs.slots[row], axis = AXES[slot];
    const share = this.lookAround(row), at0 = beside[0], at1 = beside[1], at2 = beside[2], at3 = beside[3];
    let d0 = 0, d1 = 0, d2 = 0, d3 = 0, energy = 0, run = 0, v1 = 0, v2 = 0, v3 = 0;
    for (let k = 0, group = this.firstGroup, skipped = first; k < last; k++) {
      const n0 = clipped(values[at0 + k]), n1 = clipped(values[at1 + k]), n2 = clipped(values[at2 + k]), n3 = clipped(values[at3 + k]);
      let value = values[own + k];
      if (k >= skipped) {
        const a1 = Math.min(Math.abs(v1), 40), a2 = Math.min(Math.abs(v2), 40), a3 = Math.min(Math.abs(v3), 40);
        const recent = sizeBucket(2 * a1 + a2 + a3), total = sizeBucket(run);
        if (k === group && k < C - 1) {
          group += GROUP_OF;
          const stop = Math.min(group, last, C - 1);
          if (!this.readGroup(k, stop, recent, total, share, slot)) skipped = stop;
        }
        if (k >= skipped) {
          const guess = d0 * n0 + d1 * n1 + d2 * n2 + d3 * n3;
          value = this.readValue(k, n0, n1, n2, n3, share, recent, total, guess, energy, v1, v2, axis);
          values[own + k] = value;
        }
      }
      if (value) {
        const seen = clipped(value);
        d0 += seen * n0;
        d1 += seen * n1;
        d2 += seen * n2;
        d3 += seen * n3;
        run += Math.min(Math.abs(value), 20);
      }
      energy += n0 * n0 + n1 * n1 + n2 * n2 + n3 * n3;
      v3 = v2;
      v2 = v1;
      v1 = value;
    }
  }

  // Find the references, and return 12 / their number (0 for none).
  lookAround(row) {
    const { values, C, beside, pairs } = this, none = values.length - C;
    let count = 0;
    for (let i = 0; i < 4; i++) {
      const other = pairs.references[4 * row + i];
      beside[i] = other ? other * C : none;
      count += other ? 1 : 0;
    }
    return SHARES[count];
  }

  readGroup(k, stop, recent, total, share, slot) {
    const { values, beside } = this, group = Math.floor((k - GROUP_AT) / GROUP_OF);
    let found = 0;
    for (let i = 0; i < 4; i++) {
      for (let at = beside[i] + k, end = beside[i] + stop; at < end; at++) found += Math.min(Math.abs(values[at]), 3);
    }
    const around = sizeBucket(Math.floor((found * share) / 6));
    const a = (group * SIZE_BUCKETS + recent) * SIZE_BUCKETS + total;
    const b = (group * SIZE_BUCKETS + around) * SIZE_BUCKETS + total;
    const c = (around * SIZE_BUCKETS + recent) * SIZE_BUCKETS + total;
    return this.groups.bit(group, a, b, c, (group * SIZE_BUCKETS + around) * 8 + slot);
  }

  readValue(k, n0, n1, n2, n3, share, recent, total, guess, energy, v1, v2, axis) {
    const beside = Math.abs(n0) + Math.abs(n1) + Math.abs(n2);
    const around = sizeBucket(Math.floor(((beside + Math.abs(n3)) * share) / 3));
    const match = guess ? MATCHES[Math.min(Math.floor((8 * Math.abs(guess)) / (energy + 1)), 90)] : 0;
    const a = (k * SIZE_BUCKETS + recent) * SIZE_BUCKETS + total;
    const b = (k * SIZE_BUCKETS + sizeBucket(2 * beside)) * SIZE_BUCKETS + sizeBucket(2 * Math.abs(n3));
    const c = (around * SIZE_BUCKETS + recent) * SIZE_BUCKETS + total;
    if (!this.zeros.bit(k, a, b, c, (k * MATCH_BUCKETS + match) * SIZE_BUCKETS + around)) return 0;
    const matches = 2 * MATCH_BUCKETS, above = signOf(n3);
    const signs = ((signOf(n0) * 3 + signOf(n1)) * 3 + signOf(n2)) * 3 + above;
    const way = guess > 0 ? MATCH_BUCKETS + match : MATCH_BUCKETS - match;
    const s1 = ((k * 3 + signOf(v1)) * 3 + signOf(v2)) * matches + way, s2 = ((k * 3 + above) * 3 + axis) * matches + way;
    const negative = this.signs.bit(k, signs * this.C + k, s1, way * 81 + signs, s2);
    const fits = !guess ? 0 : guess < 0 === (negative === 1) ? match : -match;
    const size = this.readSize(k, a, b, c, (k * matches + MATCH_BUCKETS + fits) * SIZE_BUCKETS + around);
    return negative ? -size : size;
  }

  readSize(k, a, b, c, d) {
    let step = 1;
    for (; ; step++) {
      if (step > 37) throw new Error("the octree holds a number that is too large");
      const kind = Math.min(step, 16) - 1;
      if (!this.sizes.bit(k * 16 + kind, a * 16 + kind, b * 16 + kind, c * 16 + kind, d * 16 + kind)) break;
    }
    if (step <= 8) return step;
    let found = 1;
    for (let i = step - 9; i >= 0; i--) {
      if (found > 1) {
        found = 2 * found + this.stream.bit(32768);
        continue;
      }
      const at = 38 * k + step, bit = this.stream.bit(Math.max(64, Math.min(65472, this.bits[at] >> 14)));
      this.bits[at] = learnt(this.bits[at], bit);
      found = 2 * found + bit;
    }
    return found + 7;
  }
}

// Read a .svoq with range-coded streams: {nodes, rows, values (m + 1, C), with zeros after the last row, ...}.
function* readSvoq(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length < 108 || view.getUint32(0, true) !== 0x514f5653 || bytes[4] !== 1 || bytes[5] !== 0) {
    throw new Error("the octree is of a version that this page does not know");
  }
  const B = Math.max(bytes[6], 1), C = 3 * B + 1, c = view.getUint32(16, true), m = view.getUint32(20, true);
  const [colourStep, densityStep, densityScale, mixingScale] = [72, 80, 88, 96].map((at) => view.getFloat64(at, true));
  const parts = [];
  for (let i = 0, at = 104 + 12 * bytes[7]; i < bytes[7]; i++) {
    const entry = 104 + 12 * i, length = view.getUint32(entry + 4, true);
    parts.push({ kind: bytes[entry], end: bytes[entry + 1], bytes: bytes.subarray(at, at + length) });
    at += length;
  }
  const basis = new DataView(bytes.buffer, parts[0].bytes.byteOffset, parts[0].bytes.length);
  const mixing = Float64Array.from({ length: (C - 1) ** 2 }, (_, i) => basis.getInt16(2 * i, true) * mixingScale);
  const values = new Int32Array((m + 1) * C);
  for (let k = 0; k < C; k++) values[k] = basis.getInt32(2 * (C - 1) ** 2 + 4 * k, true);
  const nodes = yield* scaled(readNodes(parts[1].bytes, c), 0, 0.1);
  const pairs = pairsOf(nodes, m), streams = parts.filter((part) => part.kind === 2);
  for (let i = 0, first = 0; i < streams.length; first = streams[i++].end) {
    const reader = new Coefficients(streams[i].bytes, values, C, pairs, first, streams[i].end);
    for (let row = 1; row < m; row++) {
      reader.readRow(row);
      if (row % ROWS_AT_ONCE === 0) yield 0.1 + 0.9 * ((first + (streams[i].end - first) * (row / m)) / C);
    }
    reader.stream.requireWhole();
  }
  return { nodes, rows: pairs.rows, values, B, C, colourStep, densityStep, densityScale, mixing };
}

// Call tell() for all leaves with their values, channels from .. C - 1, before the basis is mixed. This is the inverse
// Haar transform; it needs only the memory for one path down from the root.
function* eachLeaf(octree, edge, from, tell) {
  const { nodes, rows, values, C } = octree, { masks } = nodes, c = masks.length, wide = C - from;
  const counts = leafCounts(nodes), steps = new Float64Array(C).fill(octree.colourStep);
  steps[C - 1] = octree.densityStep;
  // For each level: the node, its corner, the next octant, and the values of its octants.
  const levels = Array.from({ length: 14 }, () => ({ node: 0, x: 0, y: 0, z: 0, next: 0, held: new Float64Array(8 * wide) }));
  const enter = (level, node, x, y, z) => {
    const here = levels[level];
    here.node = node;
    here.x = x;
    here.y = y;
    here.z = z;
    here.next = 0;
    for (let slot = 0; slot < 7; slot++) split(here.held, node, slot);
  };
  const split = (held, node, slot) => {
    // Pairs split along z, then y, then x. A half without children leaves the values of the pair to the other half.
    const width = WIDTHS[slot], low = LOWS[slot], high = low + width / 2;
    const row = rows[7 * node + slot], lower = low * wide, upper = high * wide;
    if (!row) {
      if (!(masks[node] & (((1 << (width / 2)) - 1) << low))) held.copyWithin(upper, lower, lower + wide);
      return;
    }
    const l = counts(node, low, high), h = counts(node, high, high + width / 2);
    const p = Math.sqrt(l / (l + h)), q = Math.sqrt(h / (l + h));
    for (let k = 0; k < wide; k++) {
      const sum = held[lower + k], difference = values[row * C + from + k] * steps[from + k];
      held[lower + k] = p * sum - q * difference;
      held[upper + k] = q * sum + p * difference;
    }
  };
  for (let k = 0; k < wide; k++) levels[0].held[k] = values[from + k] * steps[from + k];
  if (!c || !masks[0]) return tell(0, 0, 0, 0, edge, levels[0].held, 0);
  enter(0, 0, 0, 0, 0);
  for (let level = 0, told = 0; level >= 0; ) {
    const here = levels[level], octant = here.next++, width = edge >> (level + 1);
    if (octant === 8) {
      level--;
      continue;
    }
    const child = childOf(nodes, here.node, octant);
    if (child < 0) continue;
    const x = here.x + (octant & 1) * width, y = here.y + ((octant >> 1) & 1) * width, z = here.z + (octant >> 2) * width;
    if (child >= c || !masks[child]) {
      tell(child, x, y, z, width, here.held, octant * wide);
      if (++told % 4096 === 0) yield told / (values.length / C);
    } else {
      levels[level + 1].held.set(here.held.subarray(octant * wide, (octant + 1) * wide));
      enter(++level, child, x, y, z);
    }
  }
  return undefined;
}

// A function that returns the number of leaves in octants low .. high - 1 of a node.
function leafCounts(nodes) {
  const c = nodes.masks.length, below = new Int32Array(c);
  const countOf = (child) => (child < 0 ? 0 : child < c ? below[child] : 1);
  for (let node = c - 1; node >= 0; node--) {
    if (!nodes.masks[node]) below[node] = 1;
    for (let octant = 0; octant < 8; octant++) below[node] += countOf(childOf(nodes, node, octant));
  }
  return (node, low, high) => {
    let sum = 0;
    for (let octant = low; octant < high; octant++) sum += countOf(childOf(nodes, node, octant));
    return sum;
  };
}

function* scaled(work, from, to) {
  for (;;) {
    const { value, done } = work.next();
    if (done) return value;
    yield from + (to - from) * value;
  }
}
