// Shapes in 3D: drag to turn; those with a mode swing along it. Axes x right, y up, z to the viewer.
"use strict";
const scenes = JSON.parse(document.getElementById("scenes").textContent);
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;

function view(canvas) {
  const scene = scenes[canvas.dataset.scene];
  const size = canvas.clientWidth, ratio = window.devicePixelRatio || 1;
  canvas.width = canvas.height = size * ratio;
  const pen = canvas.getContext("2d");
  let yaw = scene.turn * Math.PI / 180, pitch = scene.mode ? 0.15 : 0, swing = 0;
  const reach = 1e-9 + Math.max(...scene.points.map(
    (p, i) => Math.hypot(...p) + (scene.mode ? 2 * Math.hypot(...scene.mode[i]) : 0)));
  const zoom = 0.46 * size / reach;

  function project(p, i) {
    const [x, y, z] = p.map((v, k) => v + (scene.mode ? swing * scene.mode[i][k] : 0));
    const [c, s, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const depth = c * z - s * x;
    return [size / 2 + zoom * (c * x + s * z), size / 2 - zoom * (cp * y - sp * depth),
            cp * depth + sp * y];
  }

  function draw() {
    const at = scene.points.map(project);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, size, size);
    pen.lineCap = "round";
    scene.edges.map(([a, b], k) => [at[a], at[b], scene.colours[k]])
      .sort((e, f) => e[0][2] + e[1][2] - f[0][2] - f[1][2])
      .forEach(([a, b, colour]) => {
        pen.globalAlpha = 0.6 + 0.4 * Math.min(1, Math.max(0, 0.5 + (a[2] + b[2]) / (2 * reach)));
        pen.strokeStyle = colour;
        pen.lineWidth = 3;
        pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]); pen.stroke();
      });
    pen.globalAlpha = 1;
    pen.fillStyle = "#222222";
    at.forEach(([x, y]) => { pen.beginPath(); pen.arc(x, y, 2.5, 0, 7); pen.fill(); });
  }

  canvas.addEventListener("pointerdown", e => canvas.setPointerCapture(e.pointerId));
  canvas.addEventListener("pointermove", e => {
    if (!e.buttons) return;
    yaw += e.movementX / 90;
    pitch = Math.max(-1.5, Math.min(1.5, pitch + e.movementY / 90));
    draw();
  });
  if (scene.mode && !still) {
    const tick = time => { swing = 2 * Math.sin(time / 700); draw(); requestAnimationFrame(tick); };
    requestAnimationFrame(tick);
  } else {
    draw();
  }
}

document.querySelectorAll("canvas[data-scene]").forEach(view);
