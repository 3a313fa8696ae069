// Plays a recording: 2D keypoints left, lifted skeletons right. Frames are in the page, or are
// received from the server. Lifted points are in camera axes: x right, y down, z forward; in a fixed
// frame, in those of a level camera that looks along its x.
"use strict";
const recording = JSON.parse(document.getElementById("recording").textContent);
const live = recording.frames === null;
const MOST = 3000; // frames that a live page keeps
const $ = id => document.getElementById(id);
const RAMP = [[230, 97, 1], [253, 184, 99], [120, 198, 121], [0, 104, 55]];
const AXES = ["#d62728", "#2ca02c", "#1f77b4"], AXIS_NAMES = ["x", "y", "z"];
const WAITING = live ? "waiting for the lifter's first answer" : "the recording has no frames";
const frames = [];
const box = [Infinity, Infinity, -Infinity, -Infinity];
const extents = { reach: [], size: [] };
let index = 0, playing = false, clock = 0, before = 0, following = live;
let atRest = false, wheel = 1;

function colour(confidence) {
  const at = Math.min(1, Math.max(0, confidence)) * (RAMP.length - 1);
  const low = Math.min(RAMP.length - 2, Math.floor(at)), part = at - low;
  return `rgb(${RAMP[low].map((v, k) => Math.round(v + part * (RAMP[low + 1][k] - v)))})`;
}

const triples = flat => Array.from({ length: flat.length / 3 }, (_, i) => flat.slice(3 * i, 3 * i + 3));
const add = (a, b) => a.map((v, k) => v + b[k]);
const scaled = (a, s) => a.map(v => v * s);
// R^T v: from the camera's axes to the object's; R row by row.
const toObject = (R, v) => [0, 1, 2].map(k => R[k] * v[0] + R[3 + k] * v[1] + R[6 + k] * v[2]);

function take(frame) {
  frame.objects.forEach(object => {
    object.keypoints = triples(object.keypoints);
    object.keypoints.filter(([, , c]) => c > 0).forEach(([x, y]) => {
      [box[0], box[1]] = [Math.min(box[0], x), Math.min(box[1], y)];
      [box[2], box[3]] = [Math.max(box[2], x), Math.max(box[3], y)];
    });
    if (!object.shape) return;
    object.shape = triples(object.shape);
    const radius = Math.max(...object.shape.map(p => Math.hypot(...p)));
    const weight = object.size ** 2;
    extents.size.push([radius, weight]);
    extents.reach.push([Math.hypot(...object.position) + object.size * radius, weight]);
  });
  frames.push(frame);
}

// The 90 % quantile of an extent over all objects, weighted by their size in the image.
function extent(name) {
  const values = extents[name];
  if (values.length > 2 * MOST) values.splice(0, MOST);
  let left = 0.9 * values.reduce((sum, [, weight]) => sum + weight, 0);
  const found = [...values].sort((a, b) => a[0] - b[0]).find(([, weight]) => (left -= weight) <= 0);
  return found ? found[0] : 1;
}

// The two views, camera fixed or object fixed: from camera axes to x right, y up, z to the viewer.
function viewOf(frame) {
  const chosen = frame.objects.find(o => o.shape && o.rotation);
  if (!atRest) return { reach: 1.1 * extent("reach"), chosen, up: v => [v[0], -v[1], -v[2]], at: o => o.position, zoom: o => o.size };
  if (!chosen) return null;
  const turned = v => { const [x, y, z] = toObject(chosen.rotation, v); return [y, z, x]; };
  return {
    reach: 1.25 * extent("size"), chosen, up: turned, zoom: o => o.size / chosen.size,
    at: o => scaled(add(o.position, scaled(chosen.position, -1)), 1 / chosen.size),
  };
}

function drawSeen() {
  const canvas = $("seen"), pen = canvas.getContext("2d"), ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  [canvas.width, canvas.height] = [width * ratio, height * ratio];
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.lineCap = "round";
  const frame = frames[index];
  if (!frame) { write(pen, 12, 20, WAITING, "#888888"); return; }
  if (!frame.objects.length) write(pen, 12, 20, "no object in this frame", "#888888");
  if (box[0] > box[2]) { write(pen, 12, 20, "no keypoints yet", "#888888"); return; }
  const zoom = Math.min((width - 30) / (box[2] - box[0] || 1), (height - 30) / (box[3] - box[1] || 1));
  const place = ([x, y]) => [width / 2 + zoom * (x - (box[0] + box[2]) / 2),
                             height / 2 + zoom * (y - (box[1] + box[3]) / 2)];
  frame.objects.forEach(object => {
    const at = object.keypoints.map(place), seen = object.keypoints.map(p => p[2] > 0);
    recording.source.edges.forEach(([a, b], k) => {
      if (!seen[a] || !seen[b]) return;
      pen.strokeStyle = recording.source.colours[k];
      pen.lineWidth = 3;
      pen.beginPath(); pen.moveTo(...at[a]); pen.lineTo(...at[b]); pen.stroke();
    });
    at.forEach((p, i) => {
      if (!seen[i]) return;
      pen.fillStyle = colour(object.keypoints[i][2]);
      pen.beginPath(); pen.arc(...p, 3.5, 0, 7); pen.fill();
    });
    const shown = at.filter((_, i) => seen[i]);
    if (frame.objects.length > 1 && shown.length) label(pen, shown, object.identity);
  });
}

function label(pen, points, identity) {
  const [x, y] = points.reduce((top, p) => p[1] < top[1] ? p : top);
  write(pen, x + 8, y - 6, `${identity}`, "#222222");
}

function write(pen, x, y, word, fill) {
  pen.fillStyle = fill;
  pen.font = "12px system-ui, sans-serif";
  pen.fillText(word, x, y);
}

// The camera as a pyramid, its tip at `tip`, looking along its z; the flag is on its upper side.
function frustum(tip, length) {
  const [w, h] = [0.5 * length, 0.36 * length];
  const base = [[-w, -h], [w, -h], [w, h], [-w, h]].map(([x, y]) => add(tip, [x, y, length]));
  const flag = add(tip, [0, -1.6 * h, length]);
  return [...base.map(corner => [tip, corner]), ...base.map((corner, k) => [corner, base[(k + 1) % 4]]),
          [base[0], flag], [flag, base[1]]];
}

const orbit = new Orbit($("lifted"), 0, 0, () => {
  orbit.clear();
  orbit.joints = [];
  const frame = frames[index], view = frame && viewOf(frame);
  if (!frame || !frame.objects.some(o => o.shape)) write(orbit.pen, 12, 20, frame ? "nothing was lifted in this frame" : WAITING, "#888888");
  if (!view) return;
  orbit.zoom = 0.54 * wheel * Math.min(orbit.width, orbit.height) / view.reach;
  const project = v => orbit.project(view.up(v)), lines = [], words = [];
  const put = (from, to, stroke, opacity, width) =>
    lines.push([project(from), project(to), stroke, opacity, width]);
  if (atRest && recording.upright) floor(view, frame).forEach(line => lines.push(line));
  if (!atRest && recording.upright) level(view).forEach(line => lines.push(line));
  if (!frame.fixed && (!atRest || view.chosen.rotation)) {
    const far = frame.camera ? Math.hypot(...frame.camera) : 1.35 * view.reach;
    const tip = frame.camera ? add(frame.camera, atRest ? scaled(view.chosen.position, -1) : [0, 0, 0]) : [0, 0, -far];
    frustum(tip, 0.22 * view.reach).forEach(([a, b]) => put(a, b, "#444444", 1, 2));
    put(tip, add(tip, [0, 0, 0.65 * far]), "#444444", 0.3, 1);
  }
  frame.objects.filter(o => o.shape).forEach(object => {
    const points = object.shape.map(p => add(view.at(object), scaled(p, view.zoom(object))));
    const at = points.map(project);
    recording.target.edges.forEach(([a, b], k) => {
      const confidence = Math.min(object.confidence[a], object.confidence[b]);
      lines.push([at[a], at[b], recording.target.colours[k], 0.4 + 0.6 * confidence]);
    });
    const radius = Math.max(...object.shape.map(p => Math.hypot(...p)));
    if (object.rotation) AXES.forEach((stroke, k) => {
      const axis = [0, 1, 2].map(row => object.rotation[3 * row + k]);
      const tip = add(view.at(object), scaled(axis, 0.35 * radius * view.zoom(object)));
      put(view.at(object), tip, stroke, 0.9, 1.5);
      words.push([project(tip), AXIS_NAMES[k], stroke]);
    });
    orbit.joints.push({ identity: object.identity, at, confidence: object.confidence });
  });
  orbit.lines(lines, view.reach);
  orbit.joints.forEach(({ identity, at, confidence }) => {
    orbit.dots(at, confidence.map(colour), 3.5);
    if (orbit.joints.length > 1) label(orbit.pen, at, identity);
  });
  words.forEach(([[x, y], word, fill]) => write(orbit.pen, x + 3, y + 4, word, fill));
});

// A grid below the lowest point of the fixed object.
function floor(view, frame) {
  const heights = view.chosen.shape.map(p => toObject(view.chosen.rotation, p)[2]);
  const low = Math.min(...heights), far = 1.2 * extent("size"), lines = [];
  for (let k = -3; k <= 3; k++) {
    const side = far * k / 3;
    [[[side, low, -far], [side, low, far]], [[-far, low, side], [far, low, side]]].forEach(
      ([a, b]) => lines.push([orbit.project(a), orbit.project(b), "#bbbbbb", 0.8, 1]));
  }
  return lines;
}

// A grid below the objects, level with the camera: the direction of gravity is not known. In a fixed
// frame it is level.
function level(view) {
  const low = 0.95 * extent("reach"), far = 1.2 * extent("reach"), lines = [];
  const project = v => orbit.project(view.up(v));
  for (let k = -3; k <= 3; k++) {
    const side = far * k / 3;
    [[[side, low, -far], [side, low, far]], [[-far, low, side], [far, low, side]]].forEach(
      ([a, b]) => lines.push([project(a), project(b), "#c8ced3", 0.8, 1]));
  }
  return lines;
}

function show(next) {
  index = Math.max(0, Math.min(frames.length - 1, next));
  const frame = frames[index];
  $("slider").max = Math.max(0, frames.length - 1);
  $("slider").value = index;
  if (frame) {
    const seconds = frame.t - frames[0].t;
    $("time").value = `${seconds.toFixed(2)} s · ${index + 1} / ${frames.length}`;
    if (recording.upright) $("grid").textContent = frame.fixed ? `level in ${frame.fixed}, z up` : "level with the camera";
    $("objects").textContent = frame.objects.map(describe).join(" · ") || "no object in this frame";
  }
  const fixed = frame && frame.fixed ? `${frame.fixed} fixed` : "camera fixed";
  $("view").textContent = `view: ${atRest ? "object fixed, camera moves" : fixed}`;
  drawSeen();
  orbit.draw();
}

function describe(object) {
  if (!object.shape) return `${object.identity}: not lifted`;
  const mean = object.confidence.reduce((a, b) => a + b, 0) / object.confidence.length;
  const residual = object.residual === null ? "" : `, residual ${object.residual.toFixed(3)}`;
  return `${object.identity}: confidence ${mean.toFixed(2)}${residual}`;
}

function seek(next) {
  following = live && next >= frames.length - 1;
  show(next);
  clock = frames[index] ? frames[index].t : 0;
}

function play(on) {
  if (on && index >= frames.length - 1) seek(0);
  playing = on;
  $("play").textContent = on ? "❚❚" : "▶";
  before = 0;
  if (on) { clock = frames[index] ? frames[index].t : 0; requestAnimationFrame(tick); }
}

function tick(now) {
  if (!playing) return;
  clock += before ? (now - before) / 1000 * Number($("speed").value) : 0;
  before = now;
  let next = index;
  while (next + 1 < frames.length && frames[next + 1].t <= clock) next++;
  if (next !== index) show(next);
  if (index >= frames.length - 1) { play(false); following = live; return; }
  requestAnimationFrame(tick);
}

function reset() {
  [orbit.yaw, orbit.pitch] = atRest ? [-0.6, 0.3] : [0.75, 0.3];
  wheel = 1;
  show(index);
}

const KEYS = {
  " ": () => play(!playing),
  ArrowLeft: e => seek(index - (e.shiftKey ? 10 : 1)),
  ArrowRight: e => seek(index + (e.shiftKey ? 10 : 1)),
  Home: () => seek(0),
  End: () => seek(frames.length - 1),
  v: () => { atRest = !atRest; reset(); },
  r: reset,
};
document.addEventListener("keydown", e => {
  if (!KEYS[e.key] || e.ctrlKey || e.metaKey || e.altKey || e.target.id === "speed") return;
  e.preventDefault();
  KEYS[e.key](e);
});
$("slider").addEventListener("input", () => seek(Number($("slider").value)));
$("play").addEventListener("click", () => play(!playing));
$("view").addEventListener("click", KEYS.v);
$("lifted").addEventListener("wheel", e => {
  e.preventDefault();
  wheel = Math.max(0.2, Math.min(20, wheel * Math.exp(-e.deltaY / 500)));
  orbit.draw();
}, { passive: false });
new ResizeObserver(() => show(index)).observe(document.querySelector("main"));
$("ramp").style.background = `linear-gradient(90deg, ${[0, 1 / 3, 2 / 3, 1].map(colour)})`;

if (live) {
  const stream = new EventSource("frames");
  stream.onopen = () => { $("state").textContent = "live: waiting for frames"; };
  stream.onerror = () => { $("state").textContent = "connection lost; the received frames can be played"; };
  stream.addEventListener("end", () => { $("state").textContent = "end of the recording"; stream.close(); });
  stream.onmessage = event => {
    take(JSON.parse(event.data));
    if (frames.length > MOST) { frames.shift(); index = Math.max(0, index - 1); }
    $("state").textContent = following ? "live" : "live, paused";
    show(following && !playing ? frames.length - 1 : index);
  };
} else {
  recording.frames.forEach(take);
}
reset();
