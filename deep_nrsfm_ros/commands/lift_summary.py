# SPDX-License-Identifier: Apache-2.0
"""The summary that `lift` prints: what was lifted, how well, what was left out and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.data.recording import Recording
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.layout_fit import better_layout, fit_layouts
from deep_nrsfm_ros.lifting.sanity import (
    LOW_CONFIDENCE,
    POOR_RESIDUAL,
    USUAL_RESIDUAL,
    Finding,
    Size,
    check,
    is_person,
    pose,
    wrong_keypoints,
    wrong_keypoints_text,
)
from deep_nrsfm_ros.lifting.weights import keypoint_weight, trusted
from deep_nrsfm_ros.model_files.model_file import Model

_FEW_LIFTED = 0.5  # fraction of the objects below which something looks wrong


@dataclass(frozen=True)
class Summary:
    """What came of a recording.

    Attributes:
        lifted: number of objects lifted.
        total: number of objects; padding of arrays is none.
        frames: number of frames.
        left_out: number of objects that were not lifted, by reason.
        residual: median residual of the lifted objects; NaN if there is none.
        confidence: median confidence of the lifted objects; NaN if there is none.
        wrong_keypoints: which keypoints were left out as wrong, and of how many objects; "" if it
            is less than 1 %.
        findings: what looks wrong. Without any, the answer can be believed.
    """

    lifted: int
    total: int
    frames: int
    left_out: dict[str, int]
    residual: float
    confidence: float
    wrong_keypoints: str
    findings: tuple[Finding, ...]

    @property
    def figures_text(self) -> str:
        """The figures in one sentence."""
        counts = f"{self.lifted} of {self.total} objects in {self.frames} frames lifted"
        if not self.lifted:
            return counts
        return (
            f"{counts}; median residual {self.residual:.2f} (below {USUAL_RESIDUAL:g} is usual, "
            f"from {POOR_RESIDUAL:g} on poor), confidence {self.confidence:.2f} (0 to 1, below "
            f"{LOW_CONFIDENCE:g} is low)"
        )

    @property
    def left_out_text(self) -> str:
        """Why objects were left out; "" if none was."""
        return "; ".join(f"{count} {reason}" for reason, count in self.left_out.items())


def summarise(
    recording: Recording,
    model: Model,
    intrinsics: Intrinsics | None = None,
    image_size: Size | None = None,
    min_visible: int = 4,
) -> Summary:
    """Return the summary of a lifted recording.

    Args:
        recording: keypoints and lifted shapes.
        model: lifted them.
        intrinsics: with which they were lifted; None: without.
        image_size: width and height of the image in pixels; None: unknown.
        min_visible: fewest visible keypoints of a lifted object.
    """
    detections, is_lifted = recording.detections, recording.is_lifted
    certainty = recording.lifted.object_confidence
    findings = check(
        detections.points,
        detections.confidence,
        intrinsics,
        image_size,
        detections.stamps,
        recording.lifted if is_lifted.any() else None,
        is_normalised=detections.is_normalised,
    )
    is_outside = any(finding.code == "outside" for finding in findings)
    residual = float(np.median(recording.lifted.residual[is_lifted])) if is_lifted.any() else np.nan
    if not is_outside and any(finding.code == "poor-fit" for finding in findings):
        fits = fit_layouts(detections.points, detections.confidence, model, [recording.source])
        if better := better_layout(fits, recording.source, residual):
            findings = [f for f in findings if f.code != "poor-fit"] + [better]
    if is_person(model.layout):
        used = image_size if intrinsics or detections.is_normalised else None
        seen = detections.confidence
        findings += pose(recording.lifted.rotations, seen, recording.source, image_size=used)
    wrong, names = recording.lifted.wrong[is_lifted], recording.target.keypoints
    findings += wrong_keypoints(wrong, names)
    total = int((~detections.is_padding).sum())
    if is_lifted.any() and is_lifted.sum() < _FEW_LIFTED * total:
        few = f"only {is_lifted.sum()} of {total} objects are lifted"
        findings.append(Finding("few-lifted", few))
    return Summary(
        int(is_lifted.sum()),
        total,
        len(detections.stamps),
        _left_out(recording, min_visible, with_camera=intrinsics is not None),
        residual,
        float(np.median(certainty[is_lifted])) if is_lifted.any() else np.nan,
        wrong_keypoints_text(wrong, names),
        tuple(findings),
    )


def _left_out(recording: Recording, min_visible: int, *, with_camera: bool) -> dict[str, int]:
    """Return the number of objects that were not lifted, by reason."""
    detections = recording.detections
    rows = np.flatnonzero(~(recording.is_lifted | detections.is_padding))
    if not len(rows):
        return {}
    to_model, few = KeypointMap(recording.source, recording.target), 0
    for part in slices(len(rows)):
        chosen = rows[part]
        _, mapped = to_model(detections.points[chosen], detections.confidence[chosen])
        count = to_model.detected_count(trusted(keypoint_weight(mapped)))
        few += int((count < min_visible).sum())
    camera = ", or come out behind the camera" if with_camera else ""
    counts = {
        f"have fewer than {min_visible} detected keypoints of the model (min_visible)": few,
        f"have their keypoints on one line or one spot{camera}": len(rows) - few,
    }
    return {reason: count for reason, count in counts.items() if count}
