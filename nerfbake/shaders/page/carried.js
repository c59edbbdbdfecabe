// What the page carries, unpacked as often as it is asked for: none of it is kept but the packed bytes.

const SLICE = 100; // ms of work between two breaths, each of which costs about five

class Carried {
  // tell: takes how much is done, 0 to 1, and lets the page breathe.
  constructor(facts, text, tell) {
    this.facts = facts;
    this.text = text;
    this.tell = tell;
    this.packed = null;
  }

  // The bytes of the field, and those of triangles behind them.
  async bytes() {
    if (!this.packed) {
      this.packed = await this.run(bytesOf(this.text), 0, 0.1);
      this.text = null;
    }
    const at = this.facts.triangles?.at ?? this.packed.length;
    return { field: this.packed.subarray(0, at), triangles: this.packed.subarray(at) };
  }

  // Triangles as a Picture takes them; null: there are none.
  async triangles() {
    const { triangles } = this.facts;
    if (!triangles) return null;
    const raw = await inflated((await this.bytes()).triangles, triangles.size, (part) => this.tell(0.1 + 0.5 * part));
    return this.run(trianglesOf(raw, triangles), 0.6, 1);
  }

  // The grid, the blocks and the halves.
  async arrays() {
    const packed = (await this.bytes()).field;
    if (this.facts.kind === "svoq") return this.run(arraysOfSvoq(packed, this.facts), 0.1, 0.9);
    const raw = await inflated(packed, this.facts.size, (part) => this.tell(0.1 + 0.4 * part));
    return this.run(arraysOf(raw, this.facts), 0.5, 0.9);
  }

  // The same at a level of detail, where 2^steps voxels are one: as a Picture takes it; null: there is no field.
  async level(steps) {
    if (this.facts.kind === "surface") return null;
    let arrays = await this.arrays(), facts = this.facts;
    if (steps) {
      facts = coarserFacts(this.facts, steps);
      arrays = await this.run(coarser(arrays, this.facts, facts, steps), 0.9, 0.95);
    }
    if (facts.kind === "svoq") Object.assign(arrays, await this.run(inBytes(arrays.texels, facts.texels), 0.95, 1), { texels: null });
    return { ...arrays, facts };
  }

  // Works a little at a time, so that the page stays alive.
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
