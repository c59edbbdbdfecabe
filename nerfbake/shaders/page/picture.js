// The field in a graphics card's textures, and pictures of it.

const MODES = { colour: 0, first: 1, depth: 2, steps: 3, pick: 4 };
const CUT = 1e-4; // the share of light below which a ray ends, as `nerfbake render` has it

class Picture {
  constructor(canvas, facts, shader) {
    const options = { alpha: false, antialias: false, depth: false };
    const gl = canvas.getContext("webgl2", options);
    if (!gl) throw new Error("no WebGL2");
    Object.assign(this, { canvas, facts, gl, names: {}, frames: {} });
    const groups = (facts.texels - 1) / 3, base = facts.rgba ? "1.0" : "0.28209479177387814";
    const defines = `\n#define GROUPS ${groups}\n#define BASE ${base}\n#define TEXELS ${facts.texels}\n`;
    const corners = "#version 300 es\nvoid main() {\n  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0, 1);\n}";
    const program = gl.createProgram();
    for (const [kind, text] of [
      [gl.VERTEX_SHADER, corners],
      [gl.FRAGMENT_SHADER, shader.replace("#version 300 es\n", "#version 300 es" + defines)],
    ]) {
      const part = gl.createShader(kind);
      gl.shaderSource(part, text);
      gl.compileShader(part);
      gl.attachShader(program, part);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error("the shader does not run here: " + gl.getProgramInfoLog(program));
    }
    gl.useProgram(program);
    this.uniform = (name) => (this.names[name] ??= gl.getUniformLocation(program, name));
  }

  // Hands the arrays over; they are not needed any more behind this.
  upload({ top, blocks, texels }) {
    const { gl, facts } = this, most = gl.getParameter(gl.MAX_TEXTURE_SIZE), T = facts.texels;
    const [X, Y, Z] = facts.shape, across = Math.floor(most / T), rows = texels.length / (4 * T);
    const blockBits = Math.min(12, 31 - Math.clz32(most)), lines = Math.ceil(rows / across);
    const blockLines = Math.max(Math.ceil(blocks.length / 4 / (1 << blockBits)), 1);
    if (lines > most || blockLines > most || Math.max(X, Y, Z) > gl.getParameter(gl.MAX_3D_TEXTURE_SIZE)) {
      throw new Error("this scene is larger than what this device's graphics can hold");
    }
    // The grid's z is fastest, as a texture's x is: shader and page count x, y, z, so that it is turned here.
    const turned = new Int32Array(top.length);
    for (let x = 0, i = 0; x < X; x++) {
      for (let y = 0; y < Y; y++) for (let z = 0; z < Z; z++) turned[(z * Y + y) * X + x] = top[i++];
    }
    this.texture(0, "top", gl.TEXTURE_3D);
    gl.texStorage3D(gl.TEXTURE_3D, 1, gl.R32I, X, Y, Z);
    gl.texSubImage3D(gl.TEXTURE_3D, 0, 0, 0, 0, X, Y, Z, gl.RED_INTEGER, gl.INT, turned);
    this.texture(1, "blocks", gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, 1 << blockBits, blockLines);
    this.fill(1 << blockBits, blocks, gl.RGBA_INTEGER, gl.UNSIGNED_INT);
    this.texture(2, "texels", gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, across * T, lines);
    this.fill(across * T, texels, gl.RGBA, gl.HALF_FLOAT);
    gl.uniform1i(this.uniform("blockBits"), blockBits);
    gl.uniform1i(this.uniform("rowsAcross"), across);
    gl.uniform1f(this.uniform("densityUnit"), facts.densityUnit);
    gl.uniform3fv(this.uniform("boxLow"), facts.box[0]);
    gl.uniform3fv(this.uniform("boxHigh"), facts.box[1]);
    gl.uniform1f(this.uniform("cut"), CUT);
    if (gl.getError() === gl.OUT_OF_MEMORY) throw new Error("this device's graphics have too little memory for this scene");
  }

  texture(unit, name, kind) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(kind, gl.createTexture());
    gl.texParameteri(kind, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(kind, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.uniform1i(this.uniform(name), unit);
  }

  // Texels of four numbers, line by line; the last line may be a part of one.
  fill(width, numbers, format, type) {
    const { gl } = this, count = numbers.length / 4, whole = Math.floor(count / width), rest = count - whole * width;
    if (whole) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, whole, format, type, numbers, 0);
    if (rest) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, whole, rest, 1, format, type, numbers, 4 * width * whole);
  }

  // Says what the next draw() shows. camera: {position, rotation (columns right, up, back), focal: of half the shorter
  // edge}; mode: a name of MODES; rays: along a pixel's edge.
  look(camera, width, height, { background, mode = "colour", rays = 1, aim = [0, 0] }) {
    const { gl, facts } = this, { place, axes } = facts, { position, rotation } = camera;
    const eye = place.map((row) => row[0] * position[0] + row[1] * position[1] + row[2] * position[2] + row[3]);
    // WebGL's matrices stand column by column, and so do rotations here.
    const times = (rows) => [0, 1, 2].flatMap((c) => rows.map((row) => row[0] * rotation[c][0] + row[1] * rotation[c][1] + row[2] * rotation[c][2]));
    gl.uniform3fv(this.uniform("eye"), eye);
    gl.uniformMatrix3fv(this.uniform("toVoxels"), false, times(place));
    gl.uniformMatrix3fv(this.uniform("toAxes"), false, times(axes));
    gl.uniform2f(this.uniform("size"), width, height);
    gl.uniform1f(this.uniform("focal"), (camera.focal * Math.min(width, height)) / 2);
    gl.uniform3fv(this.uniform("background"), background);
    gl.uniform1i(this.uniform("rays"), rays);
    gl.uniform1i(this.uniform("mode"), MODES[mode]);
    const away = Math.hypot(...position.map((value, axis) => value - facts.centre[axis]));
    gl.uniform2f(this.uniform("range"), Math.max(away - facts.radius, 0), away + facts.radius);
    gl.uniform2fv(this.uniform("aim"), aim);
    return away + facts.radius;
  }

  // A picture beside the canvas, of look()'s width and height: `coarse`, `fine` or `aside`; made where it is missing.
  bind(name, width, height) {
    const { gl } = this, old = this.frames[name];
    if (old?.width !== width || old?.height !== height) {
      const own = { width, height, frame: gl.createFramebuffer(), pixels: gl.createRenderbuffer() };
      gl.bindRenderbuffer(gl.RENDERBUFFER, own.pixels);
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, width, height);
      gl.bindFramebuffer(gl.FRAMEBUFFER, own.frame);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, own.pixels);
      this.frames[name] = own;
      if (old) gl.deleteRenderbuffer(old.pixels);
      if (old) gl.deleteFramebuffer(old.frame);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frames[name].frame);
    gl.viewport(0, 0, width, height);
  }

  // All of a picture, or its lines from .. to - 1, counted from below.
  draw(name, width, height, from = 0, to = height) {
    const { gl } = this;
    this.bind(name, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, from, width, to - from);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
  }

  // A picture, spread over another one, or over the canvas.
  spread(name, over = null) {
    const { gl, canvas } = this, { frame, width, height } = this.frames[name];
    if (over) this.bind(over, canvas.width, canvas.height);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, frame);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, over ? this.frames[over].frame : null);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, canvas.width, canvas.height, gl.COLOR_BUFFER_BIT, gl.LINEAR);
  }

  // The same as bytes, four a pixel, lines from the top.
  pixels(camera, width, height, options) {
    const { gl } = this, line = 4 * width, found = new Uint8Array(line * height);
    this.look(camera, width, height, options);
    this.draw("aside", width, height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, found);
    const turned = new Uint8Array(found.length);
    for (let y = 0; y < height; y++) turned.set(found.subarray(y * line, (y + 1) * line), (height - 1 - y) * line);
    return turned;
  }

  // The distance from the camera at a pixel of the canvas, counted from the upper left, in world units; null: nothing.
  distanceAt(camera, x, y) {
    const { gl, canvas } = this, options = { background: [0, 0, 0], mode: "pick", aim: [x, canvas.height - y] };
    const most = this.look(camera, canvas.width, canvas.height, options), found = new Uint8Array(4);
    this.draw("aside", 1, 1);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, found);
    return found[3] < 64 ? null : ((found[0] * 65536 + found[1] * 256 + found[2]) / 16777216) * most;
  }

  // Something that is signalled once all that was drawn is there.
  fence() {
    const { gl } = this, sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    return () => {
      const state = gl.isContextLost() ? gl.ALREADY_SIGNALED : gl.clientWaitSync(sync, 0, 0);
      const done = state !== gl.TIMEOUT_EXPIRED;
      if (done) gl.deleteSync(sync);
      return done;
    };
  }
}
