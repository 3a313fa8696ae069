"""A pipeline says why it lifts nobody, and counts what the detector saw."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.observation import MessageError, Observation
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.messages.pipeline import Pipeline
from deep_nrsfm_ros.messages.stamps import Moment
from deep_nrsfm_ros.model_files.model_file import load_model

HUMAN = load_model("human")
CAMERA = Intrinsics((1000.0, 1000.0), (640.0, 360.0))


def people(source: str, *shown: str) -> tuple[np.ndarray, np.ndarray]:
    """Return points and confidence (1, q) of random keypoints, of which some are visible."""
    layout = LAYOUTS[source]
    points = np.random.default_rng(0).uniform(300, 400, (1, len(layout), 2)).astype(np.float32)
    visible = np.array([[name in shown for name in layout.keypoints]])
    points[~visible] = 0
    return points, visible.astype(np.float32)


@pytest.mark.parametrize("intrinsics", [None, CAMERA])
@pytest.mark.parametrize(
    ("source", "shown", "detected"),
    [
        ("coco17", ("nose", "left_shoulder", "right_shoulder"), 3),
        ("body25", ("nose", "neck", "left_shoulder", "right_shoulder"), 3),
        ("coco17", ("left_hip", "right_hip", "left_knee", "left_eye", "left_ear"), 3),
        ("coco17", ("left_hip", "right_hip", "left_knee", "right_wrist"), 4),
    ],
)
def test_min_visible_counts_detected_keypoints(
    intrinsics: Intrinsics | None, source: str, shown: tuple[str, ...], detected: int
) -> None:
    layout, points = LAYOUTS[source], people(source, *shown)
    inputs, lifting = InputOptions(), LiftingOptions()
    pipeline = Pipeline(HUMAN, layout, inputs, lifting, SmoothingOptions())
    mapped = Observation(*KeypointMap(layout, HUMAN.layout)(*points))
    lifted = Lifter(HUMAN, layout=source)(*points)
    if detected >= lifting.min_visible:
        assert np.isfinite(lifted.shapes).all()
        pipeline.lift(mapped, intrinsics, ("",), "topic", Moment(0.0))
        return
    assert np.isnan(lifted.shapes).all() and not lifted.confidence.any()
    with pytest.raises(MessageError, match=f"at most {detected} detected .* min_visible is 4"):
        pipeline.lift(mapped, intrinsics, ("",), "topic", Moment(0.0))
