// The options panel, which is closed at first: lookup, level of detail, cut, crop box, distance under the pointer,
// frame time, and export of the camera and the picture.

const PATIENCE = 60; // ms without a movement before the depth under the pointer is measured
const MOST_HALVINGS = 5;

class Panel {
  constructor(viewer) {
    this.viewer = viewer;
    this.box = element("panel");
    this.waiting = 0;
    this.wanted = false;
    const { facts, canvas } = viewer;
    const longest = Math.max(...facts.box[1].map((high, axis) => high - facts.box[0][axis]));
    for (let steps = 1; steps <= MOST_HALVINGS && 2 ** steps < longest; steps++) {
      element("detail").add(new Option(`Voxels of ${2 ** steps}`, String(steps)));
    }
    element("lookup").value = viewer.looks.smoothly ? "trilinear" : "nearest";
    element("lookup").addEventListener("change", () => this.look(element("lookup").value));
    element("detail").addEventListener("change", () => this.choose(Number(element("detail").value)));
    element("cut").addEventListener("input", () => this.cut());
    for (const slider of this.sliders) slider.addEventListener("input", () => this.clip(slider));
    element("whole").addEventListener("click", () => this.restore());
    element("options").addEventListener("click", () => this.toggle());
    element("save").addEventListener("click", () => this.save());
    element("copy").addEventListener("click", () => this.copy());
    for (const kind of ["pointermove", "pointerdown"]) canvas.addEventListener(kind, (event) => this.hover(event));
    canvas.addEventListener("pointerleave", () => this.tellDepth(null));
  }

  // The low and the high end of x, of y and of z.
  get sliders() {
    return /** @type {HTMLInputElement[]} */ ([...document.querySelectorAll("#clip input")]);
  }

  toggle() {
    this.box.hidden = !this.box.hidden;
    element("options").setAttribute("aria-expanded", String(!this.box.hidden));
  }

  look(lookup) {
    element("lookup").value = lookup;
    this.viewer.looks.smoothly = lookup === "trilinear";
    this.viewer.change();
  }

  choose(halvings) {
    element("detail").value = String(halvings);
    this.viewer.detail = halvings;
    return this.viewer.load();
  }

  cut() {
    const cut = 10 ** Number(element("cut").value);
    element("cut_told").textContent = cut < 0.01 ? cut.toPrecision(1) : cut.toFixed(2);
    this.viewer.looks.cut = cut;
    this.viewer.change();
  }

  // Each end pushes the other end of its axis, so that the range between them never becomes empty.
  clip(moved) {
    const { sliders } = this, at = sliders.indexOf(moved), other = sliders[at ^ 1], least = 0.02;
    const value = Math.max(at & 1 ? least : 0, Math.min(at & 1 ? 1 : 1 - least, Number(moved.value)));
    if (at & 1 ? Number(other.value) > value - least : Number(other.value) < value + least) {
      other.value = String(at & 1 ? value - least : value + least);
    }
    moved.value = String(value);
    const [low, high] = [0, 1].map((end) => [0, 1, 2].map((axis) => Number(sliders[2 * axis + end].value)));
    this.viewer.looks.clip = [low, high];
    this.viewer.change();
  }

  restore() {
    this.sliders.forEach((slider, i) => (slider.value = String(i & 1)));
    this.viewer.looks.clip = UNCLIPPED;
    this.viewer.change();
  }

  // -- measurements ------------------------------------------------------------------------------------------------
  hover(event) {
    if (this.box.hidden) return;
    const x = event.offsetX, y = event.offsetY;
    clearTimeout(this.waiting);
    this.waiting = setTimeout(() => {
      if (this.viewer.state === "ready") this.tellDepth(this.viewer.distanceAt(x, y));
    }, PATIENCE);
  }

  tellDepth(distance) {
    clearTimeout(this.waiting);
    element("depth").textContent = distance === null ? "\u2013" : distance.toPrecision(4);
  }

  // Show the time of a frame that was drawn while the view moved.
  pace(took) {
    if (this.box.hidden || !(took > 0)) return;
    const { canvas, scale } = this.viewer, pace = element("pace");
    pace.textContent = `${took.toFixed(0)} ms, ${(1000 / took).toFixed(took > 100 ? 1 : 0)} a second`;
    pace.title = `at ${Math.round(canvas.width * scale)} \u00d7 ${Math.round(canvas.height * scale)} pixels`;
  }

  // -- the camera as text ------------------------------------------------------------------------------------------
  async copy() {
    const { viewer } = this, text = JSON.stringify(viewer.capture(), null, 1);
    try {
      await navigator.clipboard.writeText(text);
      viewer.say("This camera is in the clipboard, as a transforms.json.");
      setTimeout(() => viewer.say(""), 2500);
    } catch {
      element("frame").value = text;
      element("camera").showModal();
      element("frame").select();
    }
  }

  // -- the picture as a file -----------------------------------------------------------------------------------------
  save() {
    const { viewer } = this;
    this.wanted = true;
    viewer.turning = false;
    if (viewer.finished && !viewer.changed) this.finished();
    else viewer.ask();
  }

  // Called when the picture at rest is complete: save it if the user asked for it.
  finished() {
    if (!this.wanted) return;
    this.wanted = false;
    const { width, height, bytes } = this.viewer.picture.held("fine"), paper = document.createElement("canvas");
    paper.width = width;
    paper.height = height;
    paper.getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(bytes.buffer), width, height), 0, 0);
    paper.toBlob((file) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(file);
      link.download = document.title.replace(/[^\p{L}\p{N}._-]+/gu, "_").slice(0, 80) + ".png";
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    });
  }
}
