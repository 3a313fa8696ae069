# SPDX-License-Identifier: Apache-2.0
"""Real detections by four calibrated cameras: what intrinsics are worth, and where things are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.pose2sim import JOINTS, Session, View
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.presets import BODY25B
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.observation import to_observation
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.metrics import camera_errors

Floats = NDArray[Any]

CAMERA_CONVENTIONS = {
    "PA mm": "mean distance of 12 limb joints after the best similarity with a proper rotation",
    "camera mm": "the same, after the best scale and translation only: in the camera's frame",
    "rotation deg": "between the two, median",
    "mirrored %": "frames that a reflection would fit better",
    "place mm": "mean distance of the centroids in the camera's frame, the reference length being "
    "that of the truth; with intrinsics only",
    "place mm at 0.5 m": "the same, for a reference length of 0.5 m",
}
"""What each figure of `camera_table` means."""
_USUAL = 500.0  # mm from neck to mid-hip of an adult, as the README advises


def camera_table(models: Sequence[Model], session: Session) -> str:
    """Return, as text, a row for each model, way of lifting and camera; and the means."""
    columns = ("model", "lifted", "camera", *CAMERA_CONVENTIONS)
    lines = [f"| {' | '.join(columns)} |", f"{'|---' * len(columns)}|"]
    for model in models:
        for word, intrinsics in {"as shipped": False, "with intrinsics": True}.items():
            rows = [figures(model, view, session, intrinsics=intrinsics) for view in session.views]
            names = [*(view.camera.name for view in session.views), "mean"]
            for name, row in zip(names, [*rows, np.mean(rows, 0)], strict=True):
                forms = zip(row, (".1f", ".1f", ".1f", ".1f", ".0f", ".0f"), strict=True)
                cells = (format(value, form) if value == value else "" for value, form in forms)
                lines.append(f"| {model.name} | {word} | {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def figures(model: Model, view: View, session: Session, *, intrinsics: bool) -> list[float]:
    """Return the figures of one camera, in the order of `CAMERA_CONVENTIONS`; NaN for none.

    intrinsics: whether the lifter uses the camera's intrinsics.
    """
    values = np.concatenate((view.points, view.confidence[..., None]), -1)
    seen = to_observation(values, InputOptions().min_confidence)
    points, confidence = KeypointMap(BODY25B, model.layout)(seen.points, seen.confidence)
    length = reference_length(session)
    lifter = Lifter(model, LiftingOptions(reference_length=length))
    if intrinsics:
        lifted = lift_perspective(lifter, view.camera.intrinsics, points, confidence)
    else:
        lifted = lifter.lift(points, confidence)
    shapes = lifted.shapes[:, [model.layout.index(joint) for joint in JOINTS]]
    *errors, mirrored = camera_errors(shapes, view.truth)
    places = [np.nan, np.nan]
    if intrinsics:
        known = np.isfinite(view.truth).all((1, 2))
        found, truth = shapes[known].mean(1), view.truth[known].mean(1)
        # Everything is proportional to the reference length.
        moved = (found * (size / length) - truth for size in (length, _USUAL))
        places = [float(np.linalg.norm(move, axis=1).mean()) for move in moved]
    return [*errors, 100 * mirrored, *places]


def reference_length(session: Session) -> float:
    """Return the mean distance in mm from mid-shoulder to mid-hip of the truth."""
    shoulders, hips = (
        session.world[:, [JOINTS.index(f"{side}_{part}") for side in ("left", "right")]].mean(1)
        for part in ("shoulder", "hip")
    )
    return float(np.nanmean(np.linalg.norm(shoulders - hips, axis=1)))
