// Coarser levels of detail, with the means of nerfbake/kernels/octree/pyramid.py: densities are weighted by volume,
// coefficients by volume and opacity. All opacities use one length, the edge of the finest voxel.

// Call tell(x, y, z, edge, row) for all leaves of a field's arrays, including whole cells and blocks with a single row.
function* eachRow({ top, blocks }, [X, Y, Z], tell) {
  for (let x = 0, i = 0; x < X; x++) {
    for (let y = 0; y < Y; y++) {
      for (let z = 0; z < Z; z++, i++) {
        if (top[i] >= WHOLE) tell(8 * x, 8 * y, 8 * z, 8, top[i] - WHOLE);
        else if (top[i] >= 0) eachRowOfLeaf(blocks, top[i], 8 * x, 8 * y, 8 * z, tell);
      }
    }
    yield x / X;
  }
}

function eachRowOfLeaf(blocks, leaf, x, y, z, tell) {
  for (let block = 0; block < 8; block++) {
    const at = 4 * (8 * leaf + block), x0 = x + (block & 4), y0 = y + 2 * (block & 2), z0 = z + 4 * (block & 1);
    let row = blocks[at + 2];
    if (blocks[at + 3] === ALL) {
      tell(x0, y0, z0, 4, row);
      continue;
    }
    for (let bit = 0; bit < 64; bit++) {
      if (!((blocks[at + (bit >> 5)] >>> (bit & 31)) & 1)) continue;
      const x = bit >> 4, y = (bit >> 2) & 3, z = bit & 3, wide = (blocks[at + 3] >> (WIDE + octantAt(x, y, z))) & 1;
      tell(x0 + x, y0 + y, z0 + z, 1 + wide, row++);
    }
  }
}

// The facts of the same field with 2^steps voxels along each edge merged into one.
function coarserFacts(facts, steps) {
  const s = 2 ** steps, { place, box } = facts;
  const start = facts.start.map((low, axis) => CELL * Math.floor(Math.floor((low + box[0][axis]) / s) / CELL));
  const own = [Math.floor, Math.ceil].map((round, end) => start.map((low, axis) => round((facts.start[axis] + box[end][axis]) / s) - low));
  return {
    ...facts, start, box: own,
    shape: own[1].map((high) => Math.ceil(high / CELL)),
    place: place.map((row, axis) => [...row.slice(0, 3).map((part) => part / s), (row[3] + facts.start[axis]) / s - start[axis]]),
  };
}

// The arrays of that field; wide: the facts that coarserFacts() returned.
function* coarser(arrays, facts, wide, steps) {
  const s = 2 ** steps, shift = wide.start.map((low, axis) => facts.start[axis] - s * low), channels = 4 * facts.texels;
  let leaves = new Leaves();
  const list = (x, y, z, edge, row) => {
    const [x0, y0, z0] = [x + shift[0], y + shift[1], z + shift[2]].map((at) => Math.floor(at / s));
    leaves.add(row, x0, y0, z0, Math.max(edge / s, 1));
  };
  yield* scaled(eachRow(arrays, facts.shape, list), 0, 0.3);
  const { top, blocks, rows } = structureOf(leaves.all, wide);
  leaves = null;
  const sums = new Float32Array(rows * channels), weights = new Float32Array(rows), length = lengthOf(facts.place);
  const add = (x, y, z, edge, row) => {
    const at = row * channels, sigma = numberOf(arrays.texels[at + 3]);
    const share = Math.min((edge / s) ** 3, 1), weight = -Math.expm1(-sigma * facts.densityUnit * length) * share;
    const [x0, y0, z0] = [x + shift[0], y + shift[1], z + shift[2]].map((place) => Math.floor(place / s));
    const own = rowAt(top, blocks, wide.shape, x0, y0, z0);
    for (let k = 0; k < channels; k++) sums[own * channels + k] += (k === 3 ? share : weight) * numberOf(arrays.texels[at + k]);
    weights[own] += weight;
  };
  yield* scaled(eachRow(arrays, facts.shape, add), 0.3, 0.9);
  const texels = new Uint16Array(rows * channels);
  for (let row = 0; row < rows; row++) {
    const at = row * channels;
    for (let k = 0; k < channels; k++) texels[at + k] = halfOf(k === 3 ? sums[at + k] : sums[at + k] / weights[row]);
    if (!texels[at + 3]) texels[at + 3] = 1; // the smallest density: thin voxels stay visible
    if (row % 65536 === 65535) yield 0.9 + (0.1 * row) / rows;
  }
  return { top, blocks, texels };
}

// The edge of a cube with the volume of a voxel, in world units.
function lengthOf(place) {
  return Math.cbrt(1 / place.reduce((volume, row) => volume * Math.hypot(row[0], row[1], row[2]), 1));
}
