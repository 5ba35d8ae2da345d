// The page: connects to the stream, draws at the display's rate, shows cameras and what the link takes.

import { OrbitCamera, add, length, scale, subtract, turnBy } from "./orbit.js";
import { StreamReader } from "./reader.js";
import { SplatRenderer } from "./splats.js";

const FRAME_GOAL_MS = 50; // slower ones are drawn with fewer pixels
const LEAST_PIXELS = 0.25; // share of the display's, a side
const SAVED_BYTES = 256 * 1024 * 1024; // kept for "save"
const FRUSTUM = 0.06; // of the cameras' distance
const LIGHT_LAG_S = 1e-5; // by which the clock's offset may rise a message: clocks drift

const element = (id) => document.getElementById(id);
const canvas = element("scene");
const camera = new OrbitCamera(canvas);
const reader = new StreamReader();
const stats = (window.splatStats = { frames: [], draw: [], read: [], bytes: 0, messages: 0, drawn: 0 });
let renderer = null;
let socket = null;
let retryMs = 500;
let saved = [];
let savedBytes = 0;
let playing = null; // a file that is played back: {messages, began}
let clockOffset = null; // edge's seconds minus the browser's
let quality = 1;
let started = false;
let told = null; // the status that the panel shows

/** The instant to show: the edge's present, as far as it is known. */
function present() {
  const now = performance.now() / 1000;
  if (playing !== null) return playing.instant + (now - playing.at);
  return clockOffset === null ? 0 : clockOffset + now;
}

/** Messages are late by what the link took; the one that was late least tells the clocks apart, up to half a round trip. */
function keepTime(instant) {
  const halfTrip = (reader.status.link?.shortest_ms ?? 0) / 2000;
  const offset = instant + halfTrip - performance.now() / 1000;
  clockOffset = clockOffset === null || Math.abs(offset - clockOffset) > 5 ? offset : Math.max(offset, clockOffset - LIGHT_LAG_S);
}

function take(buffer) {
  const began = performance.now();
  try {
    reader.read(buffer);
  } catch (error) {
    say(`The stream cannot be read: ${error.message}`);
    return false;
  }
  stats.bytes += buffer.byteLength;
  stats.messages += 1;
  record(stats.read, performance.now() - began);
  return true;
}

function connect() {
  socket = new WebSocket(new URL("stream", location.href.replace(/^http/, "ws")));
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {
    reader.reset();
    [saved, savedBytes, clockOffset] = [[], 0, null];
    say("Waiting for the first Gaussians.");
  };
  socket.onmessage = ({ data }) => {
    if (playing !== null || !take(data)) return;
    retryMs = 500;
    socket.send(new Uint32Array([reader.number]));
    keepTime(reader.instant);
    if (savedBytes < SAVED_BYTES) {
      saved.push([performance.now() / 1000, data]);
      savedBytes += data.byteLength;
    } else element("save").textContent = "save (first 256 MB)";
    if (told !== reader.status) tell();
  };
  socket.onclose = () => {
    if (playing !== null) return;
    say("The connection broke; trying again. The picture stays as it was.");
    setTimeout(() => playing === null && connect(), retryMs);
    retryMs = Math.min(2 * retryMs, 8000);
  };
}

function say(text) {
  element("message").textContent = text;
}

/** Bring the panel up to date with the newest status. */
function tell() {
  told = reader.status;
  const { scenario, line, cameras = [], link, start } = reader.status;
  element("scenario").textContent = scenario ?? "freshfield";
  element("line").textContent = line ?? "";
  if (reader.scene !== null && reader.shown.total > 0) say("");
  if (link !== undefined) {
    const [here, all] = link.static;
    element("link").textContent = `${(link.bytes_per_s / 1000).toFixed(0)} kB/s, ${link.round_trip_ms.toFixed(0)} ms`;
    element("bound").textContent = here < all ? `Your link takes ${here} of ${all} Gaussians that stand still.` : "";
  }
  if (start && !started) {
    started = true;
    if (!camera.touched) home();
  }
  list(cameras);
}

function home() {
  const { start } = reader.status;
  if (start) camera.place(start.position, start.look_at, start.up, start.fov);
}

function list(cameras) {
  const items = element("cameras");
  while (items.children.length > cameras.length) items.lastChild.remove();
  cameras.forEach((each, k) => {
    if (k >= items.children.length) {
      const button = document.createElement("button");
      button.append(document.createElement("canvas"), document.createElement("span"), document.createElement("span"));
      const item = document.createElement("li");
      item.append(button);
      items.append(item);
    }
    const button = items.children[k].firstChild;
    const [swatch, name, age] = button.children;
    const pen = swatch.getContext("2d");
    pen.fillStyle = `rgb(${each.color.join(",")})`;
    pen.fillRect(0, 0, swatch.width, swatch.height);
    name.textContent = each.name + (each.held_out ? " (held out)" : "");
    age.textContent = each.age_ms === null ? "no frame" : `${each.age_ms} ms`;
    button.onclick = () => lookThrough(each);
  });
}

function lookThrough({ position, wxyz, fov }) {
  const ahead = turnBy(wxyz, [0, 0, 1]);
  const far = reader.status.start?.radius ?? 1;
  camera.touched = true;
  camera.place(position, add(position, scale(ahead, far)), scale(turnBy(wxyz, [0, 1, 0]), -1), fov);
}

/** Lines of the cameras' frusta in scene units, colored by the age of their frames. */
function frusta() {
  const size = FRUSTUM * (reader.status.start?.radius ?? 1);
  const lines = [];
  for (const each of reader.status.cameras ?? []) {
    if (length(subtract(each.position, camera.position)) < size) continue; // its lines would cross the picture
    const tint = each.color.map((value) => value / 255);
    const high = Math.tan(each.fov / 2);
    const corner = (x, y) => toScene(add(each.position, scale(turnBy(each.wxyz, [x * high * each.aspect, y * high, 1]), size)));
    const eye = toScene(each.position);
    const corners = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
    corners.forEach((place, k) => lines.push([eye, place, tint], [place, corners[(k + 1) % 4], tint]));
  }
  return lines;
}

const toScene = (place) => scale(subtract(place, reader.scene.center), 1 / reader.scene.radius);

/** The visitor's camera as the renderer wants it. */
function rendererCamera() {
  return { turn: camera.axes().flat(), eye: toScene(camera.position), fov: camera.fov };
}

function resize() {
  const ratio = Math.min(window.devicePixelRatio, 2) * quality;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.max(Math.round(side * ratio), 16));
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
}

let last = null;
let since = 0;

function frame(now) {
  requestAnimationFrame(frame);
  if (playing !== null) play();
  resize();
  const began = performance.now();
  if (reader.scene !== null) {
    const options = { depth: pressed("view"), frusta: pressed("frusta") ? frusta() : null };
    stats.drawn = renderer.draw(reader, rendererCamera(), present(), options);
  }
  record(stats.draw, performance.now() - began);
  if (last !== null) {
    record(stats.frames, now - last);
    adapt(now - last);
  }
  last = now;
  if (now - since > 500) {
    since = now;
    const recent = stats.frames.slice(-20);
    const mean = recent.reduce((sum, each) => sum + each, 0) / Math.max(recent.length, 1);
    element("drawn").textContent = `${stats.drawn} Gaussians, ${(1000 / Math.max(mean, 1)).toFixed(0)} frames/s`;
  }
}

/** Fewer pixels where drawing is slow, more again where it is quick. A single slow frame, or a page that was hidden, does
 *  not count. */
function adapt(took) {
  if (fixedSize || document.hidden) return;
  slowness = 0.9 * slowness + 0.1 * Math.min(took, 1000);
  if (slowness > FRAME_GOAL_MS && quality > LEAST_PIXELS) quality = Math.max(quality * 0.9, LEAST_PIXELS);
  else if (slowness < FRAME_GOAL_MS / 3 && quality < 1) quality = Math.min(quality * 1.05, 1);
  else return;
  slowness = FRAME_GOAL_MS / 2;
}

let slowness = FRAME_GOAL_MS / 2;
const fixedSize = new URLSearchParams(location.search).has("full"); // all pixels, however slow

function record(list, value) {
  list.push(value);
  if (list.length > 2000) list.splice(0, 1000);
}

const pressed = (id) => element(id).getAttribute("aria-pressed") === "true";

// --- files: each message behind its length and the second at which it came ------------------------

/** What has come so far, as a file. */
function savedFile() {
  const head = (at, size) => {
    const view = new DataView(new ArrayBuffer(12));
    view.setUint32(0, size, true);
    view.setFloat64(4, at, true);
    return view.buffer;
  };
  const parts = saved.flatMap(([at, data]) => [head(at - saved[0][0], data.byteLength), data]);
  return new Blob(parts, { type: "application/octet-stream" });
}

function save() {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(savedFile());
  link.download = `${reader.status.scenario ?? "scene"}.ffsplats`;
  link.click();
  URL.revokeObjectURL(link.href);
}

async function open(file) {
  const buffer = await file.arrayBuffer();
  const view = new DataView(buffer);
  const messages = [];
  for (let at = 0; at + 12 <= buffer.byteLength; ) {
    const size = view.getUint32(at, true);
    if (at + 12 + size > buffer.byteLength) break; // cut off: what is whole is played
    messages.push([view.getFloat64(at + 4, true), buffer.slice(at + 12, at + 12 + size)]);
    at += 12 + size;
  }
  if (messages.length === 0) {
    say(`${file.name} holds no messages of a splat stream.`);
    return;
  }
  playing = { messages, next: 0, began: performance.now() / 1000, instant: 0, at: 0 };
  socket?.close();
  reader.reset();
  started = false;
}

/** Read the messages of a file that are due; begin again at its end. */
function play() {
  const now = performance.now() / 1000;
  while (playing.next < playing.messages.length && playing.messages[playing.next][0] <= now - playing.began) {
    if (!take(playing.messages[playing.next++][1])) playing.next = playing.messages.length;
    [playing.instant, playing.at] = [reader.instant, now];
    if (told !== reader.status) tell();
  }
  if (playing.next === playing.messages.length) [playing.next, playing.began] = [0, now + 1];
}

// --- begin ----------------------------------------------------------------------------------------

element("start").onclick = home;
element("save").onclick = save;
element("open").onchange = ({ target }) => target.files.length > 0 && open(target.files[0]);
for (const id of ["view", "frusta"]) element(id).onclick = () => element(id).setAttribute("aria-pressed", String(!pressed(id)));

try {
  renderer = new SplatRenderer(canvas);
  window.splats = { reader, renderer, savedFile, open }; // for tests
  connect();
  requestAnimationFrame(frame);
} catch (error) {
  say(`${error.message} The live page shows pictures that the edge renders.`);
}
