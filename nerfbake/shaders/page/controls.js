// Translate the input of pointers, keys and buttons to calls of a Viewer.

const KEYS = {
  ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1],
};

const element = (id) => /** @type {any} */ (document.getElementById(id));

function fullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.().catch(() => {});
}

class Controls {
  constructor(viewer) {
    this.viewer = viewer;
    this.listen();
  }

  listen() {
    const { viewer } = this, { canvas } = viewer, pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      viewer.turning = false;
    });
    canvas.addEventListener("pointermove", (event) => {
      if (pointers.has(event.pointerId) && viewer.state === "ready") this.drag(event, pointers);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const amount = event.deltaY * (event.deltaMode ? 16 : 1);
      if (viewer.state === "ready") viewer.move((camera) => camera.zoom(Math.exp(Math.max(-300, Math.min(300, amount)) * 0.0015)));
    }, { passive: false });
    canvas.addEventListener("dblclick", (event) => viewer.state === "ready" && viewer.lookAt(event.offsetX, event.offsetY));
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      viewer.ticket++;
      viewer.state = "lost";
      viewer.busy = null;
      viewer.reveal(false);
      viewer.say("The graphics were taken away for a moment.");
    });
    canvas.addEventListener("webglcontextrestored", () => viewer.start());
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("hashchange", () => {
      viewer.camera.hash = location.hash;
      viewer.turning = false;
      viewer.photograph.show(false);
      viewer.change();
    });
    new ResizeObserver(() => viewer.ask()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => viewer.change());
    element("mode").addEventListener("change", () => viewer.show(element("mode").value));
    element("reset").addEventListener("click", () => viewer.reset());
    element("backdrop").addEventListener("click", () => viewer.nextBackground());
    element("full").addEventListener("click", () => fullScreen());
    element("about").addEventListener("click", () => element("help").showModal());
    element("full").hidden = !document.documentElement.requestFullscreen;
  }

  // One pointer rotates, or pans with another button or Shift. Two pointers pan by their middle and zoom by their
  // distance.
  drag(event, pointers) {
    const { viewer } = this;
    const before = pointers.get(event.pointerId), x = event.clientX - before.x, y = event.clientY - before.y;
    const edge = Math.min(viewer.canvas.clientWidth, viewer.canvas.clientHeight);
    const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    viewer.move((camera) => {
      if (others.length) {
        const [other] = others, far = (place) => Math.max(Math.hypot(place.x - other.x, place.y - other.y), 1);
        camera.zoom(far(before) / far({ x: event.clientX, y: event.clientY }));
        camera.pan(x / 2, y / 2, edge);
      } else if (event.buttons & 6 || event.shiftKey) camera.pan(x, y, edge);
      else camera.orbit((-x * 4) / edge, (y * 4) / edge);
    });
  }

  key(event) {
    const { viewer } = this;
    const { ctrlKey, metaKey, altKey, shiftKey, key } = event, edge = Math.min(viewer.canvas.clientWidth, viewer.canvas.clientHeight);
    if (ctrlKey || metaKey || altKey || viewer.state !== "ready" || document.querySelector("dialog[open]")) return;
    if (KEYS[key]) {
      if (event.target.matches?.("select, input")) return;
      const [x, y] = KEYS[key];
      viewer.move((camera) => (shiftKey ? camera.pan((x * edge) / 12, (y * edge) / 12, edge) : camera.orbit(-x * 0.12, y * 0.12)));
    } else if (key === "+" || key === "=") viewer.move((camera) => camera.zoom(1 / 1.15));
    else if (key === "-" || key === "_") viewer.move((camera) => camera.zoom(1.15));
    else if (key === "n" || key === "N") viewer.next(1);
    else if (key === "p" || key === "P") viewer.next(-1);
    else if ((key === "v" || key === "V") && viewer.photograph.facts) viewer.photograph.toggle();
    else if (key >= "1" && key <= "5") viewer.show(element("mode").options[Number(key) - 1]?.value ?? viewer.looks.mode);
    else if (key === "r" || key === "R") viewer.reset();
    else if (key === "f" || key === "F") fullScreen();
    else if (key === "b" || key === "B") viewer.nextBackground();
    else if (key === "c" || key === "C") viewer.panel.copy();
    else if (key === "o" || key === "O") viewer.panel.toggle();
    else if (key === "s" || key === "S") viewer.panel.save();
    else if ((key === "t" || key === "T") && !viewer.facts.modes) viewer.panel.look(viewer.looks.smoothly ? "nearest" : "trilinear");
    else if (key === "h" || key === "H" || key === "?") element("help").showModal();
    else return;
    event.preventDefault();
  }
}
