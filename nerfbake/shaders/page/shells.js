// The shells around the inner cube of a scene with scenery.

// The arrays of a field and of its shells as one: the blocks and texels follow each other, and `around` has the grids of
// all shells, one after the other.
function withShells(arrays, facts, shells) {
  const channels = 4 * facts.texels, sizes = [arrays, ...shells], total = (name) => sizes.reduce((sum, each) => sum + each[name].length, 0);
  const blocks = new Uint32Array(total("blocks")), texels = new Uint16Array(total("texels"));
  const cells = shells[0].top.length, around = new Int32Array(cells * shells.length);
  blocks.set(arrays.blocks);
  texels.set(arrays.texels);
  let word = arrays.blocks.length, half = arrays.texels.length;
  shells.forEach((shell, number) => {
    const leaf = word / 32, row = half / channels, unit = facts.around[number].densityUnit / facts.densityUnit;
    for (let i = 0; i < cells; i++) around[number * cells + i] = shell.top[i] < 0 ? shell.top[i] : shell.top[i] + (shell.top[i] >= WHOLE ? row : leaf);
    for (let i = 0; i < shell.blocks.length; i++) blocks[word + i] = shell.blocks[i] + (i % 4 === 2 ? row : 0);
    texels.set(shell.texels, half);
    for (let i = 3; unit !== 1 && i < shell.texels.length; i += channels) texels[half + i] = halfOf(unit * numberOf(shell.texels[i]));
    word += shell.blocks.length;
    half += shell.texels.length;
  });
  return { ...arrays, blocks, texels, around };
}

// For each shell a factor and an offset: its voxels = offset + factor * voxels of the inner cube.
function framesOf(facts) {
  return facts.around.flatMap(({ place }) => {
    const factor = Math.hypot(...place[0].slice(0, 3)) / Math.hypot(...facts.place[0].slice(0, 3));
    return [...place.map((row, axis) => row[3] - factor * facts.place[axis][3]), factor];
  });
}

// The diagonal of the outermost cube, in world units: nothing in it is farther apart.
function diagonalOf({ around }) {
  const { place, shape } = around[around.length - 1];
  return (Math.sqrt(3) * 8 * shape[0]) / Math.hypot(...place[0].slice(0, 3));
}
