// A camera that turns about a point: drag turns, right button or two fingers shift, wheel or pinch come nearer.

const TURN = 0.006; // radians a pixel
const ZOOM = 0.0012; // share of the distance a pixel of the wheel
const CLOSEST_TO_POLE = 0.05; // radians

export class OrbitCamera {
  constructor(canvas) {
    this.canvas = canvas;
    this.position = [0, -3, 1.5];
    this.target = [0, 0, 0];
    this.up = [0, 0, 1];
    this.fov = Math.PI / 3;
    this.touched = false; // whether the visitor has moved
    this._pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => this._down(event));
    canvas.addEventListener("pointermove", (event) => this._move(event));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => this._pointers.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(ZOOM * event.deltaY));
    }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => this._key(event));
  }

  /** Stand at a place and look at a point; vectors in world meters, fov vertical in radians. */
  place(position, target, up, fov) {
    [this.position, this.target, this.up, this.fov] = [[...position], [...target], normalize(up), fov];
  }

  /** The camera's axes in the world, rows of the world-to-camera rotation: right, down, ahead. */
  axes() {
    const ahead = normalize(subtract(this.target, this.position));
    const right = normalize(cross(ahead, this.up));
    return [right, cross(ahead, right), ahead];
  }

  zoom(factor) {
    this.touched = true;
    this.position = add(this.target, scale(subtract(this.position, this.target), factor));
  }

  turn(right, down) {
    this.touched = true;
    const arm = subtract(this.position, this.target);
    const turned = rotate(arm, this.up, -right);
    const side = normalize(cross(this.up, turned));
    const height = Math.acos(Math.max(-1, Math.min(1, dot(normalize(turned), this.up))));
    const wanted = Math.max(CLOSEST_TO_POLE, Math.min(Math.PI - CLOSEST_TO_POLE, height - down));
    this.position = add(this.target, rotate(turned, side, wanted - height));
  }

  shift(right, down) {
    this.touched = true;
    const [x, y] = this.axes();
    const meters = (2 * length(subtract(this.position, this.target)) * Math.tan(this.fov / 2)) / this.canvas.clientHeight;
    const by = add(scale(x, -right * meters), scale(y, -down * meters));
    this.position = add(this.position, by);
    this.target = add(this.target, by);
  }

  _down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this._pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  _move(event) {
    const before = this._pointers.get(event.pointerId);
    if (before === undefined) return;
    const now = [event.clientX, event.clientY];
    const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    const other = [...this._pointers].find(([id]) => id !== event.pointerId);
    this._pointers.set(event.pointerId, now);
    if (other !== undefined) {
      const apart = (p) => Math.hypot(p[0] - other[1][0], p[1] - other[1][1]);
      if (apart(now) > 1) this.zoom(apart(before) / apart(now));
      this.shift(dx / 2, dy / 2);
    } else if (event.buttons & 2 || event.shiftKey) {
      this.shift(dx, dy);
    } else {
      this.turn(dx * TURN, dy * TURN);
    }
  }

  _key(event) {
    const step = 0.06;
    const turns = { ArrowLeft: [step, 0], ArrowRight: [-step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (event.key in turns) this.turn(...turns[event.key]);
    else if (event.key === "+") this.zoom(0.9);
    else if (event.key === "-") this.zoom(1 / 0.9);
    else return;
    event.preventDefault();
  }
}

export const add = (a, b) => a.map((x, k) => x + b[k]);
export const subtract = (a, b) => a.map((x, k) => x - b[k]);
export const scale = (a, s) => a.map((x) => x * s);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const length = (a) => Math.hypot(...a);
export const normalize = (a) => scale(a, 1 / Math.max(length(a), 1e-12));
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** A vector turned about a unit axis by an angle (Rodrigues' formula). */
function rotate(v, axis, angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return add(add(scale(v, c), scale(cross(axis, v), s)), scale(axis, dot(axis, v) * (1 - c)));
}

/** A vector in a camera's axes, in world axes. wxyz: unit quaternion, camera to world. */
export function turnBy(wxyz, v) {
  const [w, ...u] = wxyz;
  const t = scale(cross(u, v), 2);
  return add(add(v, scale(t, w)), cross(u, t));
}
