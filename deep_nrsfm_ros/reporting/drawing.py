# SPDX-License-Identifier: Apache-2.0
"""Drawings of the report: charts and skeletons as SVG, 3D shapes as data for viewer.js."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.layout import KeypointLayout, side_in_name

Points = NDArray[Any]
Line = Sequence[tuple[float, float]]

COLOURS = {"left": "#1f77b4", "right": "#d62728"}
MIDDLE = "#666666"
MISSING = "#d4d4d4"
_LINES = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f")
_ACCENT = "#d01c8b"


def curve(lines: Mapping[str, Line], label: str, size: tuple[int, int] = (330, 210)) -> Markup:
    """Return a line chart as SVG, both axes from zero.

    Args:
        lines: points (x, y) of each line, by its name; points that are not finite are left out.
        label: title of the chart.
        size: width and height in pixels.
    """
    width, height = size
    left, right, top, bottom = 48, 12, 26, 30
    points = [point for line in lines.values() for point in line]
    points = [(x, y) for x, y in points if math.isfinite(x) and math.isfinite(y)]
    xs, ys = [x for x, _ in points] or [0.0], [y for _, y in points] or [0.0]
    high = max([*xs, 1.0])
    step = _round_step(max(max(ys), 1e-9) / 4)
    steps = math.ceil(max(max(ys), 1e-9) / step)

    def place(x: float, y: float) -> tuple[float, float]:
        across = left + x / high * (width - left - right)
        return across, height - bottom - y / (steps * step) * (height - top - bottom)

    parts = [_text(left, 16, label, "start", "title")]
    for k in range(steps + 1):
        up = height - bottom - k / steps * (height - top - bottom)
        parts.append(_stroke(left, up, width - right, up, "#e4e4e4", 1))
        parts.append(_text(left - 6, up + 4, f"{k * step:.3g}", "end"))
    parts.append(_text(left, height - 10, "0", "start"))
    parts.append(_text(width - right, height - 10, f"step {high:,.0f}", "end"))
    for colour, (name, line) in zip(_cycle(len(lines)), lines.items(), strict=True):
        placed = [place(x, y) for x, y in line if math.isfinite(x) and math.isfinite(y)]
        path = " ".join(f"{across:.1f},{up:.1f}" for across, up in placed)
        parts.append(
            Markup(
                '<polyline points="{}" fill="none" stroke="{}" stroke-width="2"><title>{}'
                "</title></polyline>"
            ).format(path, colour, name)
        )
        parts += [_dot(across, up, 3, colour, name) for across, up in placed[-1:]]
    return _svg(width, height, parts, label)


def bars(values: Sequence[float], label: str, size: tuple[int, int] = (330, 210)) -> Markup:
    """Return a bar chart of values in [0, 1] as SVG, each with its value in percent.

    Args:
        values: the first three bars have another colour.
        label: title of the chart.
        size: width and height in pixels.
    """
    width, height = size
    parts = [_text(12, 16, label, "start", "title")]
    step = (width - 24) / max(len(values), 1)
    for k, value in enumerate(values):
        bar = max(1.0, min(1.0, value) * (height - 70))
        across = 12 + k * step
        colour = COLOURS["left"] if k < 3 else "#b9b9b9"
        parts.append(
            Markup('<rect x="{}" y="{}" width="{}" height="{}" fill="{}"/>').format(
                *(f"{v:.1f}" for v in (across, height - 28 - bar, step * 0.8, bar)), colour
            )
        )
        middle = across + step * 0.4
        if step > 22:
            parts.append(_text(middle, height - 32 - bar, f"{100 * value:.1f}", "middle"))
        parts.append(_text(middle, height - 12, str(k + 1), "middle"))
    return _svg(width, height, parts, label)


def skeleton(
    points: Points,
    visible: Points,
    layout: KeypointLayout,
    outliers: Points | None = None,
    size: int = 160,
) -> Markup:
    """Return 2D keypoints with the edges of their layout as SVG.

    Args:
        points: (p, 2), x right and y down, in any unit.
        visible: (p,) bool.
        layout: names and edges.
        outliers: (p,) bool, keypoints to circle.
        size: width and height in pixels.
    """
    shown = np.asarray(visible, bool) & np.isfinite(points).all(1)
    parts: list[Markup] = []
    if shown.any():
        P = np.asarray(points, np.float64)
        middle = (P[shown].max(0) + P[shown].min(0)) / 2
        extent = max(float((P[shown].max(0) - P[shown].min(0)).max()), 1e-9)
        at = (P - middle) / extent * (size - 36) + size / 2
        for (i, j), colour in zip(layout.edge_indices(), edge_colours(layout), strict=True):
            if shown[i] and shown[j]:
                (x1, y1), (x2, y2) = at[i], at[j]
                parts.append(_stroke(x1, y1, x2, y2, colour, 2.5))
        parts.extend(
            _dot(at[k, 0], at[k, 1], 2.5, "#222222", layout.keypoints[k])
            for k in np.flatnonzero(shown)
        )
        if outliers is not None:
            parts.extend(_ring(at[k, 0], at[k, 1]) for k in np.flatnonzero(shown & outliers))
    return _svg(size, size, parts, "keypoints")


def scene(
    shape: Points,
    layout: KeypointLayout,
    visible: Points,
    mode: Points | None = None,
    yaw: float = 0.0,
) -> dict[str, Any]:
    """Return a 3D shape as data for viewer.js.

    Args:
        shape: (p, 3) in screen axes: x right, y up, z to the viewer.
        layout: names and edges.
        visible: (p,) bool; edges to other keypoints are pale.
        mode: (p, 3) deformation to animate; None = a rigid shape.
        yaw: initial rotation about the vertical axis in degrees.
    """
    edges = layout.edge_indices()
    colours = zip(edges, edge_colours(layout), strict=True)
    return {
        "points": np.round(shape, 4).tolist(),
        "mode": None if mode is None else np.round(mode, 4).tolist(),
        "edges": edges,
        "colours": [c if visible[i] and visible[j] else MISSING for (i, j), c in colours],
        "names": list(layout.keypoints),
        "yaw": yaw,
    }


def edge_colours(layout: KeypointLayout) -> list[str]:
    """Return the colour of each edge by the names of its keypoints: left, right or neither.

    An edge is of a side if both ends are, or one end that has no other edge of its side, as an ear.
    """
    sides = {name: side_in_name(name) for name in layout.keypoints}
    own = [sides[a] if sides[a] == sides[b] else "" for a, b in layout.edges]
    limbs = {name for edge, side in zip(layout.edges, own, strict=True) if side for name in edge}
    colours = []
    for (a, b), side in zip(layout.edges, own, strict=True):
        single = {sides[name] for name in (a, b) if sides[name] and name not in limbs}
        if not side and not (sides[a] and sides[b]) and single:
            side = single.pop()
        colours.append(COLOURS.get(side, MIDDLE))
    return colours


def _round_step(least: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that is at least `least`."""
    power: float = 10.0 ** math.floor(math.log10(least))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= least * 0.999)


def _cycle(number: int) -> list[str]:
    """Return the colours of so many lines."""
    return [_LINES[k % len(_LINES)] for k in range(number)]


def _svg(width: int, height: int, parts: Sequence[Markup], label: str) -> Markup:
    """Return an SVG element with some parts."""
    opening = Markup(
        '<svg viewBox="0 0 {0} {1}" width="{0}" height="{1}" role="img" aria-label="{2}">'
    ).format(width, height, label)
    return opening + Markup("").join(parts) + Markup("</svg>")


def _text(x: float, y: float, words: str, anchor: str, kind: str = "tick") -> Markup:
    """Return a text of a CSS class."""
    return Markup('<text x="{}" y="{}" text-anchor="{}" class="{}">{}</text>').format(
        f"{x:.1f}", f"{y:.1f}", anchor, kind, words
    )


def _stroke(x1: float, y1: float, x2: float, y2: float, colour: str, width: float) -> Markup:
    """Return a line."""
    ends = (f"{v:.1f}" for v in (x1, y1, x2, y2))
    return Markup('<line x1="{}" y1="{}" x2="{}" y2="{}" stroke="{}" stroke-width="{}"/>').format(
        *ends, colour, width
    )


def _dot(x: float, y: float, radius: float, colour: str, name: str) -> Markup:
    """Return a dot with a tooltip."""
    return Markup('<circle cx="{}" cy="{}" r="{}" fill="{}"><title>{}</title></circle>').format(
        f"{x:.1f}", f"{y:.1f}", radius, colour, name
    )


def _ring(x: float, y: float) -> Markup:
    """Return a circle that marks an outlier."""
    return Markup(
        '<circle cx="{}" cy="{}" r="8" fill="none" stroke="{}" stroke-width="3"/>'
    ).format(f"{x:.1f}", f"{y:.1f}", _ACCENT)
