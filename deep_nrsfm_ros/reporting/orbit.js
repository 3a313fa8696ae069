// A canvas with a 3D scene that rotates when it is dragged. Axes x right, y up, z to the viewer.
"use strict";

class Orbit {
  // draw(orbit) is called whenever the view changes; zoom: pixels per unit of the scene; distance: of
  // the viewer from the origin, Infinity: no perspective.
  constructor(canvas, yaw, pitch, draw) {
    Object.assign(this, { canvas, yaw, pitch, draw, pen: canvas.getContext("2d"), zoom: 1, distance: Infinity });
    canvas.addEventListener("pointerdown", e => canvas.setPointerCapture(e.pointerId));
    canvas.addEventListener("pointermove", e => {
      if (!e.buttons) return;
      this.yaw += e.movementX / 90;
      this.pitch = Math.max(-1.5, Math.min(1.5, this.pitch + e.movementY / 90));
      this.draw(this);
    });
  }

  // Clear the canvas and match its resolution to its size on the page.
  clear() {
    const ratio = window.devicePixelRatio || 1, { canvas, pen } = this;
    [this.width, this.height] = [canvas.clientWidth, canvas.clientHeight];
    [canvas.width, canvas.height] = [this.width * ratio, this.height * ratio];
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.lineCap = "round";
  }

  // Return the position of a point on the canvas, and its depth, larger = nearer.
  project([x, y, z]) {
    const [c, s] = [Math.cos(this.yaw), Math.sin(this.yaw)];
    const [cp, sp] = [Math.cos(this.pitch), Math.sin(this.pitch)];
    const depth = c * z - s * x, nearness = cp * depth + sp * y;
    const zoom = this.zoom / Math.max(0.1, 1 - nearness / this.distance);
    return [this.width / 2 + zoom * (c * x + s * z),
            this.height / 2 - zoom * (cp * y - sp * depth), nearness];
  }

  // Lines [from, to, colour, opacity, width] between projected points, drawn from far to near, far ones fainter.
  lines(lines, reach) {
    const pen = this.pen;
    [...lines].sort((e, f) => e[0][2] + e[1][2] - f[0][2] - f[1][2])
      .forEach(([a, b, colour, opacity = 1, width = 3]) => {
        const near = Math.min(1, Math.max(0, 0.5 + (a[2] + b[2]) / (2 * reach)));
        pen.globalAlpha = opacity * (0.6 + 0.4 * near);
        pen.strokeStyle = colour;
        pen.lineWidth = width;
        pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]); pen.stroke();
      });
    pen.globalAlpha = 1;
  }

  dots(points, colours, radius = 2.5) {
    points.forEach(([x, y], i) => {
      this.pen.fillStyle = colours[i];
      this.pen.beginPath(); this.pen.arc(x, y, radius, 0, 7); this.pen.fill();
    });
  }
}
