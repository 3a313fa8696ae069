"""Summary of a lifted recording: what was lifted, how well, what was left out, what looks wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.recording import Recording
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.layout_fit import LayoutFit, better_layout, choose_layout, fit_layouts
from deep_nrsfm_ros.lifting.sanity import (
    POOR_RESIDUAL,
    Finding,
    Size,
    check,
    is_person,
    orientation,
)
from deep_nrsfm_ros.lifting.weights import keypoint_weight, trusted
from deep_nrsfm_ros.model_files.model_file import Model

_FEW_LIFTED = 0.5  # fraction of the objects below which the answer is doubtful


@dataclass(frozen=True)
class Summary:
    """What came of a recording.

    Attributes:
        lifted: number of objects lifted.
        total: number of objects.
        frames: number of frames.
        left_out: number of objects that were not lifted, by reason.
        residual: median reprojection error of the lifted objects; NaN if there is none.
        confidence: median confidence of the lifted objects; NaN if there is none.
        findings: what looks wrong. Without any, the answer can be believed.
    """

    lifted: int
    total: int
    frames: int
    left_out: dict[str, int]
    residual: float
    confidence: float
    findings: tuple[Finding, ...]

    @property
    def figures(self) -> str:
        """The figures in one sentence."""
        counts = f"{self.lifted} of {self.total} objects in {self.frames} frames lifted"
        if not self.lifted:
            return counts
        return f"{counts}; median residual {self.residual:.2f}, confidence {self.confidence:.2f}"

    @property
    def reasons(self) -> str:
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
    )
    residual = float(np.median(recording.lifted.residual[is_lifted])) if is_lifted.any() else np.nan
    if any(finding.code == "poor-fit" for finding in findings):
        fits = fit_layouts(detections.points, detections.confidence, model, [recording.source])
        if better := better_layout(fits, recording.source, residual):
            findings = [f for f in findings if f.code != "poor-fit"] + [better]
    if is_person(model.layout):
        findings += orientation(recording.lifted.rotations)
    if is_lifted.any() and is_lifted.mean() < _FEW_LIFTED:
        few = f"only {is_lifted.sum()} of {len(is_lifted)} objects are lifted"
        findings.append(Finding("few-lifted", few))
    return Summary(
        int(is_lifted.sum()),
        len(detections),
        len(detections.stamps),
        _left_out(recording, min_visible, with_camera=intrinsics is not None),
        residual,
        float(np.median(certainty[is_lifted])) if is_lifted.any() else np.nan,
        tuple(findings),
    )


def resolve_layout(detections: Detections, model: Model) -> tuple[KeypointLayout, str]:
    """Return the layout in which the keypoints fit best, and a sentence that says why.

    The model's own layout is taken unless another one fits clearly better.

    Args:
        detections: keypoints of which nothing says the layout.
        model: lifts them.

    Raises:
        ValueError: no layout of that number of keypoints can be lifted by the model.
    """
    fits = fit_layouts(detections.points, detections.confidence, model)
    q = detections.confidence.shape[1]
    chosen = choose_layout(fits, model.layout)
    if chosen and chosen.residual >= POOR_RESIDUAL:
        return chosen.layout, f"taken although no layout fits well; {_ranking(chosen, fits)}"
    if chosen:
        return chosen.layout, _ranking(chosen, fits)
    if q == len(model.layout):
        return model.layout, f"the order of the model, {q} keypoints"
    raise ValueError(
        f"the objects have {q} keypoints; no layout of {q} keypoints is known that model "
        f"{model.name!r} ({len(model.layout)} keypoints) can lift: name one with --keypoint-layout"
    )


def _ranking(chosen: LayoutFit, fits: list[LayoutFit]) -> str:
    """Return the residual of the chosen layout, and those of the others."""
    others = ", ".join(f"{fit.layout.name} {fit.residual:.2f}" for fit in fits if fit is not chosen)
    text = f"it fits with residual {chosen.residual:.2f}"
    return f"{text} ({others})" if others else f"{text}; no other layout has that size"


def _left_out(recording: Recording, min_visible: int, *, with_camera: bool) -> dict[str, int]:
    """Return the number of objects that were not lifted, by reason."""
    detections = recording.detections
    rows = np.flatnonzero(~recording.is_lifted)
    if not len(rows):
        return {}
    to_model = KeypointMap(recording.source, recording.target)
    _, mapped = to_model(detections.points[rows], detections.confidence[rows])
    few = int((to_model.detected_count(trusted(keypoint_weight(mapped))) < min_visible).sum())
    camera = ", or come out behind the camera" if with_camera else ""
    counts = {
        f"have fewer than {min_visible} detected keypoints of the model (min_visible)": few,
        f"have their keypoints on one line or one spot{camera}": len(rows) - few,
    }
    return {reason: count for reason, count in counts.items() if count}
