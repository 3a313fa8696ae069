# SPDX-License-Identifier: Apache-2.0
"""A person on a floor: what several cameras saw, what was lifted, and the ground truth.

Everything is in world axes, z up, in metres, with the floor at z = 0. `stage_page` makes one HTML
page of it, `stage_pictures` makes images.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.clip import IMAGE_STEP, Images
from deep_nrsfm_ros.data.pose2sim import JOINTS, RATE, Session
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.nrsfm.metrics import CameraErrors, camera_errors
from deep_nrsfm_ros.reporting.capsules import body_capsules
from deep_nrsfm_ros.reporting.drawing import edge_colours
from deep_nrsfm_ros.reporting.template import embedded, render

Floats = NDArray[Any]

GRID = 0.5
"""Metres between two lines of the floor."""
_MM = 1e-3


@dataclass(frozen=True)
class StageView:
    """What one camera saw, and what was lifted from it; f frames.

    Attributes:
        name: of the camera.
        images: cut out around the person.
        points: (f, q, 2) detections in pixels of the images.
        confidence: (f, q) of the detections, 0 = missing.
        shapes: (f, p, 3) lifted points; NaN where nothing was lifted.
        truth: (f, j, 3) ground truth of `JOINTS`; NaN where unknown.
        position: (3,) of the camera.
        error: of the lifted limb joints.
    """

    name: str
    images: Images
    points: Floats
    confidence: Floats
    shapes: Floats
    truth: Floats
    position: Floats
    error: CameraErrors

    @property
    def errors(self) -> str:
        """What the page says of the errors."""
        return (
            f"{self.error.aligned:.0f} mm after alignment, {self.error.in_camera:.0f} mm as it "
            f"stands but for scale and place, rotation {self.error.rotation:.0f}° off"
        )

    @property
    def lifted(self) -> NDArray[np.bool_]:
        """Which of the f frames are lifted."""
        return np.asarray(np.isfinite(self.shapes).all((1, 2)))


@dataclass(frozen=True)
class Stage:
    """The views of a clip.

    Attributes:
        source: layout of the detections.
        target: layout of the lifted points.
        truth: layout of the ground truth.
        views: one for each camera.
        step: frames from one that is shown to the next.
    """

    source: KeypointLayout
    target: KeypointLayout
    truth: KeypointLayout
    views: tuple[StageView, ...]
    step: int = IMAGE_STEP

    @property
    def frames(self) -> range:
        """Return the frames that are shown: those with an image."""
        return range(0, len(self.views[0].points), self.step)


def make_stage(
    session: Session,
    images: Sequence[Images],
    source: KeypointLayout,
    target: KeypointLayout,
    lifted: Sequence[Floats],
) -> Stage:
    """Return the stage of a session.

    Args:
        session: its world has z up, unit mm.
        images: of each view.
        source: layout of the detections.
        target: layout of the lifted points.
        lifted: for each view (f, p, 3) points in metres in the optical frame of its camera, at
            their place; NaN where nothing was lifted.
    """
    limbs = [target.index(joint) for joint in JOINTS]
    views = []
    for view, image, shapes in zip(session.views, images, lifted, strict=True):
        camera = view.camera
        known = np.isfinite(shapes).all((1, 2))
        views.append(
            StageView(
                camera.name,
                image,
                image.to_image(view.points),
                view.confidence,
                (shapes - _MM * camera.translation) @ camera.rotation,
                _MM * (view.truth - camera.translation) @ camera.rotation,
                -_MM * camera.translation @ camera.rotation,
                camera_errors(shapes[known][:, limbs] / _MM, view.truth[known]),
            )
        )
    edges = tuple(edge for edge in source.edges if set(edge) <= set(JOINTS))
    return Stage(source, target, KeypointLayout("truth", JOINTS, edges), tuple(views))


def stage_page(
    stage: Stage, title: str, notes: Sequence[str], links: Mapping[str, str] | None = None
) -> str:
    """Return a stage as one HTML page that opens offline.

    Args:
        stage: to show.
        title: of the page.
        notes: sentences below the title.
        links: other pages below the title, from what they show to their files.
    """
    head = {
        "source": _drawn(stage.source),
        "target": _drawn(stage.target),
        "truth": _drawn(stage.truth),
        "rate": RATE / stage.step,
        "grid": GRID,
        "views": [_view(view, stage.frames, stage.target) for view in stage.views],
    }
    return render(
        "stage.html.j2",
        ["player.css", "stage.css"],
        ["orbit.js", "stage.js"],
        title=title,
        notes=notes,
        links=links or {},
        grid=GRID,
        stage=embedded(head),
    )


def _view(view: StageView, frames: range, target: KeypointLayout) -> dict[str, Any]:
    """Return a view for stage.js; numbers in pixels, confidence in percent, metres."""
    rows = slice(frames.start, frames.stop, frames.step)
    capsules = body_capsules(target, view.shapes[rows])
    return {
        "name": view.name,
        "size": view.images.size,
        "errors": view.errors,
        "position": _numbers(view.position, 3),
        "images": [
            "data:image/webp;base64," + base64.b64encode(file).decode("ascii")
            for file in view.images.files
        ],
        "points": [_numbers(frame, 1) for frame in view.points[rows]],
        "confidence": [_numbers(frame, 2) for frame in view.confidence[rows]],
        "shapes": [_numbers(frame, 3) for frame in view.shapes[rows]],
        "truth": [_numbers(frame, 3) for frame in view.truth[rows]],
        "capsules": [_numbers(frame, 3) for frame in capsules.ends],
        "radius": round(capsules.radius, 4),
    }


def _drawn(layout: KeypointLayout) -> dict[str, Any]:
    """Return edges and colours of a layout for stage.js."""
    return {"edges": layout.edge_indices(), "colours": edge_colours(layout)}


def _numbers(values: Floats, digits: int) -> list[Any]:
    """Return an array as rounded numbers; None where a number is not finite."""
    rounded = np.round(np.asarray(values, np.float64), digits).astype(object)
    rounded[~np.isfinite(values)] = None
    listed: list[Any] = rounded.tolist()
    return listed
