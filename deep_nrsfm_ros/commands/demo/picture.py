"""The demo's picture: the detections of each camera, and the lifted person from two sides."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.layout import KeypointLayout

matplotlib.use("Agg")
from matplotlib import pyplot

Floats = NDArray[Any]
_COLOURS = {"left": "#1f77b4", "right": "#d62728"}
_MIDDLE = "#555555"


class Panel(NamedTuple):
    """One frame of one camera.

    Attributes:
        title: above the panel.
        points: (q, 2) detections in pixels.
        confidence: (q,) of the detections, 0 = missing.
        shape: (p, 3) lifted points, camera axes, any unit.
        truth: (j, 3) joints in mm, camera axes; drawn with the scale and centre of the shape, but
            not rotated.
    """

    title: str
    points: Floats
    confidence: Floats
    shape: Floats
    truth: Floats


def draw(
    panels: Sequence[Panel],
    detector: KeypointLayout,
    model: KeypointLayout,
    joints: Sequence[str],
    path: Path,
) -> None:
    """Write a PNG with a column for each panel, and rows for the image, front and side.

    Args:
        panels: frames.
        detector: layout of the detections.
        model: layout of the lifted points.
        joints: names of the ground truth's joints.
        path: of the PNG.
    """
    figure, axes = pyplot.subplots(3, len(panels), figsize=(3 * len(panels), 11), squeeze=False)
    truth_layout = KeypointLayout(
        "truth", tuple(joints), tuple(e for e in detector.edges if set(e) <= set(joints))
    )
    for panel, (image, front, side) in zip(panels, axes.T, strict=True):
        visible = np.where(panel.confidence[:, None] > 0, panel.points, np.nan)
        _skeleton(image, visible, detector)
        image.set_title(panel.title)
        image.invert_yaxis()
        truth = _fit(panel.truth, panel.shape[[model.index(joint) for joint in joints]])
        for view, across in ((front, 0), (side, 2)):
            _skeleton(view, truth[:, [across, 1]], truth_layout, "#bbbbbb")
            _skeleton(view, panel.shape[:, [across, 1]], model)
            view.invert_yaxis()
    for row, label in zip(
        axes, ("detections", "from the camera", "from the camera's right"), strict=True
    ):
        row[0].set_ylabel(label)
    for axis in axes.flat:
        axis.set_aspect("equal", adjustable="datalim")
        axis.set(xticks=[], yticks=[])
    figure.text(0.5, 0.01, "blue: left, red: right, grey: triangulated truth", ha="center")
    figure.tight_layout(rect=(0, 0.02, 1, 1))
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def _fit(truth: Floats, shape: Floats) -> Floats:
    """Return the truth (j, 3) with the size and centre of the shape (j, 3).

    The scale of least squares would be close to 0 where a detector confuses left and right.
    """
    T, S = truth - truth.mean(0), shape - shape.mean(0)
    fitted: Floats = T * (np.linalg.norm(S) / np.linalg.norm(T)) + shape.mean(0)
    return fitted


def _skeleton(axis: Any, points: Floats, layout: KeypointLayout, colour: str = "") -> None:
    """Draw points (p, 2) and the edges between them; NaN leaves a gap."""
    for a, b in layout.edges:
        side = a.partition("_")[0] if a.partition("_")[0] == b.partition("_")[0] else ""
        ends = points[[layout.index(a), layout.index(b)]]
        axis.plot(*ends.T, color=colour or _COLOURS.get(side, _MIDDLE), linewidth=2)
    axis.plot(*points.T, "o", color=colour or "#222222", markersize=3)
