// Sort splats by their depth, in a worker: its script is the text of these functions.

// The numbers of the splats beyond `near` in the direction `along` (unit) from `position`, nearest first; equal depths
// keep their order, as in nerfbake/kernels/splat/project.py. room: scratch arrays, kept from one call to the next.
function depthOrder(means, position, along, near, room) {
  const n = means.length / 3, [x, y, z] = along, start = position[0] * x + position[1] * y + position[2] * z, DIGITS = 2048;
  if (!room.depths) for (const name of ["words", "order", "otherWords", "other"]) room[name] = new Uint32Array(n);
  room.depths ??= new Float32Array(room.words.buffer);
  let { words, order, otherWords, other } = room, count = 0;
  const counts = [0, 1, 2].map(() => new Uint32Array(DIGITS + 1)), [low, middle, high] = counts;
  for (let i = 0; i < n; i++) {
    const depth = means[3 * i] * x + means[3 * i + 1] * y + means[3 * i + 2] * z - start;
    if (!(depth > near)) continue;
    // Positive floats are in the order of their bits.
    room.depths[count] = depth;
    order[count] = i;
    const word = words[count++];
    low[(word & 2047) + 1]++;
    middle[((word >>> 11) & 2047) + 1]++;
    high[(word >>> 22) + 1]++;
  }
  for (let round = 0; round < 3; round++) {
    const starts = counts[round], shift = 11 * round;
    for (let k = 0; k < DIGITS; k++) starts[k + 1] += starts[k];
    for (let i = 0; i < count; i++) {
      const word = words[i], at = starts[(word >>> shift) & 2047]++;
      otherWords[at] = word;
      other[at] = order[i];
    }
    [words, otherWords, order, other] = [otherWords, words, other, order];
  }
  return order.slice(0, count);
}

// What the worker does: the first message has the centres, each other one a view.
function sortInWorker() {
  const room = {}, scope = /** @type {any} */ (self);
  let means = null;
  scope.onmessage = ({ data }) => {
    if (!means) means = data;
    else {
      const order = depthOrder(means, data.position, data.along, data.near, room);
      scope.postMessage({ order, view: data }, [order.buffer]);
    }
  };
}

class Sorter {
  // told: a function that takes the numbers of the sorted splats and their view; failed: one that takes an error.
  constructor(means, told, failed) {
    this.means = means;
    this.room = {};
    this.sent = null; // the view that is being sorted
    this.next = null; // the one after it
    const source = `${depthOrder}\n(${sortInWorker})();`, address = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    this.worker = new Worker(address);
    this.worker.onmessage = ({ data }) => {
      URL.revokeObjectURL(address);
      this.sent = null;
      if (this.next) this.send(this.next);
      told(data.order, data.view);
    };
    this.worker.onerror = (event) => failed(new Error(event.message || "the splats cannot be sorted"));
    this.worker.postMessage(means);
  }

  // Sort for this view {position, along, near} as soon as the worker is free; a newer view takes the place of one that
  // waits.
  ask(view) {
    if (this.sent) this.next = view;
    else this.send(view);
  }

  send(view) {
    this.sent = view;
    this.next = null;
    this.worker.postMessage(view);
  }

  now({ position, along, near }) {
    return depthOrder(this.means, position, along, near, this.room);
  }
}
