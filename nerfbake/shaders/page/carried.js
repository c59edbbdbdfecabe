// The data of the page. Each request unpacks them again: only the packed bytes stay in memory.

const SLICE = 100; // ms of work between two pauses; a pause costs about 5 ms

class Carried {
  // tell: a function that shows the progress, 0 to 1, and lets the browser handle events.
  constructor(facts, text, tell) {
    this.facts = facts;
    this.text = text;
    this.tell = tell;
    this.packed = null;
  }

  // The packed bytes of the field, of the shells around it, and of the triangles that follow.
  async bytes() {
    if (!this.packed) {
      this.packed = await this.run(bytesOf(this.text), 0, 0.1);
      this.text = null;
    }
    const { triangles, around = [] } = this.facts, end = triangles?.at ?? this.packed.length;
    const shells = around.map((shell) => this.packed.subarray(shell.at, shell.end));
    return { field: this.packed.subarray(0, around[0]?.at ?? end), shells, triangles: this.packed.subarray(end) };
  }

  // The triangles for a Picture; null if there are none.
  async triangles() {
    const { triangles } = this.facts;
    if (!triangles) return null;
    const raw = await inflated((await this.bytes()).triangles, triangles.size, (part) => this.tell(0.1 + 0.5 * part));
    return this.run(trianglesOf(raw, triangles), 0.6, 1);
  }

  // The centres and the words of splats.
  async splats() {
    const raw = await inflated((await this.bytes()).field, this.facts.size, (part) => this.tell(0.1 + 0.4 * part));
    return this.run(splatsOf(raw, this.facts), 0.5, 1);
  }

  // The grid, the blocks and the texels (halves).
  async arrays() {
    const packed = (await this.bytes()).field;
    if (this.facts.kind === "svoq") return this.run(arraysOfSvoq(packed, this.facts), 0.1, 0.9);
    const raw = await inflated(packed, this.facts.size, (part) => this.tell(0.1 + 0.4 * part));
    return this.run(arraysOf(raw, this.facts), 0.5, 0.9);
  }

  // The arrays of each shell around the inner cube.
  async shells() {
    const { shells } = await this.bytes(), found = [];
    for (const [i, facts] of this.facts.around.entries()) {
      found.push(await this.run(arraysOf(await inflated(shells[i], facts.size, () => null), facts), 0.94, 0.95));
    }
    return found;
  }

  // The arrays for a Picture at a level of detail, where 2^steps voxels along an edge become one; null if there is no
  // field. For a SplatPicture: the splats.
  async level(steps) {
    if (this.facts.kind === "surface") return null;
    if (this.facts.kind === "splats") return this.splats();
    let arrays = await this.arrays(), facts = this.facts;
    if (steps) {
      facts = coarserFacts(this.facts, steps);
      arrays = await this.run(coarser(arrays, this.facts, facts, steps), 0.9, 0.95);
    }
    if (facts.around) arrays = withShells(arrays, facts, await this.shells());
    if (facts.kind === "svoq") Object.assign(arrays, await this.run(inBytes(arrays.texels, facts.texels), 0.95, 1), { texels: null });
    return { ...arrays, facts };
  }

  // Run a generator in slices, so that the page stays responsive.
  async run(work, from, to) {
    for (let since = performance.now(); ; ) {
      const { value, done } = work.next();
      if (done) return value;
      if (performance.now() - since > SLICE) {
        await this.tell(from + (to - from) * value);
        since = performance.now();
      }
    }
  }
}
