// The 3D shapes of a report: drag to rotate; shapes with a mode are animated along it.
"use strict";
const scenes = JSON.parse(document.getElementById("scenes").textContent);
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;

function view(canvas) {
  const scene = scenes[canvas.dataset.scene];
  let swing = 0;
  const reach = 1e-9 + Math.max(...scene.points.map(
    (p, i) => Math.hypot(...p) + (scene.mode ? 2 * Math.hypot(...scene.mode[i]) : 0)));
  const moved = (p, i) => p.map((v, k) => v + (scene.mode ? swing * scene.mode[i][k] : 0));

  const orbit = new Orbit(canvas, scene.yaw * Math.PI / 180, scene.mode ? 0.15 : 0, () => {
    orbit.clear();
    orbit.zoom = 0.46 * orbit.width / reach;
    const at = scene.points.map((p, i) => orbit.project(moved(p, i)));
    orbit.lines(scene.edges.map(([a, b], k) => [at[a], at[b], scene.colours[k]]), reach);
    orbit.dots(at, at.map(() => "#222222"));
  });
  if (scene.mode && !still) {
    const tick = time => {
      swing = 2 * Math.sin(time / 700);
      orbit.draw();
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  } else {
    orbit.draw();
  }
}

document.querySelectorAll("canvas[data-scene]").forEach(view);
