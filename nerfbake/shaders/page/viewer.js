// The page: unpack its data, then draw after each change, and only then.

const FRAME = 40; // ms for a frame while the view moves, and for a band of lines at rest
const STILL = 150; // ms without a change before the picture is refined
const COARSEST = 0.2; // smallest share of the pixels along an edge
const BUTTONS = 64; // CSS pixels reserved for the buttons; #cover's padding is the same
const TURN = 40000; // ms for a full turn around the scene
const BACKGROUNDS = [null, [1, 1, 1], [0, 0, 0]]; // null: the page's own, light or dark

class Viewer {
  constructor(facts, shader, data) {
    this.facts = facts;
    this.shader = shader;
    this.picture = null;
    this.state = "unpacking"; // then ready, lost or failed
    this.ticket = 0; // number of the last unpacking that was started
    this.detail = 0; // 2^detail voxels along an edge are shown as one
    this.frames = 0; // frames drawn so far
    this.changed = false; // since the last frame
    this.moved = 0; // time of the last change
    this.moving = false; // the camera has moved since the view was last at rest
    this.scale = 0.5; // share of the pixels along an edge, while the view moves
    this.lines = 64; // lines in a band, at rest
    this.rest = null; // what remains to be refined
    this.finished = false; // the picture at rest is complete
    this.revealed = false; // the canvas is visible: it contains a whole picture of the scene
    this.last = 0; // time of the last automatic turn
    this.keeping = 0; // the timer that writes the view into the address
    this.busy = null; // the drawing that the graphics card has not finished
    this.asked = 0; // the frame that was requested
    this.view = 0; // number of the camera that R resets to
    this.carried = new Carried(facts, data, (part) => this.tell(part));
    this.canvas = element("canvas");
    this.camera = new Camera(facts.views[0], facts.up, facts.radius);
    this.camera.hash = location.hash;
    this.backgrounds = facts.background ? [facts.background, ...BACKGROUNDS] : BACKGROUNDS;
    this.backdrop = 0;
    this.looks = { mode: "colour", smoothly: facts.lookup === "trilinear", clip: UNCLIPPED, cut: CUT };
    const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.turning = facts.turns && !calm && !location.hash;
    this.angle = 0;
    this.choices = choicesOf(this);
    this.photograph = new Photograph(this);
    new Controls(this);
    this.panel = new Panel(this);
    this.showBackground();
  }

  // -- unpacking -------------------------------------------------------------------------------------------------
  async start() {
    try {
      this.picture?.stop();
      this.picture = this.facts.kind === "splats" ? new SplatPicture(this.canvas, this.facts, () => this.change()) : new Picture(this.canvas, this.facts, this.shader);
    } catch (error) {
      if (!this.canvas.getContext("webgl2")?.isContextLost()) this.fail(error);
      return;
    }
    await this.load();
  }

  // Upload the selected level of detail. The previous one stays visible until then.
  async load() {
    const ticket = ++this.ticket, { picture } = this;
    this.say("Unpacking");
    element("progress").hidden = false;
    try {
      const level = await this.carried.level(this.detail);
      if (ticket !== this.ticket) return;
      if (level) picture.upload(level);
      const triangles = picture.triangles ? null : await this.carried.triangles();
      if (ticket !== this.ticket) return;
      if (triangles) /** @type {Picture} */ (picture).uploadTriangles(triangles);
      picture.use(this.looks.smoothly, this.looks.mode === "normals"); // compiled while the script unpacked
    } catch (error) {
      if (ticket === this.ticket && !picture.gl.isContextLost()) this.fail(error);
      return;
    }
    this.say("");
    element("progress").hidden = true;
    element("tools").hidden = false;
    this.state = "ready";
    this.change();
  }

  async tell(part) {
    element("progress").value = part;
    await new Promise((resume) => setTimeout(resume));
  }

  say(text) {
    element("status").textContent = text;
    element("note").hidden = !text;
  }

  fail(error) {
    const none = error.message === "no WebGL2";
    const why = none ? "Looking around needs WebGL 2, which this browser does not offer" : "This scene cannot be shown: " + error.message;
    this.state = "failed";
    element("progress").hidden = true;
    this.say(why + ". What you see is a still picture.");
  }

  // -- drawing ---------------------------------------------------------------------------------------------------
  get background() {
    const chosen = this.backgrounds[this.backdrop];
    if (chosen) return chosen;
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    return dark ? [0x15 / 255, 0x18 / 255, 0x1c / 255] : [0xf4 / 255, 0xf5 / 255, 0xf7 / 255];
  }

  // The options of the next drawing.
  get shown() {
    return { background: this.background, ...this.looks, ...this.choices };
  }

  showBackground() {
    const chosen = this.backgrounds[this.backdrop];
    document.body.style.background = chosen ? `rgb(${chosen.map((part) => Math.round(255 * part))})` : "";
    this.change();
  }

  // The camera with a view slightly smaller than the canvas, so that the buttons do not cover the opening view.
  get lens() {
    const { camera, canvas } = this, width = canvas.clientWidth, height = canvas.clientHeight;
    const edge = Math.max(height / 2, Math.min(width, height - BUTTONS));
    return { position: camera.position, rotation: camera.rotation, focal: (camera.focal * Math.min(edge, width)) / Math.min(width, height) };
  }

  // Draw a coarse picture now, and a fine one once nothing changes any more.
  change() {
    this.restart();
    this.ask();
  }

  // Discard the bands that were drawn before: they belong to another picture.
  restart() {
    this.changed = true;
    this.rest = null;
    this.finished = false;
    this.moved = performance.now();
  }

  ask() {
    if (!this.asked && this.state === "ready") this.asked = requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.asked = 0;
    if (this.state !== "ready") return;
    if (this.busy && !this.busy.done()) return this.ask();
    if (this.busy) this.reveal(true);
    const took = this.busy ? now - this.busy.since : 0, coarse = this.busy?.coarse;
    const factor = FRAME / Math.max(took, 8);
    if (this.busy?.moving) this.panel.pace(took);
    // Adapt in small steps: the first drawing also waits for the shader, and others wait for other work of the machine.
    if (this.busy && coarse) this.scale = Math.max(COARSEST, Math.min(1, this.scale * Math.max(0.75, Math.min(1.5, Math.sqrt(factor)))));
    if (this.busy && !coarse) this.lines = Math.max(16, Math.min(4096, Math.round(this.lines * Math.max(0.5, Math.min(2, factor)))));
    this.busy = null;
    if (this.turning) this.turn(now);
    this.fit();
    if (this.changed) this.drawCoarse(now);
    else if (this.rest) this.drawFine(now);
    else if (performance.now() - this.moved >= STILL && !this.picture.waits) return this.settle();
    this.ask();
    return undefined;
  }

  // Give the canvas as many pixels as the screen has there, at most two per CSS pixel along an edge.
  fit() {
    const ratio = Math.min(devicePixelRatio, 2), { canvas } = this;
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width === width && canvas.height === height) return;
    canvas.width = width;
    canvas.height = height;
    this.restart();
  }

  drawCoarse(now) {
    const { canvas, scale } = this, width = Math.max(1, Math.round(canvas.width * scale)), height = Math.max(1, Math.round(canvas.height * scale));
    this.changed = false;
    this.picture.look(this.lens, width, height, { ...this.shown, scale });
    this.picture.draw("coarse", width, height);
    this.picture.spread("coarse");
    this.drawn(now, true);
  }

  // Show the canvas only while it contains a whole picture. Until then, and while the WebGL context is lost, the still
  // picture stays visible on the page's own background: an empty canvas would be black.
  reveal(drawn) {
    if (drawn === this.revealed) return;
    this.revealed = drawn;
    this.canvas.classList.toggle("drawn", drawn);
    element("cover").classList.toggle("gone", drawn);
  }

  // Draw a band of lines, from the top: first all lines with one ray per pixel, then all lines with more. Of splats, a
  // band is that share of them, from the nearest one.
  drawFine(now) {
    const { canvas, rest } = this, from = Math.max(0, rest.from - Math.max(this.lines, Math.ceil(canvas.height / this.picture.bands)));
    this.picture.look(this.lens, canvas.width, canvas.height, { ...this.shown, rays: rest.rays });
    this.picture.draw("fine", canvas.width, canvas.height, from, rest.from);
    this.picture.spread("fine");
    rest.from = from;
    if (from === 0) this.rest = rest.rays < this.picture.finest ? { rays: this.picture.finest, from: canvas.height } : null;
    this.finished = !this.rest;
    this.drawn(now, false);
    if (this.finished) this.panel.finished();
  }

  drawn(now, coarse) {
    this.frames++;
    this.busy = { since: now, coarse, moving: coarse && this.moving, done: this.picture.fence() };
  }

  // Called when nothing has moved for a while.
  settle() {
    if (this.finished) return;
    this.moving = false;
    this.picture.spread("coarse", "fine");
    this.rest = { rays: this.scale === 1 ? this.picture.finest : 1, from: this.canvas.height };
    this.ask();
  }

  turn(now) {
    // If a turning scene would be blurred, a still picture is better.
    this.turning = this.angle < 2 * Math.PI && this.scale >= 0.3;
    if (!this.turning) return;
    const step = this.last ? (Math.min(now - this.last, 100) * 2 * Math.PI) / TURN : 0;
    this.last = now;
    this.angle += step;
    this.camera.orbit(step, 0);
    this.moving = true;
    this.change();
  }

  // -- user actions ------------------------------------------------------------------------------------------------
  move(act) {
    this.turning = false;
    this.photograph.show(false);
    act(this.camera);
    this.moving = true;
    this.change();
    clearTimeout(this.keeping);
    this.keeping = setTimeout(() => this.keep(this.camera.hash), 250);
  }

  keep(hash) {
    if (location.protocol !== "about:") history.replaceState(null, "", hash || location.href.split("#")[0]); // a frame in a notebook has no address
  }

  reset() {
    this.move((camera) => camera.set(this.facts.views[this.view]));
    clearTimeout(this.keeping);
    this.keep("");
  }

  next(step) {
    const { facts: { views }, photograph: { shown } } = this;
    this.view = (this.view + step + views.length) % views.length;
    this.move((camera) => camera.set(views[this.view]));
    this.photograph.show(shown);
  }

  show(mode) {
    if (this.facts.modes && !this.facts.modes.includes(mode)) return;
    this.looks.mode = element("mode").value = mode;
    this.change();
  }

  // Select one of the choices of a page with triangles: `nerfbake.choose("highlights", "mlp_constants")`.
  choose(name, value) {
    this.choices[name] = value;
    markChoice(name, value);
    this.change();
  }

  nextBackground() {
    this.backdrop = (this.backdrop + 1) % this.backgrounds.length;
    this.showBackground();
  }

  // The content of a transforms.json with this view alone, for `nerfbake render --cameras`.
  capture() {
    return this.camera.capture(this.canvas.width, this.canvas.height, this.lens.focal);
  }

  // The distance from the camera at a point of the page, in world units; null if nothing is there.
  distanceAt(x, y) {
    const ratio = this.canvas.width / this.canvas.clientWidth;
    return this.picture.distanceAt(this.lens, x * ratio, y * ratio, this.shown);
  }

  lookAt(x, y) {
    const distance = this.distanceAt(x, y), { clientWidth: width, clientHeight: height } = this.canvas;
    if (distance === null) return;
    const focal = (this.lens.focal * Math.min(width, height)) / 2, [right, up, back] = this.camera.rotation;
    const along = unit(plus(plus(back.map((part) => -part), right, (x - width / 2) / focal), up, (height / 2 - y) / focal));
    this.move((camera) => camera.centre(plus(camera.position, along, distance)));
  }
}
