// A person on a floor: four cameras' images left, the person lifted from the chosen one right.
// World axes: z up, metres, floor at z = 0.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const $ = id => document.getElementById(id);
const RAMP = [[230, 97, 1], [253, 184, 99], [120, 198, 121], [0, 104, 55]];
const TRUTH = "#b4bcc4";
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
const count = data.views[0].points.length;
let index = 0, chosen = 0, playing = false, turning = !still, bodied = true, clock = 0, before = 0, wheel = 1;

function colour(confidence) {
  const at = Math.min(1, Math.max(0, confidence)) * (RAMP.length - 1);
  const low = Math.min(RAMP.length - 2, Math.floor(at)), part = at - low;
  return `rgb(${RAMP[low].map((v, k) => Math.round(v + part * (RAMP[low + 1][k] - v)))})`;
}

const known = point => point && point[0] !== null;
// All known points of all views and frames, for a view that fits them all the time.
const cloud = data.views.flatMap(view => [...view.shapes, ...view.truth].flat()).filter(known);
const quantile = (values, share) => [...values].sort((a, b) => a - b)[Math.floor(share * (values.length - 1))];
const middle = [0, 1].map(k => quantile(cloud.map(p => p[k]), 0.5));
const height = quantile(cloud.map(p => p[2]), 0.995);
const radius = quantile(cloud.map(p => Math.hypot(p[0] - middle[0], p[1] - middle[1])), 0.97);
// From the world to x right, y up, z to the viewer, around the middle of the person's room.
const toScreen = ([x, y, z]) => [x - middle[0], z - height / 2, middle[1] - y];

const panes = data.views.map((view, number) => {
  const figure = document.createElement("figure"), caption = document.createElement("figcaption");
  const canvas = document.createElement("canvas");
  caption.textContent = view.name;
  figure.append(caption, canvas);
  figure.addEventListener("click", () => choose(number));
  $("views").append(figure);
  const images = view.images.map(source => {
    const image = new Image();
    image.onload = () => drawSeen(number);
    image.src = source;
    return image;
  });
  return { view, figure, canvas, images };
});

function drawSeen(number) {
  const { view, canvas, images } = panes[number], pen = canvas.getContext("2d");
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  [canvas.width, canvas.height] = [width * ratio, height * ratio];
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.lineCap = "round";
  const zoom = Math.min(width / view.size[0], height / view.size[1]);
  const corner = [(width - zoom * view.size[0]) / 2, (height - zoom * view.size[1]) / 2];
  const image = images[index];
  if (image && image.complete && image.naturalWidth) pen.drawImage(image, ...corner, ...view.size.map(v => v * zoom));
  const at = view.points[index].map(([x, y]) => [corner[0] + zoom * x, corner[1] + zoom * y]);
  const confidence = view.confidence[index];
  data.source.edges.forEach(([a, b], k) => {
    if (!(confidence[a] > 0 && confidence[b] > 0)) return;
    for (const [stroke, size] of [["rgba(255,255,255,0.75)", 4.5], [data.source.colours[k], 2.5]]) {
      pen.strokeStyle = stroke;
      pen.lineWidth = size;
      pen.beginPath(); pen.moveTo(...at[a]); pen.lineTo(...at[b]); pen.stroke();
    }
  });
  at.forEach((point, i) => {
    if (!(confidence[i] > 0)) return;
    pen.fillStyle = colour(confidence[i]);
    pen.beginPath(); pen.arc(...point, 3.2, 0, 7); pen.fill();
  });
}

// Lines of the floor, from the middle of the room to all sides.
function floor(project) {
  const step = data.grid, reach = Math.ceil((radius + 0.2) / step) * step;
  const [cx, cy] = middle.map(v => Math.round(v / step) * step), lines = [];
  for (let d = -reach; d <= reach + 1e-9; d += step) {
    lines.push([[cx + d, cy - reach, 0], [cx + d, cy + reach, 0]], [[cx - reach, cy + d, 0], [cx + reach, cy + d, 0]]);
  }
  return { lines: lines.map(line => line.map(project)), corners: [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(
    ([x, y]) => project([cx + x * reach, cy + y * reach, 0])) };
}

function fit() {
  const [s, c] = [Math.sin(orbit.pitch), Math.cos(orbit.pitch)];
  const wide = 2 * (radius + 0.15), tall = height * c + 2 * radius * Math.abs(s);
  return 0.9 * wheel * Math.min(orbit.width / wide, orbit.height / tall);
}

const orbit = new Orbit($("lifted"), 0, 0.24, () => {
  orbit.clear();
  orbit.distance = 4.2;
  orbit.zoom = fit();
  const pen = orbit.pen, view = data.views[chosen], project = p => orbit.project(toScreen(p));
  const { lines, corners } = floor(project);
  pen.fillStyle = "#f3f5f6";
  pen.beginPath(); corners.forEach(([x, y]) => pen.lineTo(x, y)); pen.fill();
  lines.forEach(([a, b]) => stroke(a, b, "#cfd5d9", 1));
  arrow(project, view);
  const shape = view.shapes[index], truth = view.truth[index];
  bones(data.target, shape, ([a, b]) => stroke(project([a[0], a[1], 0]), project([b[0], b[1], 0]), "rgba(40,48,56,0.16)", 7));
  if (bodied) body(view.capsules[index], view.radius, project);
  orbit.joints = shape.every(known) ? shape.map(project) : [];
  const drawn = [];
  bones(data.truth, truth, ([a, b]) => drawn.push([project(a), project(b), TRUTH, 8]));
  bones(data.target, shape, ([a, b], stroke) => drawn.push([project(a), project(b), stroke, 5]));
  drawn.sort((e, f) => e[0][2] + e[1][2] - f[0][2] - f[1][2]).forEach(line => stroke(...line));
  orbit.dots(orbit.joints, orbit.joints.map(() => "#20262b"), 3);
  if (!orbit.joints.length) write(pen, 16, 28, "no answer for this frame: dropped, or not lifted");
  write(pen, 14, orbit.height - 14, `floor: one square is ${data.grid} m`);
});

// The capsules of the person's URDF, far ones first, each with an outline.
function body(capsules, thickness, project) {
  capsules.filter(ends => ends.every(known)).map(ends => ends.map(project))
    .sort((e, f) => e[0][2] + e[1][2] - f[0][2] - f[1][2])
    .forEach(([a, b]) => {
      const near = 1 - (a[2] + b[2]) / 2 / orbit.distance, width = 2 * thickness * orbit.zoom / Math.max(0.1, near);
      stroke(a, b, "#b9c6d3", width + 2);
      stroke(a, b, "#e6edf4", width);
    });
}

function bones(layout, points, draw) {
  layout.edges.forEach(([a, b], k) => {
    if (known(points[a]) && known(points[b])) draw([points[a], points[b]], layout.colours[k]);
  });
}

function stroke(a, b, style, width) {
  const pen = orbit.pen;
  pen.strokeStyle = style;
  pen.lineWidth = width;
  pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]); pen.stroke();
}

function write(pen, x, y, words) {
  pen.fillStyle = "#5a6268";
  pen.font = "13px system-ui, sans-serif";
  pen.fillText(words, x, y);
}

// On the floor, to where the camera stands.
function arrow(project, view) {
  const away = [view.position[0] - middle[0], view.position[1] - middle[1]];
  const far = Math.hypot(...away), unit = away.map(v => v / far), side = [-unit[1], unit[0]];
  const at = (along, across) => project([0, 1].map(k => middle[k] + along * unit[k] + across * side[k]).concat(0));
  const end = radius + 0.1;
  stroke(at(radius - 0.25, 0), at(end, 0), "#f28e2b", 3);
  for (const across of [-0.07, 0.07]) stroke(at(end - 0.1, across), at(end, 0), "#f28e2b", 3);
  const [x, y] = at(end, 0), below = y + 20 < orbit.height - 8;
  orbit.pen.textAlign = "center";
  write(orbit.pen, Math.max(70, Math.min(orbit.width - 70, x)), below ? y + 20 : at(radius - 0.25, 0)[1] - 12, `to ${view.name}, ${far.toFixed(1)} m`);
  orbit.pen.textAlign = "left";
}

function show(next) {
  index = Math.max(0, Math.min(count - 1, next));
  $("slider").value = index;
  $("time").value = `${(index / data.rate).toFixed(2)} s · ${index + 1} / ${count}`;
  panes.forEach((_, number) => drawSeen(number));
  orbit.draw();
}

function choose(number) {
  if (!data.views[number]) return;
  chosen = number;
  const view = data.views[chosen];
  panes.forEach(({ figure }, k) => figure.classList.toggle("chosen", k === chosen));
  $("caption").textContent = `Lifted from ${view.name} alone`;
  $("errors").textContent = `${view.name}, mean error of 12 limb joints against the ground truth: ${view.errors}`;
  reset();
}

// The view from the camera, a little to its side and above.
function reset() {
  const [x, , z] = toScreen(data.views[chosen].position);
  [orbit.yaw, orbit.pitch, wheel] = [Math.atan2(x, z) * -1 + 0.5, 0.24, 1];
  show(index);
}

function play(on) {
  playing = on;
  clock = index / data.rate;
  $("play").textContent = on ? "❚❚" : "▶";
}

function turn(on) {
  turning = on;
  $("turn").textContent = on ? "stand still" : "turn";
}

function tick(now) {
  const passed = before ? Math.min(0.1, (now - before) / 1000) : 0;
  before = now;
  if (turning) orbit.yaw += 0.45 * passed;
  if (playing) {
    clock += passed * Number($("speed").value);
    const next = Math.floor(clock * data.rate + 1e-6);
    if (next >= count) clock = 0;
    if (next % count !== index) show(next % count);
    else if (turning) orbit.draw();
  } else if (turning) orbit.draw();
  requestAnimationFrame(tick);
}

const seek = next => { play(false); show(next); };
const KEYS = {
  " ": () => play(!playing),
  ArrowLeft: () => seek(index - 1),
  ArrowRight: () => seek(index + 1),
  Home: () => seek(0),
  End: () => seek(count - 1),
  t: () => turn(!turning),
  b: () => { bodied = !bodied; orbit.draw(); },
  r: () => { turn(false); reset(); },
  ...Object.fromEntries(data.views.map((_, k) => [String(k + 1), () => choose(k)])),
};
document.addEventListener("keydown", e => {
  if (!KEYS[e.key] || e.ctrlKey || e.metaKey || e.altKey || e.target.id === "speed") return;
  e.preventDefault();
  KEYS[e.key](e);
});
$("slider").max = count - 1;
$("slider").addEventListener("input", () => seek(Number($("slider").value)));
$("play").addEventListener("click", () => play(!playing));
$("turn").addEventListener("click", () => turn(!turning));
$("lifted").addEventListener("pointerdown", () => turn(false));
$("lifted").addEventListener("wheel", e => {
  e.preventDefault();
  wheel = Math.max(0.3, Math.min(12, wheel * Math.exp(-e.deltaY / 500)));
  orbit.draw();
}, { passive: false });
new ResizeObserver(() => show(index)).observe($("stage"));
choose(0);
turn(turning);
play(!still);
requestAnimationFrame(tick);
