// Reads messages of the splat stream, version 1 (docs/splat-stream.md): what is to be drawn now.

const [SCENE, STATIC, MOVING, KNOTS, STATUS, UNSEEN] = [1, 2, 3, 4, 5, 6];
const VERSION = 1;
const RECORD_BYTES = 16;
const MOST_GAUSSIANS = 1 << 20;
const MOST_KNOTS = 64;

/** A static set: uint32 records, four a Gaussian, and how many have come. */
class StaticSet {
  constructor(number, total) {
    this.number = number;
    this.total = total;
    this.records = new Uint32Array(4 * total);
    this.came = new Uint8Array(total);
    this.missing = total;
    this.scales = [-1, 0];
    this.unseen = null;
    this.changed = [0, total]; // rows to upload
  }

  take(first, records, scales) {
    this.records.set(records, 4 * first);
    this.scales = scales;
    const end = first + records.length / 4;
    for (let k = first; k < end; k++) {
      this.missing -= 1 - this.came[k];
      this.came[k] = 1;
    }
    this.changed = [Math.min(this.changed[0], first), Math.max(this.changed[1], end)];
  }
}

export class StreamReader {
  constructor() {
    this.reset();
  }

  /** Forget everything, as for a new connection. */
  reset() {
    this.scene = null;
    this.status = {};
    this.instant = 0;
    this.number = 0;
    this._forget();
  }

  _forget() {
    this.shown = new StaticSet(-1, 0);
    this.pending = null;
    this.moving = null;
    this.knots = null;
  }

  /** Take in a message, an ArrayBuffer. Throws Error for one that the specification does not allow. */
  read(buffer) {
    const view = new DataView(buffer);
    this.number = view.getUint32(0, true);
    this.instant = view.getFloat64(4, true);
    let at = 12;
    while (at < buffer.byteLength) {
      const kind = view.getUint32(at, true);
      const length = view.getUint32(at + 4, true);
      at += 8;
      if (at + length > buffer.byteLength) throw new Error(`block ${kind} is cut off`);
      this._block(kind, new DataView(buffer, at, length));
      at += length + ((4 - (length % 4)) % 4);
    }
  }

  _block(kind, view) {
    if (kind === SCENE) this._scene(view);
    else if (kind === STATIC) this._static(view);
    else if (kind === MOVING) this._moving(view);
    else if (kind === KNOTS) this._knots(view);
    else if (kind === STATUS) this.status = JSON.parse(new TextDecoder().decode(view));
    else if (kind === UNSEEN) this._unseen(view);
  }

  _scene(view) {
    const version = view.getUint32(0, true);
    if (version !== VERSION) throw new Error(`version ${version} of the stream; this page knows ${VERSION}: reload it`);
    const field = view.getUint32(4, true);
    if (this.scene !== null && this.scene.field !== field) this._forget();
    this.scene = {
      field,
      center: floats(view, 8, 3),
      radius: view.getFloat32(20, true),
      near: view.getFloat32(24, true),
      background: floats(view, 28, 3),
    };
  }

  _static(view) {
    const [number, total, first, count] = [0, 4, 8, 12].map((at) => view.getUint32(at, true));
    if (total > MOST_GAUSSIANS || first + count > total) throw new Error(`Gaussians ${first} to ${first + count} of ${total}`);
    let target = number === this.shown.number ? this.shown : this.pending;
    if (target === null || target.number !== number) target = this.pending = new StaticSet(number, total);
    if (target.total !== total) throw new Error(`a static set of ${target.total} Gaussians now has ${total}`);
    target.take(first, words(view, 24, 4 * count), floats(view, 16, 2));
    if (target === this.pending && target.missing === 0) {
      this.shown = target;
      this.pending = null;
    }
  }

  _moving(view) {
    const count = view.getUint32(4, true);
    if (count > MOST_GAUSSIANS) throw new Error(`${count} moving Gaussians`);
    const end = 16 + RECORD_BYTES * count;
    this.moving = {
      anchors: view.getUint32(0, true),
      count,
      scales: floats(view, 8, 2),
      records: words(view, 16, 4 * count),
      anchor: bytes(view, end, 3 * count),
      share: bytes(view, end + 3 * count, 2 * count),
      fresh: true, // not uploaded yet
    };
  }

  _knots(view) {
    const [count, anchors] = [view.getInt16(32, true), view.getInt16(34, true)];
    if (count < 4 || count > MOST_KNOTS || anchors < 0 || anchors > 255) throw new Error(`${count} knots of ${anchors} anchors`);
    const unit = view.getFloat32(28, true);
    const values = new Float32Array(3 * count * anchors);
    for (let k = 0; k < values.length; k++) values[k] = view.getInt16(36 + 2 * k, true) * unit;
    this.knots = {
      set: view.getUint32(0, true),
      first: view.getFloat64(4, true),
      newest: view.getFloat64(12, true),
      rate: view.getFloat32(20, true),
      ahead: view.getFloat32(24, true),
      count,
      anchors,
      values,
    };
  }

  _unseen(view) {
    const [number, count] = [view.getUint32(0, true), view.getUint32(4, true)];
    const set = [this.shown, this.pending].find((each) => each !== null && each.number === number);
    if (set === undefined || count !== set.total) return;
    const bits = bytes(view, 8, Math.ceil(count / 8));
    set.unseen = new Uint8Array(count);
    for (let k = 0; k < count; k++) set.unseen[k] = (bits[k >> 3] >> (k & 7)) & 1;
    set.changed = [0, count];
  }

  /** Whether the moving set can be drawn: its knots have come. */
  get moves() {
    return this.moving !== null && this.knots !== null && this.moving.anchors === this.knots.set;
  }

  /** Displacements of the anchors at an instant, xyz each, written to ``out`` with a stride of four. */
  displacements(instant, out) {
    const k = this.knots;
    const last = k.count - 1;
    const x = Math.max((Math.min(instant, k.newest + k.ahead) - k.first) * k.rate, 0);
    const i = Math.min(Math.floor(x), last);
    const f = x - i;
    const stride = 3 * k.anchors;
    for (let a = 0; a < k.anchors; a++) {
      for (let c = 0; c < 3; c++) {
        const at = (knot) => k.values[knot * stride + 3 * a + c];
        out[4 * a + c] = i === last ? at(last) + f * (at(last) - at(last - 1)) : catmullRom(at, i, last, f);
      }
    }
  }
}

/** Between knots i and i + 1; where a neighbor is missing, it lies on the line through the two next to it. */
function catmullRom(at, i, last, f) {
  const [a, b] = [at(i), at(i + 1)];
  const before = i > 0 ? at(i - 1) : 2 * a - b;
  const after = i + 1 < last ? at(i + 2) : 2 * b - a;
  return a + (f / 2) * (b - before + f * (2 * before - 5 * a + 4 * b - after + f * (3 * (a - b) + after - before)));
}

function floats(view, at, count) {
  return Array.from({ length: count }, (_, k) => view.getFloat32(at + 4 * k, true));
}

/** Copies, since the content of a block need not be aligned for a typed array. */
function bytes(view, at, count) {
  if (at + count > view.byteLength) throw new Error("a block is too short");
  return new Uint8Array(view.buffer.slice(view.byteOffset + at, view.byteOffset + at + count));
}

function words(view, at, count) {
  return new Uint32Array(bytes(view, at, 4 * count).buffer);
}
