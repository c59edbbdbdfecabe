// Draw splats, as `nerfbake render` does: nearest first, each a triangle around its ellipse.
//
// A first pass computes the ellipse and the colour of each splat, in the order of depth, once a picture. Then parts of
// the splats are blended in a texture of half floats, and after each part the pixels that are opaque by then are closed
// with the depth test. A last pass adds the background.

const NEAR = 0.01; // smallest depth, in world units
const BLUR = 0.3; // added to the variances in a picture of full size, in square pixels
const SPLATS = 4096; // of an instance, as in splats_vertex.glsl
const PARTS = 12; // between which pixels are closed
const HELD = { words: 0, rest: 1, order: 2, first: 3, second: 4, sum: 5 }; // units of the textures
const THIN = 4; // in a coarse picture, one of so many splats is drawn
const STANDS = 2; // for so many, since they hide each other: 1.4 to 2.8 give the pictures that are most similar
const COARSE = 0.5; // scale of a picture from which all splats are drawn
const SORT_WAIT = 1e-7; // views that differ by less, in units of the scene, have the same order

class SplatPicture extends Drawing {
  // changed: called when there is something new to be drawn.
  constructor(canvas, facts, changed) {
    super(canvas, facts);
    const { gl } = this, [project, vertex, blend, close, shown, harmonics] = facts.shaders, version = "#version 300 es\n";
    if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float")) {
      throw new Error("this device's graphics cannot blend half floats");
    }
    this.changed = changed;
    this.finest = 1; // a Gaussian in the picture is already blurred by about a pixel
    this.bands = PARTS; // after each, pixels are closed, which takes as long as some splats
    this.sums = {};
    this.sorter = null;
    this.sorted = null; // the view that the order belongs to
    this.whole = this.thin = null; // the orders of all splats and of some
    this.key = ""; // of what was projected
    const lines = `${version}#define FUNCTIONS ${facts.functions}\n#define TEXELS ${restTexels(facts.functions)}\n`;
    this.programs = {};
    for (const [name, corners, fragment] of [
      ["project", CORNERS, lines + harmonics + project], ["blend", vertex, blend], ["close", CORNERS, close], ["shown", CORNERS, shown],
    ]) this.programs[name] = { built: begun(gl, corners, fragment), names: {}, linked: false };
  }

  // Nothing is drawn until the order is right, so that what rests is right.
  get waits() {
    return this.sorter?.sent !== null;
  }

  stop() {
    this.sorter?.worker.terminate();
  }

  // Compile all programs; the first call waits for them.
  use() {
    for (const name in this.programs) this.program(name);
  }

  // Use a program, and return a function that finds its uniforms.
  program(name) {
    const { gl } = this, program = this.programs[name];
    if (!program.linked) linked(gl, program.built);
    program.linked = true;
    gl.useProgram(program.built);
    const uniform = (key) => (program.names[key] ??= gl.getUniformLocation(program.built, key));
    for (const [key, unit] of Object.entries(HELD)) if (uniform(key)) gl.uniform1i(uniform(key), unit);
    if (uniform("bits")) gl.uniform1i(uniform("bits"), this.bits);
    return uniform;
  }

  // Upload what splatsOf() returned.
  upload({ means, words, rest }) {
    const { gl, facts } = this, most = gl.getParameter(gl.MAX_TEXTURE_SIZE), texels = restTexels(facts.functions);
    this.bits = Math.min(11, 31 - Math.clz32(Math.floor(most / Math.max(2, texels))));
    const across = 1 << this.bits, lines = this.linesOf(facts.splats);
    if (lines > most) throw new Error("these are more splats than this device's graphics can hold");
    this.fill(HELD.words, words, 2 * across, lines);
    if (texels) this.fill(HELD.rest, rest, texels * across, lines);
    this.texture(HELD.order);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32UI, across, lines + this.linesOf(Math.ceil(facts.splats / THIN)));
    this.projected = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.projected);
    for (const [place, unit] of [HELD.first, HELD.second].entries()) {
      const texture = this.texture(unit);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, across, lines);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + place, gl.TEXTURE_2D, texture, 0);
    }
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
    if (gl.getError() === gl.OUT_OF_MEMORY) throw new Error("this device's graphics have too little memory for this scene");
    this.sorter = new Sorter(means, (order, view) => this.take(order, view), (error) => { throw error; });
  }

  texture(unit) {
    const { gl } = this, made = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, made);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    return made;
  }

  // Upload words as a texture of this width and height, four to a texel; the last line may be incomplete.
  fill(unit, words, width, lines) {
    const { gl } = this, whole = Math.floor(words.length / 4 / width), left = words.length / 4 - whole * width;
    this.texture(unit);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, width, lines);
    if (whole) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, whole, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words, 0);
    if (left) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, whole, left, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words, 4 * whole * width);
  }

  // Take the order for a view, and have the picture drawn again.
  take(order, view) {
    this.hold(order, view);
    this.changed();
  }

  // The same splats are thinned out in every order, so that nothing flickers.
  hold(order, view) {
    this.thin = { order: order.filter((splat) => splat % THIN === 0), line: this.linesOf(this.facts.splats), times: STANDS };
    this.whole = { order, line: 0, times: 1 };
    for (const { order, line } of [this.whole, this.thin]) this.fillOrder(order, line);
    this.sorted = view;
    this.key = "";
  }

  fillOrder(order, line) {
    const { gl } = this, across = 1 << this.bits, whole = order.length >> this.bits, left = order.length & (across - 1);
    gl.activeTexture(gl.TEXTURE0 + HELD.order);
    if (whole) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, line, across, whole, gl.RED_INTEGER, gl.UNSIGNED_INT, order, 0);
    if (left) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, line + whole, left, 1, gl.RED_INTEGER, gl.UNSIGNED_INT, order, whole * across);
  }

  linesOf(count) {
    return Math.ceil(count / (1 << this.bits));
  }

  // What is drawn: {order, its line in the texture, times: the number of splats that each stands for}.
  get list() {
    return this.shot.scale < COARSE ? this.thin : this.whole;
  }

  // Set what the next draw() shows, as Picture.look() does. scale: of the picture, relative to that at rest. Splats are
  // blurred by BLUR in the picture at rest, and in a smaller one have the opacity that makes it look the same.
  look(camera, width, height, { background, mode = "colour", clip = UNCLIPPED, scale = 1, aim = null }) {
    const { facts } = this, { position, rotation } = camera;
    const away = Math.hypot(...position.map((value, axis) => value - facts.centre[axis]));
    const range = [Math.max(away - facts.radius, 0), away + facts.radius];
    this.shot = { position, rotation, size: [width, height], focal: (camera.focal * Math.min(width, height)) / 2, background, mode, clip, scale, aim, range };
    return range[1];
  }

  // Sort for the view of look(): now, if there is no order yet or the picture is needed at once.
  sort(atOnce) {
    const { position, rotation } = this.shot, along = rotation[2].map((part) => -part), view = { position: [...position], along, near: NEAR };
    const same = (other) => other && this.differ(other, view) <= SORT_WAIT;
    if (same(this.sorted)) {
      this.sorter.next = null;
      return;
    }
    if (atOnce || !this.sorted) this.hold(this.sorter.now(view), view);
    else if (!same(this.sorter.sent) && !same(this.sorter.next)) this.sorter.ask(view);
  }

  differ(a, b) {
    const { radius } = this.facts;
    return Math.max(...a.along.map((part, i) => Math.abs(part - b.along[i])), ...a.position.map((part, i) => Math.abs(part - b.position[i]) / radius));
  }

  // Draw a whole picture, or the part of the splats that from .. to - 1 of its lines stand for, from the nearest one.
  draw(name, width, height, from = 0, to = height) {
    const { gl, shot } = this, first = to === height, last = from === 0;
    if (first) this.sort(name === "aside");
    const count = this.list.order.length;
    this.project();
    const sum = this.sumOf(name, width, height), [x, y] = shot.mode === "pick" ? shot.aim.map(Math.floor) : [0, 0];
    gl.bindFramebuffer(gl.FRAMEBUFFER, sum.frame);
    if (first) {
      gl.depthMask(true);
      gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
      gl.clearBufferfv(gl.DEPTH, 0, [1]);
    }
    this.blend(sum, x, y, Math.floor(count * (1 - to / height)), last ? count : Math.floor(count * (1 - from / height)));
    if (!last) return;
    this.bind(name, width, height);
    const uniform = this.program("shown");
    gl.activeTexture(gl.TEXTURE0 + HELD.sum);
    gl.bindTexture(gl.TEXTURE_2D, sum.texture);
    gl.uniform3fv(uniform("background"), shot.background);
    gl.uniform1i(uniform("mode"), MODES[shot.mode]);
    gl.uniform2fv(uniform("range"), shot.range);
    gl.uniform2fv(uniform("size"), shot.size);
    gl.uniform2f(uniform("corner"), x, y);
    gl.uniform1f(uniform("focal"), shot.focal);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Compute the ellipses and colours of all splats, unless that was done for this view.
  project() {
    const { gl, facts, shot } = this, { position, rotation, size, focal, mode, clip, scale, range } = shot;
    const key = JSON.stringify([position, rotation, size, focal, mode, clip, scale]);
    if (key === this.key) return;
    this.key = key;
    const { order, line, times } = this.list;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.projected);
    gl.viewport(0, 0, 1 << this.bits, this.linesOf(order.length));
    const uniform = this.program("project"), far = (part, end) => (part === end ? (end ? 1e30 : -1e30) : part);
    gl.uniform3fv(uniform("eye"), position);
    gl.uniformMatrix3fv(uniform("axes"), false, rotation.flat());
    gl.uniform2fv(uniform("size"), size);
    gl.uniform1f(uniform("focal"), focal);
    gl.uniform1f(uniform("blur"), facts.antialiased ? 0 : BLUR * scale * scale);
    gl.uniform1i(uniform("mode"), MODES[mode]);
    gl.uniform1i(uniform("count"), order.length);
    gl.uniform1i(uniform("line"), line);
    gl.uniform1f(uniform("times"), times);
    gl.uniform1f(uniform("farthest"), range[1]);
    gl.uniformMatrix4x3fv(uniform("place"), true, facts.place.flat());
    gl.uniform3fv(uniform("lowest"), clip[0].map((part) => far(part, 0)));
    gl.uniform3fv(uniform("highest"), clip[1].map((part) => far(part, 1)));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Blend splats begin .. end - 1 of the order; x, y: the pixel of the picture at the lower left of the texture.
  blend(sum, x, y, begin, end) {
    const { gl, shot } = this, [width, height] = shot.size, count = this.list.order.length, part = Math.max(SPLATS, Math.ceil(count / PARTS));
    gl.enable(gl.DEPTH_TEST);
    for (let first = begin; first < end; first += part) {
      const until = Math.min(end, first + part), uniform = this.program("blend");
      gl.bindFramebuffer(gl.FRAMEBUFFER, sum.frame);
      gl.viewport(-x, -y, width, height);
      gl.depthMask(false);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
      gl.uniform2fv(uniform("size"), shot.size);
      gl.uniform2f(uniform("corner"), x, y);
      gl.uniform2i(uniform("range"), first, until);
      gl.drawArraysInstanced(gl.TRIANGLES, 0, 3 * SPLATS, Math.ceil((until - first) / SPLATS));
      gl.disable(gl.BLEND);
      gl.depthMask(true);
      if (until < count) this.close(sum);
    }
    gl.disable(gl.DEPTH_TEST);
  }

  // Close the pixels that are opaque: later splats fail the depth test there.
  close(sum) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, sum.closing);
    gl.viewport(0, 0, sum.width, sum.height);
    gl.activeTexture(gl.TEXTURE0 + HELD.sum);
    gl.bindTexture(gl.TEXTURE_2D, sum.texture);
    this.program("close");
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // The texture in which the splats of a picture are blended, and its framebuffers.
  sumOf(name, width, height) {
    const { gl } = this, old = this.sums[name];
    if (old?.width === width && old?.height === height) return old;
    const sum = { width, height, frame: gl.createFramebuffer(), closing: gl.createFramebuffer(), texture: this.texture(HELD.sum), depth: gl.createRenderbuffer() };
    for (const part of ["texture", "depth", "frame", "closing"]) if (old) gl[{ texture: "deleteTexture", depth: "deleteRenderbuffer" }[part] ?? "deleteFramebuffer"](old[part]);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
    gl.bindRenderbuffer(gl.RENDERBUFFER, sum.depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT16, width, height);
    for (const frame of [sum.closing, sum.frame]) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, sum.depth);
    }
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, sum.texture, 0);
    return (this.sums[name] = sum);
  }
}
