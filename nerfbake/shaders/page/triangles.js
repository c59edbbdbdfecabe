// Unpack the triangles of the page to buffers and textures, and draw them for the rays of a picture.
// nerfbake/formats/page/triangles.py describes how they are packed.

// Unpack columns of four-byte numbers in planes of bytes; each number is stored as the difference from the one before
// it.
function* wordsOf(bytes, rows, columns) {
  const words = new Uint32Array(rows * columns);
  for (let column = 0, at = 0; column < columns; column++, at += 4 * rows) {
    for (let row = 0, last = 0; row < rows; row++) {
      const i = at + row;
      last = (last + (bytes[i] | (bytes[i + rows] << 8) | (bytes[i + 2 * rows] << 16) | (bytes[i + 3 * rows] << 24))) | 0;
      words[row * columns + column] = last;
    }
    yield column / columns;
  }
  return words;
}

// Unpack texels of three bytes, a plane per channel; each byte is stored as the difference from the one before it.
function* texelsOf(bytes, count) {
  const texels = new Uint8Array(3 * count);
  for (let channel = 0, at = 0; channel < 3; channel++) {
    for (let i = channel, last = 0; i < texels.length; i += 3) texels[i] = last = (last + bytes[at++]) & 255;
    yield channel / 3;
  }
  return texels;
}

// Unpack all parts. facts.triangles: parts [{vertices, faces: their numbers; uvs, colours: whether they exist;
// textures: {name: [width, height]}; atlas: its numbers}], hidden: hidden units of the MLP, layers: [inputs, outputs] of
// an MLP of another kind.
function* trianglesOf(bytes, { parts, hidden, layers, size }) {
  let at = 0;
  const take = (length) => bytes.subarray(at, (at += length));
  const words = function* (rows, columns) {
    return yield* scaled(wordsOf(take(4 * rows * columns), rows, columns), at / size, at / size);
  };
  const found = [];
  for (const part of parts) {
    const own = { positions: yield* words(part.vertices, 3), faces: yield* words(part.faces, 3), textures: {} };
    if (part.uvs) own.uvs = yield* words(part.vertices, 2);
    if (part.colours) own.colours = yield* words(part.vertices, 3);
    for (const [name, [width, height]] of Object.entries(part.textures)) {
      own.textures[name] = yield* scaled(texelsOf(take(3 * width * height), width * height), at / size, at / size);
    }
    found.push(own);
  }
  const floats = (array) => new Float32Array(array.buffer);
  const weights = hidden ? { weights0: floats(yield* words(hidden, 6)), weights1: floats(yield* words(hidden, 3)) } : {};
  const deep = [];
  for (const [inputs, outputs] of layers) deep.push({ inputs, outputs, table: floats(yield* words(outputs, inputs + 1)) });
  return { parts: found, weights, deep };
}

// -- on the graphics card ------------------------------------------------------------------------------------------
const UNITS = { diffuse: 8, atlas: 9, labels: 10, atlasFeatures: 11, mlpFeatures: 12, weights0: 13, weights1: 14, features0: 12, features1: 13, features2: 14, opaque: 15 };
const COLOUR_UNIT = 6, FAR_UNIT = 7; // texture units of what is drawn
const MOST_RAYS = 1 << 22; // drawn at a time, 12 bytes each
const PRECISIONS = ["float", "int", "sampler2D"].map((name) => `precision highp ${name};\n`).join("");

class Triangles {
  constructor(gl, facts, { parts, weights, deep }) {
    this.gl = gl;
    this.facts = facts;
    this.weights = weights;
    this.deep = deep;
    this.programs = {};
    this.room = null; // the framebuffer and its textures
    const { triangles } = facts, most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const widest = Math.max(triangles.hidden, 1, ...triangles.parts.flatMap((part) => Object.values(part.textures).flat()));
    if (widest > most) throw new Error(`a texture of ${widest} texels is more than the ${most} that this device's graphics hold`);
    this.most = Math.min(most, ...gl.getParameter(gl.MAX_VIEWPORT_DIMS));
    this.parts = parts.map((part, i) => this.uploaded(part, triangles.parts[i]));
    this.tables = Object.fromEntries(Object.entries(weights).map(([name, table]) => [name, this.table(table, table.length / triangles.hidden)]));
    this.white = this.texture(1, 1, new Uint8Array([255, 255, 255]), gl.NEAREST, gl.REPEAT);
    if (gl.getError() === gl.OUT_OF_MEMORY) throw new Error("this device's graphics have too little memory for this scene");
  }

  uploaded(part, facts) {
    const { gl } = this, array = gl.createVertexArray(), textures = {};
    gl.bindVertexArray(array);
    const kinds = [["positions", 3], ["uvs", 2], ["colours", 3]];
    kinds.forEach(([name, count], place) => {
      if (!part[name]) return;
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, part[name], gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, count, gl.FLOAT, false, 0, 0);
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, part.faces, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    for (const [name, texels] of Object.entries(part.textures)) {
      const [width, height] = facts.textures[name], smooth = (name === "diffuse" && !part.textures.opaque) || name === "atlas";
      textures[name] = this.texture(width, height, texels, smooth ? gl.LINEAR : gl.NEAREST, name === "atlas" ? gl.CLAMP_TO_EDGE : gl.REPEAT);
    }
    return { array, textures, count: part.faces.length, atlas: facts.atlas, coloured: facts.colours };
  }

  texture(width, height, texels, filter, wrap) {
    const { gl } = this, made = this.bound(filter, wrap);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGB8, width, height);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGB, gl.UNSIGNED_BYTE, texels);
    return made;
  }

  // Upload weights as a texture with one line per hidden unit.
  table(weights, width) {
    const { gl } = this, made = this.bound(gl.NEAREST, gl.CLAMP_TO_EDGE);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32F, width, weights.length / width);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, weights.length / width, gl.RED, gl.FLOAT, weights);
    return made;
  }

  bound(filter, wrap, unit = UNITS.diffuse) {
    const { gl } = this, made = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, made);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, filter);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, wrap);
    return made;
  }

  // The program for a name of facts.triangles.highlights; compiled at the first request.
  programFor(highlights) {
    if (this.programs[highlights]) return this.programs[highlights];
    const { gl } = this, { shaders } = this.facts.triangles;
    const own = highlights !== "mlp_constants" ? "" : this.deep.length ? unrolledLayers(this.deep) : unrolled(this.weights);
    const holes = this.parts.some((part) => part.textures.opaque) ? "#define HOLES\n" : "";
    const text = `#version 300 es\n${PRECISIONS}#define ${highlights.toUpperCase()}\n${holes}${shaders.atlas}${own}${shaders.mesh}`;
    const program = linked(gl, begun(gl, shaders.vertex, text, ["position", "uv", "tint"])), names = {};
    const uniform = (name) => (names[name] ??= gl.getUniformLocation(program, name));
    gl.useProgram(program);
    for (const [name, unit] of Object.entries(UNITS)) gl.uniform1i(uniform(name), unit);
    return (this.programs[highlights] = { program, uniform });
  }

  // The number of lines of a picture that are drawn at a time.
  linesOf(width, rays) {
    return Math.max(1, Math.min(Math.floor(MOST_RAYS / (width * rays * rays)), Math.floor(this.most / rays)));
  }

  // The distance from the scene's centre within which everything lies, triangles included.
  reachFrom({ centre, radius, triangles }) {
    return Math.max(radius, Math.hypot(...centre.map((value, axis) => value - triangles.centre[axis])) + triangles.reach);
  }

  // The number of rays along a pixel's edge that fit.
  raysOf(width, height, rays) {
    return Math.max(1, Math.min(rays, Math.floor(this.most / Math.max(width, height))));
  }

  // Draw the colours and distances of a part of a picture: x, y, width and height in pixels, counted from below.
  draw({ camera, size, rays, highlights }, x, y, width, height) {
    const { gl } = this, { program, uniform } = this.programFor(highlights);
    this.bindRoom(width * rays, height * rays);
    gl.viewport(-x * rays, -y * rays, size[0] * rays, size[1] * rays);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.clearBufferuiv(gl.COLOR, 1, [0x7f800000, 0, 0, 0]);
    gl.clearBufferfv(gl.DEPTH, 0, [1]);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(program);
    const { position, rotation, focal } = camera, { centre, reach } = this.facts.triangles;
    const away = Math.hypot(...position.map((value, axis) => value - centre[axis])), farthest = 1.01 * (away + reach);
    gl.uniform3fv(uniform("eye"), position);
    gl.uniformMatrix3fv(uniform("toCamera"), true, rotation.flat());
    gl.uniform2fv(uniform("lens"), size.map((edge) => (focal * Math.min(...size)) / edge));
    gl.uniform2f(uniform("range"), Math.max(0.99 * (away - reach), 2e-4 * farthest), farthest);
    for (const part of this.parts) this.drawPart(part, uniform);
    gl.disable(gl.DEPTH_TEST);
  }

  drawPart({ array, textures, count, atlas, coloured }, uniform) {
    const { gl } = this, held = { diffuse: this.white, opaque: this.white, ...textures, ...this.tables };
    for (const [name, texture] of Object.entries(held)) {
      gl.activeTexture(gl.TEXTURE0 + UNITS[name]);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    }
    for (const [name, value] of Object.entries(atlas ?? {})) gl.uniform1f(uniform(`numbers.${name}`), value);
    gl.uniform1f(uniform("lit"), textures.diffuse ? 0 : 1);
    gl.bindVertexArray(array);
    const grey = textures.diffuse ? 1 : 0.75;
    if (!coloured) gl.vertexAttrib3f(2, grey, grey, grey);
    gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
  }

  // Bind a framebuffer with colours, distances and depths for at least width x height rays. It grows, and never
  // shrinks.
  bindRoom(width, height) {
    const { gl } = this, old = this.room;
    if (old && old.width >= width && old.height >= height) return gl.bindFramebuffer(gl.FRAMEBUFFER, old.frame);
    const room = { width: Math.max(width, old?.width ?? 0), height: Math.max(height, old?.height ?? 0), frame: gl.createFramebuffer() };
    for (const name of ["colour", "far"]) gl.deleteTexture(old?.[name] ?? null);
    gl.deleteRenderbuffer(old?.depth ?? null);
    gl.deleteFramebuffer(old?.frame ?? null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, room.frame);
    for (const [name, unit, format, place] of [["colour", COLOUR_UNIT, gl.RGBA8, 0], ["far", FAR_UNIT, gl.R32UI, 1]]) {
      room[name] = this.bound(gl.NEAREST, gl.CLAMP_TO_EDGE, unit);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, room.width, room.height);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + place, gl.TEXTURE_2D, room[name], 0);
    }
    room.depth = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, room.depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, room.width, room.height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, room.depth);
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
    this.room = room;
    return undefined;
  }
}

// The MLP as a GLSL function with one line per hidden unit.
function unrolled({ weights0, weights1 }) {
  const vector = (table, at) => `vec3(${[0, 1, 2].map((i) => table[at + i].toExponential(9))})`;
  const lines = Array.from({ length: weights1.length / 3 }, (_, unit) => {
    const hidden = `dot(d, ${vector(weights0, 6 * unit)}) + dot(f, ${vector(weights0, 6 * unit + 3)})`;
    return `  sum += max(${hidden}, 0.0) * ${vector(weights1, 3 * unit)};\n`;
  });
  return `vec3 mlp(vec3 d, vec3 f) {\n  vec3 sum = vec3(0.0);\n${lines.join("")}  return sum;\n}\n`;
}

// An MLP of any layers as a GLSL function: four units of a layer are a vec4. It reads three features of each texture.
function unrolledLayers(layers) {
  const number = (value) => value.toExponential(9), textures = Math.ceil((layers[0].inputs - 3) / 3);
  const names = Array.from({ length: textures }, (_, i) => `features${i}`);
  const declared = names.map((name) => `uniform sampler2D ${name};\n`).join("");
  const read = names.map((name, i) => `  vec3 f${i} = texture(${name}, at).rgb;\n`).join("");
  const given = [..."xyz"].map((axis) => `d.${axis}`).concat(Array.from({ length: layers[0].inputs - 3 }, (_, i) => `f${Math.floor(i / 3)}.${"rgb"[i % 3]}`));
  const lines = [];
  let inputs = given;
  layers.forEach(({ outputs, table }, layer) => {
    const width = inputs.length + 1, next = [], last = layer === layers.length - 1;
    for (let first = 0; first < outputs; first += 4) {
      const rows = [0, 1, 2, 3].map((i) => first + i);
      const column = (i) => `vec4(${rows.map((row) => (row < outputs ? number(table[row * width + i]) : "0.0"))})`;
      const terms = inputs.map((input, i) => `${column(i)} * ${input}`), name = `h${layer}_${first / 4}`;
      const sum = [column(inputs.length), ...terms].join(" + ");
      lines.push(`  vec4 ${name} = ${last ? sum : `max(${sum}, 0.0)`};\n`);
      next.push(...[..."xyzw"].slice(0, outputs - first).map((axis) => `${name}.${axis}`));
    }
    inputs = next;
  });
  return `#define MLP_DEEP\n${declared}vec3 mlp(vec3 d, vec2 at) {\n${read}${lines.join("")}  return vec3(${inputs});\n}\n`;
}
