# SPDX-License-Identifier: Apache-2.0
"""Videos in Python: the same answers as those of recordings, frame after frame."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.data.walking_person import FOCAL, IMAGE, in_layout
from deep_nrsfm_ros import HistoryOptions, Intrinsics, Lifter, LiftingOptions, VideoLifter
from deep_nrsfm_ros.data.detections import gather, stamps_at
from deep_nrsfm_ros.data.over_time import CAUSAL, NONE, OverTime
from deep_nrsfm_ros.data.recording import lift_recording
from deep_nrsfm_ros.layouts.presets import BODY25
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.observation import Observation

CAMERA = Intrinsics((FOCAL, FOCAL), (IMAGE[0] / 2, IMAGE[1] / 2))
LIFTER = Lifter("human", layout="body25")
FRAMES = 30
UP = (0.0, -2.0, 0.0)
POINTS, CONFIDENCE = in_layout(BODY25, FRAMES)


def recorded(smooth: str, camera: Intrinsics | None, up: np.ndarray | None) -> Lifted:
    """Return the same frames, lifted as a recording."""
    frames = [Observation(POINTS[i : i + 1], CONFIDENCE[i : i + 1]) for i in range(FRAMES)]
    detections = gather(frames, stamps_at(30, FRAMES), len(BODY25))
    over_time = OverTime(smooth, up)
    return lift_recording(detections, BODY25, LIFTER, intrinsics=camera, over_time=over_time).lifted


@pytest.mark.parametrize("camera", [CAMERA, None])
@pytest.mark.parametrize("up", [UP, None])
def test_a_video_is_lifted_as_a_recording(
    camera: Intrinsics | None, up: tuple[float, float, float] | None
) -> None:
    unit = None if up is None else np.array(up) / 2
    video = VideoLifter(LIFTER, camera, up=up)
    for i, expected in enumerate(recorded(CAUSAL, camera, unit).shapes):
        lifted = video(POINTS[i], CONFIDENCE[i], seconds=100 + i / 30)
        np.testing.assert_allclose(lifted.shapes[0], expected, atol=1e-5)
    alone = video(POINTS, CONFIDENCE)
    np.testing.assert_allclose(alone.shapes, recorded(NONE, camera, unit).shapes, atol=1e-5)
    assert video.identities == ("",) * FRAMES


def test_a_person_keeps_its_identity_and_its_past() -> None:
    alone, both = VideoLifter(LIFTER, CAMERA), VideoLifter(LIFTER, CAMERA)
    for i in range(FRAMES):
        order = [1, 0] if i % 3 else [0, 1]
        pair = np.stack([POINTS[i], POINTS[i] + [300.0, 0]])[order]
        expected = alone(POINTS[i], CONFIDENCE[i], seconds=i / 30)
        lifted = both(pair, np.stack([CONFIDENCE[i]] * 2), seconds=i / 30)
        np.testing.assert_allclose(lifted.shapes[order.index(0)], expected.shapes[0], atol=1e-5)
        assert both.identities[order.index(0)] == alone.identities[0] == "object1"


def test_the_identities_of_a_detector_are_used() -> None:
    video = VideoLifter(LIFTER)
    video(POINTS[:2], seconds=0.0, identities=["anna", ""])
    assert video.identities[0] == "anna" and video.identities[1].startswith("object")
    with pytest.raises(ValueError, match="identities are 1; give one for each of 2 objects"):
        video(POINTS[:2], seconds=0.1, identities=["anna"])


def test_time_that_jumps_back_begins_anew() -> None:
    video, anew = VideoLifter(LIFTER, CAMERA), VideoLifter(LIFTER, CAMERA)
    for i in range(10):
        video(POINTS[i], seconds=50 + i / 30)
    again = video(POINTS[5], seconds=1.0)
    np.testing.assert_array_equal(again.shapes, anew(POINTS[5], seconds=1.0).shapes)


@pytest.mark.parametrize("off", ["history", "correction"])
def test_nothing_is_remembered_where_the_options_say_so(off: str) -> None:
    history = HistoryOptions(enabled=off != "history")
    options = LiftingOptions(correction="none" if off == "correction" else "bones")
    lifter = Lifter("human", options, layout="body25", history=history)
    video, alone = VideoLifter(lifter, CAMERA), VideoLifter(lifter, CAMERA)(POINTS[:5])
    for i in range(5):
        np.testing.assert_allclose(
            video(POINTS[i], seconds=i / 30).shapes[0], alone.shapes[i], atol=1e-5
        )


def test_a_frame_without_objects_is_lifted_to_none() -> None:
    video = VideoLifter(LIFTER, CAMERA)
    assert video(np.zeros((0, 25, 2)), seconds=0.0).shapes.shape == (0, 25, 3)
    assert video.identities == ()


def test_what_is_no_camera_and_no_direction_is_refused() -> None:
    with pytest.raises(TypeError, match=r"camera is a ndarray; give Intrinsics\(\(fx, fy\)"):
        VideoLifter(LIFTER, np.eye(3))  # type: ignore[arg-type]
    for up in ((0, 0, 0), (0, 1), (np.nan, 0, 1)):
        with pytest.raises(ValueError, match="up is .*; give x, y and z against gravity"):
            VideoLifter(LIFTER, up=up)
    many = Lifter("human", LiftingOptions(min_visible=18), layout="coco17")
    with pytest.raises(ValueError, match="min_visible is 18"):
        VideoLifter(many)


@pytest.mark.parametrize("seconds", [np.nan, np.inf])
def test_a_time_that_is_none_is_refused(seconds: float) -> None:
    with pytest.raises(ValueError, match=f"seconds is {seconds}; give the time of the frame"):
        VideoLifter(LIFTER)(POINTS[0], seconds=seconds)
