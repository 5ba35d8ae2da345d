// Draws Gaussians with WebGL2, as edge_server/fields/splat/kernels/project.py and composite.py do on the edge.
//
// Records are textures of integers, which the vertex shader unpacks: the processor touches places only, to sort them.

const WIDTH = 1024; // of textures that hold lists
const MOST_ANCHORS = 256;

const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D statics, movings, attached, order, unseen;
uniform sampler2D anchors;
uniform uint staticCount;
uniform vec4 scales;           // low and step of log scales: static, moving
uniform mat3 turn;             // world axes to camera axes (x right, y down, z ahead)
uniform vec3 eye;              // scene units
uniform float near, focal, depthView;
uniform vec2 size, limit;
out vec2 offset;               // from the middle along the axes of the ellipse: its square is the exponent of 2
flat out vec4 color;           // and the exponent in the middle
flat out uint guessed;

const float ZONE = ${Math.SQRT2 - 1};
const float LOW_PASS = 0.3;
const float PER_SIGMA = ${Math.sqrt(0.5 / Math.LN2)}; // exp(-x * x / 2) is exp2(-y * y) of y = x * PER_SIGMA

ivec2 cell(uint n) { return ivec2(int(n % ${WIDTH}u), int(n / ${WIDTH}u)); }
vec3 expand(vec3 u) {
  vec3 far = sign(u) / max(2.0 - abs(u), 1e-6);
  return mix(u, far, step(1.0, abs(u)));
}
vec3 unpack(uint word) { return vec3(float(word & 255u), float((word >> 8) & 255u), float((word >> 16) & 255u)); }

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  // outside, unless it is drawn
  offset = vec2(0.0); color = vec4(0.0); guessed = 0u;
  uint index = texelFetch(order, cell(uint(gl_VertexID) >> 2), 0).x;
  bool moves = index >= staticCount;
  uint row = moves ? index - staticCount : index;
  uvec4 w = moves ? texelFetch(movings, cell(row), 0) : texelFetch(statics, cell(row), 0);
  vec3 place = expand(vec3(float(w.x & 65535u), float(w.x >> 16), float(w.y & 65535u)) * (4.0 / 65535.0) - 2.0);
  if (moves) {
    uvec2 a = texelFetch(attached, cell(row), 0).xy;
    vec2 share = vec2(float(a.x >> 24), float(a.y & 255u)) / 255.0;
    place += share.x * texelFetch(anchors, ivec2(int(a.x & 255u), 0), 0).xyz
      + share.y * texelFetch(anchors, ivec2(int((a.x >> 8) & 255u), 0), 0).xyz
      + (1.0 - share.x - share.y) * texelFetch(anchors, ivec2(int((a.x >> 16) & 255u), 0), 0).xyz;
  } else {
    guessed = texelFetch(unseen, cell(row), 0).x;
  }
  vec3 p = turn * (place - eye);
  float alpha = float(w.w >> 24) / 255.0;
  float most = 2.0 * log(max(alpha * 255.0, 1e-6));
  if (p.z <= near || most <= 0.0) return;

  vec2 range = moves ? scales.zw : scales.xy;
  vec3 s = exp(vec3(float((w.y >> 16) & 255u), float(w.y >> 24), float(w.z & 255u)) * range.y + range.x);
  vec3 g = unpack(w.z >> 8) * (2.0 * ZONE / 255.0) - ZONE;  // Rodrigues vector
  vec4 q = vec4(g, 1.0) * inversesqrt(1.0 + dot(g, g));
  vec3 v = q.xyz, d = q.xyz * q.w;
  mat3 axes = mat3(
    1.0 - 2.0 * (v.y * v.y + v.z * v.z), 2.0 * (v.x * v.y + d.z), 2.0 * (v.x * v.z - d.y),
    2.0 * (v.x * v.y - d.z), 1.0 - 2.0 * (v.x * v.x + v.z * v.z), 2.0 * (v.y * v.z + d.x),
    2.0 * (v.x * v.z + d.y), 2.0 * (v.y * v.z - d.x), 1.0 - 2.0 * (v.x * v.x + v.y * v.y));
  axes[0] *= s.x; axes[1] *= s.y; axes[2] *= s.z;
  mat3 m = turn * axes;

  vec2 ratio = p.xy / p.z, held = clamp(ratio, -limit, limit);
  float scale = focal / p.z;
  vec3 across = vec3(scale, 0.0, -scale * held.x) * m, down = vec3(0.0, scale, -scale * held.y) * m;
  float e = dot(across, across) + LOW_PASS, f = dot(across, down), h = dot(down, down) + LOW_PASS;
  float middle = 0.5 * (e + h), spread = length(vec2(0.5 * (e - h), f));
  float longer = middle + spread, shorter = max(middle - spread, 1e-6);
  vec2 along = abs(f) < 1e-9 ? (e >= h ? vec2(1.0, 0.0) : vec2(0.0, 1.0)) : normalize(vec2(f, longer - e));
  vec2 corner = vec2(float(gl_VertexID & 1), float((gl_VertexID >> 1) & 1)) * 2.0 - 1.0;
  vec2 sigmas = corner * sqrt(most);
  offset = sigmas * PER_SIGMA;
  vec2 pixel = focal * ratio + 0.5 * size
    + sigmas.x * sqrt(longer) * along + sigmas.y * sqrt(shorter) * vec2(along.y, -along.x);
  color = vec4(unpack(w.w) * (2.0 / 255.0) - 0.5, log2(alpha));
  if (depthView > 0.5) color.rgb = vec3(p.z);
  gl_Position = vec4(pixel / size * vec2(2.0, -2.0) + vec2(-1.0, 1.0), 0.0, 1.0);
}`;

// Most of a frame's time is spent here: what does not depend on the pixel comes flat, and stripes are a program of their
// own. Without a GPU that takes a fifth less.
const fragment = (striped) => `#version 300 es
precision highp float; precision highp int;
uniform float depthView;
in vec2 offset; flat in vec4 color; flat in uint guessed;
out vec4 result;
void main() {
  float a = min(exp2(color.a - dot(offset, offset)), 0.99);
  if (a < 1.0 / 255.0) discard;
  vec3 c = color.rgb;
  ${striped ? STRIPES : ""}
  result = vec4(c * a, a);
}`;

// Over what no camera has seen, as on the live page.
const STRIPES = "if (guessed == 1u && depthView < 0.5 && int(gl_FragCoord.x + gl_FragCoord.y) / 6 % 2 == 0) c *= 0.7;";

const SHOW_VERTEX = `#version 300 es
out vec2 uv;
void main() {
  uv = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1));
  gl_Position = vec4(uv * 2.0 - 1.0, 0.0, 1.0);
}`;

const SHOW_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D image; uniform float depthView, unit;
in vec2 uv; out vec4 result;
void main() {
  vec4 c = texture(image, uv);
  if (depthView < 0.5) { result = vec4(c.rgb, 1.0); return; }
  if (c.a < 0.5) { result = vec4(0.0, 0.0, 0.0, 1.0); return; }
  float t = clamp(0.5 + 0.45 * log(c.r / c.a / unit), 0.0, 1.0);  // near: bright
  result = vec4(mix(vec3(0.98, 0.9, 0.55), vec3(0.1, 0.1, 0.35), t), 1.0);
}`;

const LINE_VERTEX = `#version 300 es
uniform mat3 turn; uniform vec3 eye; uniform vec2 size; uniform float focal;
in vec3 place; in vec3 tint; out vec3 shade;
void main() {
  vec3 p = turn * (place - eye);
  shade = tint;
  gl_Position = vec4(2.0 * focal / size.x * p.x, -2.0 * focal / size.y * p.y, 0.0, p.z);
}`;

const LINE_FRAGMENT = `#version 300 es
precision mediump float;
in vec3 shade; out vec4 result;
void main() { result = vec4(shade, 1.0); }`;

export class SplatRenderer {
  /** Throws Error where the browser has no WebGL2. */
  constructor(canvas) {
    this.canvas = canvas;
    const options = { antialias: false, alpha: false, preserveDrawingBuffer: true, powerPreference: "high-performance" };
    this.gl = canvas.getContext("webgl2", options);
    if (this.gl === null) throw new Error("This browser has no WebGL2.");
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => this._prepare());
    this._prepare();
  }

  _prepare() {
    const gl = this.gl;
    // Colors of Gaussians leave [0, 1]: with 8 bits each blend would cut them, and the picture be 16 dB less alike.
    this.floats = gl.getExtension("EXT_color_buffer_float") !== null || gl.getExtension("EXT_color_buffer_half_float") !== null;
    // Without a GPU, half floats take two fifths of a frame: each blend converts them, there and back.
    this.format = withoutGpu(gl) && gl.getExtension("EXT_float_blend") !== null ? gl.RGBA32F : gl.RGBA16F;
    this.plainProgram = link(gl, VERTEX, fragment(false));
    this.stripedProgram = null; // linked once a set has what no camera has seen
    this.show = link(gl, SHOW_VERTEX, SHOW_FRAGMENT);
    this.lines = link(gl, LINE_VERTEX, LINE_FRAGMENT);
    this.quads = gl.createVertexArray();
    this.corners = gl.createBuffer();
    this.plain = gl.createVertexArray();
    this.lineArray = gl.createVertexArray();
    this.lineBuffer = gl.createBuffer();
    this.capacity = 0;
    this.target = null;
    this.frame = null;
    this.drawn = null; // the static set that the textures hold
    this.movingRows = 0;
    this.anchorValues = new Float32Array(4 * MOST_ANCHORS);
    this.anchors = createTexture(gl, gl.RGBA32F, MOST_ANCHORS, 1);
    this.statics = this.movings = this.attached = this.order = this.unseen = null;
    this.moving = null;
    this.moverPlaces = new Float32Array(0);
    this.counts = new Uint32Array(65537);
  }

  /** Bring the textures up to date with what a StreamReader has read. */
  _upload(reader) {
    const gl = this.gl;
    const set = reader.shown;
    if (this.drawn !== set) {
      this._remove(this.statics, this.unseen);
      this.statics = createTexture(gl, gl.RGBA32UI, WIDTH, rowsOf(set.total));
      this.unseen = createTexture(gl, gl.R8UI, WIDTH, rowsOf(set.total));
      this.places = new Float32Array(3 * set.total);
      this.drawn = set;
      set.changed = [0, set.total];
    }
    const [first, end] = set.changed;
    if (end > first) {
      uploadRows(gl, this.statics, gl.RGBA_INTEGER, gl.UNSIGNED_INT, set.records, 4, first, end);
      if (set.unseen !== null) uploadRows(gl, this.unseen, gl.RED_INTEGER, gl.UNSIGNED_BYTE, set.unseen, 1, first, end);
      locate(set.records, this.places, first, end);
      set.changed = [set.total, 0];
    }
    const moving = reader.moving;
    if (moving !== null && (moving.fresh || this.moving !== moving)) {
      if (rowsOf(moving.count) > this.movingRows) {
        this._remove(this.movings, this.attached);
        this.movingRows = rowsOf(moving.count);
        this.movings = createTexture(gl, gl.RGBA32UI, WIDTH, this.movingRows);
        this.attached = createTexture(gl, gl.RG32UI, WIDTH, this.movingRows);
      }
      uploadRows(gl, this.movings, gl.RGBA_INTEGER, gl.UNSIGNED_INT, moving.records, 4, 0, moving.count);
      uploadRows(gl, this.attached, gl.RG_INTEGER, gl.UNSIGNED_INT, attachments(moving), 2, 0, moving.count);
      this.moverPlaces = new Float32Array(3 * moving.count);
      locate(moving.records, this.moverPlaces, 0, moving.count);
      moving.fresh = false;
      this.moving = moving;
    }
    this._reserve(set.total + (moving === null ? 0 : moving.count));
  }

  _remove(...textures) {
    for (const texture of textures) if (texture !== null) this.gl.deleteTexture(texture);
  }

  /** Room for the quads of ``count`` Gaussians. One indexed list draws twice as fast as instances of four corners. */
  _reserve(count) {
    if (count <= this.capacity) return;
    const gl = this.gl;
    this.capacity = rowsOf(count) * WIDTH;
    const corners = new Uint32Array(6 * this.capacity);
    for (let n = 0; n < this.capacity; n++) corners.set([4 * n, 4 * n + 1, 4 * n + 2, 4 * n + 2, 4 * n + 1, 4 * n + 3], 6 * n);
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this._remove(this.order);
    this.order = createTexture(gl, gl.R32UI, WIDTH, rowsOf(count));
    this.sorted = new Uint32Array(this.capacity);
    this.keys = new Uint16Array(this.capacity);
    this.depths = new Float32Array(this.capacity);
  }

  /** Order Gaussians by depth, farthest first; returns how many lie before the camera. Counting sort by 1 / depth,
   *  which has its finest steps near the camera. */
  _sort(reader, camera, near) {
    const [tx, ty, tz] = camera.turn.slice(6);
    const origin = tx * camera.eye[0] + ty * camera.eye[1] + tz * camera.eye[2];
    const { depths, keys, counts, sorted } = this;
    const still = reader.shown.total;
    let farthest = near;
    const p = this.places;
    for (let n = 0; n < still; n++) {
      const z = tx * p[3 * n] + ty * p[3 * n + 1] + tz * p[3 * n + 2] - origin;
      depths[n] = z;
      if (z > farthest) farthest = z;
    }
    let total = still;
    if (reader.moves) {
      const { count, anchor, share } = reader.moving;
      const m = this.moverPlaces;
      const a = this.anchorValues;
      for (let n = 0; n < count; n++) {
        let z = tx * m[3 * n] + ty * m[3 * n + 1] + tz * m[3 * n + 2] - origin;
        const [s0, s1] = [share[2 * n] / 255, share[2 * n + 1] / 255];
        for (let k = 0; k < 3; k++) {
          const at = 4 * anchor[3 * n + k];
          z += (k === 0 ? s0 : k === 1 ? s1 : 1 - s0 - s1) * (tx * a[at] + ty * a[at + 1] + tz * a[at + 2]);
        }
        depths[total++] = z;
        if (z > farthest) farthest = z;
      }
    }
    counts.fill(0);
    const low = 1 / farthest;
    const scale = 65535 / Math.max(1 / near - low, 1e-9);
    for (let n = 0; n < total; n++) {
      if (depths[n] <= near) continue;
      keys[n] = (1 / depths[n] - low) * scale;
      counts[keys[n] + 1]++;
    }
    for (let k = 0; k < 65536; k++) counts[k + 1] += counts[k];
    const kept = counts[65536];
    for (let n = 0; n < total; n++) if (depths[n] > near) sorted[counts[keys[n]]++] = n;
    return kept;
  }

  /** Draw what was read, at an instant. camera: {turn: world-to-camera, row by row; eye: scene units; fov: vertical,
   *  radians}. options: {depth: draw depth instead of color, frusta: lines as [[place, place, rgb], ...], scene units}.
   *  Returns the number of Gaussians drawn. */
  draw(reader, camera, instant, options = {}) {
    const gl = this.gl;
    const { width, height } = this.canvas;
    if (reader.scene === null || gl.isContextLost()) return 0;
    this._upload(reader);
    if (reader.moves) reader.displacements(instant, this.anchorValues);
    const near = reader.scene.near;
    const count = this._sort(reader, camera, near);
    const focal = (0.5 * height) / Math.tan(camera.fov / 2);
    const depth = options.depth ? 1 : 0;
    this._bindTarget(width, height);
    gl.viewport(0, 0, width, height);
    const [red, green, blue] = depth ? [0, 0, 0] : reader.scene.background;
    gl.clearColor(red, green, blue, depth ? 0 : 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (count > 0) this._drawGaussians(reader, camera, count, focal, near, depth);
    if (this.floats) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.useProgram(this.show.program);
      gl.bindVertexArray(this.plain);
      bindTexture(gl, 0, this.target, this.show.image);
      gl.uniform1f(this.show.depthView, depth);
      gl.uniform1f(this.show.unit, 2.0);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
    if (options.frusta) this._drawLines(options.frusta, camera, focal);
    return count;
  }

  _bindTarget(width, height) {
    const gl = this.gl;
    if (this.floats && (this.target === null || this.targetSize !== `${width}x${height}`)) {
      this._remove(this.target);
      this.target = createTexture(gl, this.format, width, height);
      this.targetSize = `${width}x${height}`;
      this.frame ??= gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.target, 0);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.floats ? this.frame : null);
  }

  _drawGaussians(reader, camera, count, focal, near, depth) {
    const gl = this.gl;
    const { width, height } = this.canvas;
    if (reader.shown.unseen !== null) this.stripedProgram ??= link(gl, VERTEX, fragment(true));
    const u = reader.shown.unseen === null ? this.plainProgram : this.stripedProgram;
    gl.useProgram(u.program);
    gl.bindVertexArray(this.quads);
    bindTexture(gl, 0, this.order, u.order);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, rowsOf(count), gl.RED_INTEGER, gl.UNSIGNED_INT, this.sorted);
    bindTexture(gl, 1, this.anchors, u.anchors);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, MOST_ANCHORS, 1, gl.RGBA, gl.FLOAT, this.anchorValues);
    bindTexture(gl, 2, this.statics, u.statics);
    bindTexture(gl, 3, this.unseen, u.unseen);
    // Without a moving set any texture of the right kind will do: it is not read.
    bindTexture(gl, 4, this.movings ?? this.statics, u.movings);
    bindTexture(gl, 5, this.attached ?? this.statics, u.attached);
    const steps = (scales) => [scales[0], (scales[1] - scales[0]) / 255];
    gl.uniform4f(u.scales, ...steps(reader.shown.scales), ...steps(reader.moving?.scales ?? [-1, 0]));
    gl.uniform1ui(u.staticCount, reader.shown.total);
    gl.uniformMatrix3fv(u.turn, true, camera.turn);
    gl.uniform3fv(u.eye, camera.eye);
    gl.uniform1f(u.near, near);
    gl.uniform1f(u.focal, focal);
    gl.uniform1f(u.depthView, depth);
    gl.uniform2f(u.size, width, height);
    gl.uniform2f(u.limit, (0.65 * width) / focal, (0.65 * height) / focal);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawElements(gl.TRIANGLES, 6 * count, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);
  }

  _drawLines(lines, camera, focal) {
    const gl = this.gl;
    const u = this.lines;
    const vertices = new Float32Array(lines.flatMap(([a, b, tint]) => [...a, ...tint, ...b, ...tint]));
    gl.useProgram(u.program);
    gl.bindVertexArray(this.lineArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.DYNAMIC_DRAW);
    for (const [name, at] of [["place", 0], ["tint", 12]]) {
      const location = gl.getAttribLocation(u.program, name);
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, 3, gl.FLOAT, false, 24, at);
    }
    gl.uniformMatrix3fv(u.turn, true, camera.turn);
    gl.uniform3fv(u.eye, camera.eye);
    gl.uniform2f(u.size, this.canvas.width, this.canvas.height);
    gl.uniform1f(u.focal, focal);
    gl.drawArrays(gl.LINES, 0, 2 * lines.length);
    gl.bindVertexArray(null);
  }
}

/** Whether the browser draws with the processor alone, as far as it says so. */
function withoutGpu(gl) {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl.getParameter(info === null ? gl.RENDERER : info.UNMASKED_RENDERER_WEBGL);
  return /swiftshader|llvmpipe|softpipe|basic render/i.test(name);
}

/** Places (xyz each, scene units) of records first to end. */
function locate(records, places, first, end) {
  const expand = (u) => (Math.abs(u) <= 1 ? u : Math.sign(u) / Math.max(2 - Math.abs(u), 1e-6));
  const step = 4 / 65535;
  for (let n = first; n < end; n++) {
    const word = records[4 * n];
    places[3 * n] = expand((word & 65535) * step - 2);
    places[3 * n + 1] = expand((word >>> 16) * step - 2);
    places[3 * n + 2] = expand((records[4 * n + 1] & 65535) * step - 2);
  }
}

/** Anchors and shares of a moving set in two words a Gaussian. */
function attachments({ count, anchor, share }) {
  const words = new Uint32Array(2 * count);
  for (let n = 0; n < count; n++) {
    words[2 * n] = anchor[3 * n] | (anchor[3 * n + 1] << 8) | (anchor[3 * n + 2] << 16) | (share[2 * n] << 24);
    words[2 * n + 1] = share[2 * n + 1];
  }
  return words;
}

const rowsOf = (count) => Math.max(Math.ceil(count / WIDTH), 1);

/** Upload elements first to end of a list, in whole rows of the texture. */
function uploadRows(gl, texture, format, type, list, channels, first, end) {
  const [top, bottom] = [Math.floor(first / WIDTH), rowsOf(end)];
  const rows = new list.constructor((bottom - top) * WIDTH * channels);
  rows.set(list.subarray(top * WIDTH * channels, Math.min(bottom * WIDTH * channels, list.length)));
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, top, WIDTH, bottom - top, format, type, rows);
}

function bindTexture(gl, unit, texture, location) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.uniform1i(location, unit);
}

function createTexture(gl, format, width, height) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
  return texture;
}

/** A linked program and the locations of its uniforms, by name. Throws Error with the compiler's words. */
function link(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(program));
  const found = { program };
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS);
  for (let k = 0; k < count; k++) {
    const { name } = gl.getActiveUniform(program, k);
    found[name] = gl.getUniformLocation(program, name);
  }
  return found;
}
