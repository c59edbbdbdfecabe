// Pictures of the graphics card: programs, framebuffers, and what is read back from them.

const MODES = { colour: 0, first: 1, depth: 2, normals: 5, steps: 3, pick: 4 };
const CUT = 1e-4; // the transmittance below which a ray ends, as in `nerfbake render`
const UNCLIPPED = [[0, 0, 0], [1, 1, 1]];

const CORNERS = "#version 300 es\nvoid main() {\n  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0, 1);\n}";

// Start to compile a program of two shaders; attributes: names, in the order of their locations.
function begun(gl, vertex, fragment, attributes = []) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const part = gl.createShader(kind);
    gl.shaderSource(part, source);
    gl.compileShader(part);
    gl.attachShader(program, part);
  }
  attributes.forEach((name, place) => gl.bindAttribLocation(program, place, name));
  gl.linkProgram(program);
  return program;
}

// Wait until such a program is compiled, and return it. Throws the compiler's message if it failed.
function linked(gl, program) {
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const [first] = gl.getAttachedShaders(program).map((part) => gl.getShaderInfoLog(part)).filter(Boolean);
    throw new Error("the shader does not run here: " + (first || gl.getProgramInfoLog(program)));
  }
  return program;
}

// What draws pictures of a scene. A class for a kind of scene has these methods besides:
//   upload(level)   take what Carried.level() returned
//   use(...)        compile the program of the next picture
//   look(camera, width, height, options)   set what the next draw() shows, and return the far end of the depth range
//   draw(name, width, height, from, to)    draw a whole picture, or lines from .. to - 1, counted from below
class Drawing {
  constructor(canvas, facts) {
    const options = { alpha: false, antialias: false, depth: false };
    const gl = canvas.getContext("webgl2", options);
    if (!gl) throw new Error("no WebGL2");
    this.canvas = canvas;
    this.facts = facts;
    this.gl = gl;
    this.frames = {};
    this.triangles = null;
    this.finest = 2; // rays along a pixel's edge at rest
    this.bands = Infinity; // most bands in which a picture is drawn at rest
  }

  // What the next picture is drawn from is still being prepared.
  get waits() {
    return false;
  }

  // The graphics card has taken everything away, and another drawing takes this one's place.
  stop() {}

  // Bind the framebuffer `coarse`, `fine` or `aside`, with look()'s width and height; creates it if necessary.
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

  // Scale a picture to the size of the canvas, and copy it to another picture or to the canvas.
  spread(name, over = null) {
    const { gl, canvas } = this, { frame, width, height } = this.frames[name];
    if (over) this.bind(over, canvas.width, canvas.height);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, frame);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, over ? this.frames[over].frame : null);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, canvas.width, canvas.height, gl.COLOR_BUFFER_BIT, gl.LINEAR);
  }

  // Draw a picture, and return its bytes, four per pixel, lines from the top.
  pixels(camera, width, height, options) {
    const own = /** @type {any} */ (this);
    own.look(camera, width, height, options);
    own.draw("aside", width, height);
    return this.held("aside").bytes;
  }

  // The contents of a picture: {width, height, bytes}.
  held(name) {
    const { gl } = this, { frame, width, height } = this.frames[name], line = 4 * width, found = new Uint8Array(line * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, found);
    const bytes = new Uint8Array(found.length);
    for (let y = 0; y < height; y++) bytes.set(found.subarray(y * line, (y + 1) * line), (height - 1 - y) * line);
    return { width, height, bytes };
  }

  // The distance from the camera at a pixel of the canvas, counted from the upper left, in world units; null if nothing
  // is there.
  distanceAt(camera, x, y, looks) {
    const { gl, canvas } = this, own = /** @type {any} */ (this), options = { ...looks, mode: "pick", aim: [x, canvas.height - y] };
    const most = own.look(camera, canvas.width, canvas.height, options), found = new Uint8Array(4);
    own.draw("aside", 1, 1);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, found);
    return found[3] < 64 ? null : ((found[0] * 65536 + found[1] * 256 + found[2]) / 16777216) * most;
  }

  // A function that returns true once everything drawn so far is complete.
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
