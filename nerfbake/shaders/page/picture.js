// Upload the field to textures of the graphics card, and draw pictures of it.

const CUTOUT = 0.5; // the same for an opaque cutout
const AROUND_UNIT = 4; // the texture unit of the shells' grids

class Picture extends Drawing {
  constructor(canvas, facts, shader) {
    super(canvas, facts);
    this.shader = shader;
    this.shot = null; // the settings of look() for triangles
    this.textures = [];
    this.programs = {};
    this.constants = {};
    this.begin(facts.lookup === "trilinear", false);
  }

  // The program for a lookup, with or without normals. Compiling takes a while, so it starts at the first request.
  begin(smoothly, normals) {
    const { gl, facts, shader, programs } = this, name = `${smoothly} ${normals}`;
    if (!programs[name]) {
      const groups = (facts.texels - 1) / 3, base = facts.basis === "RGBA" ? "1.0" : "0.28209479177387814";
      const switches = { BYTES: facts.kind === "svoq", SMOOTH: smoothly, NORMALS: normals, MESHES: !!facts.triangles };
      const shells = { SHELLS: facts.around?.length ?? 0, AROUND: facts.around?.[0].shape[0] ?? 0 };
      const defines = { GROUPS: groups, BASE: base, TEXELS: facts.texels, ...shells, ...switches };
      const lines = Object.entries(defines).map(([key, value]) => `#define ${key} ${typeof value === "boolean" ? Number(value) : value}\n`).join("");
      const fragment = shader.replace("#version 300 es\n", "#version 300 es\n" + lines);
      programs[name] = { built: begun(gl, CORNERS, fragment), linked: false, names: {}, constants: null };
    }
    return programs[name];
  }

  use(smoothly, normals) {
    const { gl } = this, program = this.begin(smoothly, normals), { names, built } = program;
    if (!program.linked) linked(gl, built);
    program.linked = true;
    gl.useProgram(built);
    this.program = built;
    this.uniform = (key) => (names[key] ??= gl.getUniformLocation(built, key));
    if (program.constants !== this.constants) for (const key in this.constants) this.constants[key](this.uniform(key));
    program.constants = this.constants;
  }

  uploadTriangles(triangles) {
    this.triangles = new Triangles(this.gl, this.facts, triangles);
  }

  // Upload a level of detail that Carried.level() returned. Its arrays are not needed afterwards.
  upload({ top, around, blocks, texels, bytes, densities, lows, widths, facts }) {
    const { gl } = this, most = gl.getParameter(gl.MAX_TEXTURE_SIZE), T = facts.texels, colours = bytes ?? texels;
    const [X, Y, Z] = facts.shape, across = Math.floor(most / T), rows = colours.length / (4 * T);
    const blockBits = Math.min(12, 31 - Math.clz32(most)), lines = Math.ceil(rows / across);
    const blockLines = Math.max(Math.ceil(blocks.length / 4 / (1 << blockBits)), 1);
    if (lines > most || blockLines > most || Math.max(X, Y, Z) > gl.getParameter(gl.MAX_3D_TEXTURE_SIZE)) {
      throw new Error("this scene is larger than what this device's graphics can hold");
    }
    this.facts = facts;
    this.texture(0, gl.TEXTURE_3D);
    this.fillGrid(top, X, Y, Z);
    if (around) {
      const [A] = facts.around[0].shape;
      this.texture(AROUND_UNIT, gl.TEXTURE_3D);
      this.fillGrid(around, A * facts.around.length, A, A);
    }
    this.texture(1, gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, 1 << blockBits, blockLines);
    this.fill(1 << blockBits, blocks, 4, gl.RGBA_INTEGER, gl.UNSIGNED_INT);
    this.texture(2, gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, bytes ? gl.RGBA8 : gl.RGBA16F, across * T, lines);
    this.fill(across * T, colours, 4, gl.RGBA, bytes ? gl.UNSIGNED_BYTE : gl.HALF_FLOAT);
    if (bytes) {
      gl.pixelStorei(gl.UNPACK_ALIGNMENT, 2);
      this.texture(3, gl.TEXTURE_2D);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R16F, across, lines);
      this.fill(across, densities, 1, gl.RED, gl.HALF_FLOAT);
    }
    const functions = 1 + (4 * (T - 1)) / 3, place = facts.place.flatMap((row) => row.slice(0, 3));
    this.constants = {
      top: (at) => gl.uniform1i(at, 0),
      blocks: (at) => gl.uniform1i(at, 1),
      texels: (at) => gl.uniform1i(at, 2),
      densities: (at) => gl.uniform1i(at, 3),
      lows: (at) => gl.uniform3fv(at, lows ?? new Float32Array(3 * functions)),
      widths: (at) => gl.uniform1fv(at, widths ?? new Float32Array(functions).fill(1)),
      blockBits: (at) => gl.uniform1i(at, blockBits),
      rowsAcross: (at) => gl.uniform1i(at, across),
      densityUnit: (at) => gl.uniform1f(at, facts.densityUnit),
      worldToVoxels: (at) => gl.uniformMatrix3fv(at, true, place),
      ...(around ? { around: (at) => gl.uniform1i(at, AROUND_UNIT), frames: (at) => gl.uniform4fv(at, framesOf(facts)) } : {}),
    };
    if (gl.getError() === gl.OUT_OF_MEMORY) throw new Error("this device's graphics have too little memory for this scene");
  }

  texture(unit, kind) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.deleteTexture(this.textures[unit] ?? null);
    gl.bindTexture(kind, (this.textures[unit] = gl.createTexture()));
    gl.texParameteri(kind, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(kind, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  }

  // Upload a grid, which is z-fastest. A texture is x-fastest, and the shader indexes x, y, z like the page.
  fillGrid(grid, X, Y, Z) {
    const { gl } = this, turned = new Int32Array(grid.length);
    for (let x = 0, i = 0; x < X; x++) {
      for (let y = 0; y < Y; y++) for (let z = 0; z < Z; z++) turned[(z * Y + y) * X + x] = grid[i++];
    }
    gl.texStorage3D(gl.TEXTURE_3D, 1, gl.R32I, X, Y, Z);
    gl.texSubImage3D(gl.TEXTURE_3D, 0, 0, 0, 0, X, Y, Z, gl.RED_INTEGER, gl.INT, turned);
  }

  // Upload texels of `channels` numbers each, line by line; the last line may be incomplete.
  fill(width, numbers, channels, format, type) {
    const { gl } = this, count = numbers.length / channels, whole = Math.floor(count / width), rest = count - whole * width;
    if (whole) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, whole, format, type, numbers, 0);
    if (rest) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, whole, rest, 1, format, type, numbers, channels * width * whole);
  }

  // Set what the next draw() shows. camera: {position, rotation (columns right, up, back), focal: relative to half the
  // shorter edge}; mode: a key of MODES; smoothly: trilinear; clip: the part of the box that is shown, 0 to 1; cut: the
  // transmittance below which a ray ends; rays: along a pixel's edge. For triangles: highlights and composite, names
  // from the page's facts; shadow: a light above the scene casts the field's shadow. Returns the far end of the depth
  // range.
  look(camera, width, height, { background, mode = "colour", smoothly = false, clip = UNCLIPPED, cut = CUT, rays = 1, aim = [0, 0], ...more }) {
    const { gl, facts, triangles } = this, { place, axes } = facts, { position, rotation } = camera;
    this.use(smoothly, mode === "normals");
    const { highlights = facts.triangles?.highlights[0], composite = facts.triangles?.composites[0], shadow = false } = more;
    if (triangles) rays = triangles.raysOf(width, height, rays);
    this.shot = { camera, size: [width, height], rays, highlights, aim: mode === "pick" ? aim.map(Math.floor) : null };
    const eye = place.map((row) => row[0] * position[0] + row[1] * position[1] + row[2] * position[2] + row[3]);
    // WebGL's matrices are column-major, and so are rotations here.
    const times = (rows) => [0, 1, 2].flatMap((c) => rows.map((row) => row[0] * rotation[c][0] + row[1] * rotation[c][1] + row[2] * rotation[c][2]));
    gl.uniform3fv(this.uniform("eye"), eye);
    gl.uniformMatrix3fv(this.uniform("toVoxels"), false, times(place));
    gl.uniformMatrix3fv(this.uniform("toAxes"), false, times(axes));
    gl.uniform2f(this.uniform("size"), width, height);
    gl.uniform1f(this.uniform("focal"), (camera.focal * Math.min(width, height)) / 2);
    gl.uniform3fv(this.uniform("background"), background);
    gl.uniform1i(this.uniform("rays"), rays);
    gl.uniform1i(this.uniform("mode"), MODES[mode]);
    // A cutout ignores everything behind the point where half of the light is lost.
    gl.uniform1f(this.uniform("cut"), composite === "cutout" ? Math.max(cut, CUTOUT) : cut);
    gl.uniform1i(this.uniform("ztest"), composite === "ztest" ? 1 : 0);
    gl.uniform3fv(this.uniform("light"), rotation.map((axis) => (shadow ? dot(axis, facts.up) : 0)));
    // Interpolated values extend half a voxel beyond the voxels.
    const [low, high] = facts.box, reach = smoothly ? 0.5 : 0, at = (part, axis) => low[axis] - reach + part * (high[axis] - low[axis] + 2 * reach);
    gl.uniform3fv(this.uniform("boxLow"), clip[0].map(at));
    gl.uniform3fv(this.uniform("boxHigh"), clip[1].map(at));
    const away = Math.hypot(...position.map((value, axis) => value - facts.centre[axis]));
    // Depths are shown in the range of the inner cube, but measured wherever something is drawn.
    const longest = triangles ? triangles.reachFrom(facts) : facts.around ? diagonalOf(facts) : facts.radius;
    const farthest = away + (mode === "pick" ? longest : facts.radius);
    gl.uniform2f(this.uniform("range"), Math.max(away - facts.radius, 0), farthest);
    gl.uniform2fv(this.uniform("aim"), aim);
    const whole = clip[0].every((part) => part <= 0) && clip[1].every((part) => part >= 1);
    if (facts.around) gl.uniform1i(this.uniform("alone"), whole ? 0 : 1);
    return farthest;
  }

  // Draw a whole picture, or its lines from .. to - 1, counted from below.
  draw(name, width, height, from = 0, to = height) {
    const { gl } = this;
    const step = this.triangles?.linesOf(width, this.shot.rays) ?? to - from;
    for (let low = from; low < to; low += step) {
      const lines = Math.min(step, to - low);
      this.drawTriangles(width, low, lines);
      this.bind(name, width, height);
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(0, low, width, lines);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
      gl.disable(gl.SCISSOR_TEST);
    }
  }

  // Draw the triangles that rays meet: for this number of lines, or for the one pixel that is picked.
  drawTriangles(width, low, lines) {
    const { gl, triangles, shot } = this;
    if (!triangles) return;
    const [x, y] = shot.aim ?? [0, low];
    triangles.draw(shot, x, y, shot.aim ? 1 : width, shot.aim ? 1 : lines);
    gl.useProgram(this.program);
    gl.uniform1i(this.uniform("meshColour"), COLOUR_UNIT);
    gl.uniform1i(this.uniform("meshFar"), FAR_UNIT);
    gl.uniform2i(this.uniform("corner"), x, y);
  }
}
