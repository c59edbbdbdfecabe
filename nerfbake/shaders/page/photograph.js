// The photograph of the current camera, over the scene.

class Photograph {
  constructor(viewer) {
    this.viewer = viewer;
    this.shown = false;
    for (const name of ["compare", "compare_told"]) element(name).hidden = !this.facts;
    element("compare").addEventListener("click", () => this.toggle());
    new ResizeObserver(() => this.show(this.shown)).observe(viewer.canvas);
  }

  // {source, size and offset in focal lengths}; undefined if the page has no photographs.
  get facts() {
    return this.viewer.facts.views[this.viewer.view].photograph;
  }

  // Look from the photograph's camera, and show or hide the photograph.
  toggle() {
    const { shown } = this;
    if (!shown) this.viewer.reset();
    this.show(!shown);
  }

  // The camera must be that of the photograph. Both have their principal point in the middle of the canvas.
  show(shown) {
    const { facts } = this, image = element("photograph"), { canvas, lens } = this.viewer;
    this.shown = shown && facts !== undefined;
    image.hidden = !this.shown;
    element("compare").setAttribute("aria-pressed", String(this.shown));
    if (!this.shown) return;
    const { clientWidth: width, clientHeight: height } = canvas, focal = (lens.focal * Math.min(width, height)) / 2;
    const [across, down] = facts.size.map((edge) => edge * focal);
    image.style.width = `${across}px`;
    image.style.height = `${down}px`;
    image.style.left = `${(width - across) / 2 + facts.offset[0] * focal}px`;
    image.style.top = `${(height - down) / 2 + facts.offset[1] * focal}px`;
    if (image.src !== facts.source) image.src = facts.source;
  }
}
