# SPDX-License-Identifier: Apache-2.0
"""A pipeline says why it lifts nobody, and counts what the detector saw."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.data.walking_person import in_layout
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import TRUNK
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.observation import MessageError, Observation, to_observation
from deep_nrsfm_ros.lifting.options import HistoryOptions, LiftingOptions
from deep_nrsfm_ros.lifting.perspective import lift_perspective
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
        ("coco17", ("left_hip", "right_hip", "left_knee"), 3),
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


def test_keypoints_that_are_too_large_are_named_as_a_cause() -> None:
    pipeline = Pipeline(HUMAN, None, InputOptions(), LiftingOptions(), SmoothingOptions())
    huge = to_observation(np.full((1, len(HUMAN.layout), 3), 1e30))
    with pytest.raises(MessageError, match=r"at most 0 detected .* coordinate of 1e\+09 or more"):
        pipeline.lift(huge, None, ("",), "topic", Moment(0.0))


def walked(history: HistoryOptions, **changes: Any) -> list[np.ndarray]:
    """Return the shapes of a person who walks, as a stream gives them."""
    layout = LAYOUTS["coco17"]
    pipeline = Pipeline(
        HUMAN, layout, InputOptions(), LiftingOptions(**changes), SmoothingOptions(), history
    )
    to_model = KeypointMap(layout, HUMAN.layout)
    shapes = []
    for i, (points, confidence) in enumerate(zip(*in_layout(layout, 30), strict=True)):
        seen = Observation(*to_model(points[None], confidence[None]))
        lifted, _ = pipeline.lift(seen, CAMERA, ("someone",), "topic", Moment(i / 30))
        shapes.append(lifted.shapes[0])
    assert bool(pipeline.learned_bones()) == (history.enabled and not changes)
    return shapes


def test_an_answer_depends_on_history_unless_it_is_off() -> None:
    points, confidence = in_layout(LAYOUTS["coco17"], 30)
    lifter = Lifter(HUMAN, layout="coco17")
    to_model = KeypointMap(lifter.layout, HUMAN.layout)
    alone = lift_perspective(lifter, CAMERA, *to_model(points, confidence)).shapes
    on, off = walked(HistoryOptions()), walked(HistoryOptions(enabled=False))
    np.testing.assert_allclose(off, alone, atol=1e-5)
    np.testing.assert_allclose(on[0], alone[0], atol=1e-5)
    assert np.abs(on[-1] - alone[-1]).max() > 1e-3
    np.testing.assert_allclose(
        walked(HistoryOptions(), correction="none"),
        walked(HistoryOptions(enabled=False), correction="none"),
    )


def test_a_stream_that_restarts_has_no_history() -> None:
    layout = LAYOUTS["coco17"]
    pipeline = Pipeline(HUMAN, layout, InputOptions(), LiftingOptions(), SmoothingOptions())
    points, confidence = in_layout(layout, 30)
    mapped = KeypointMap(layout, HUMAN.layout)(points, confidence)

    def shape(i: int, moment: float) -> np.ndarray:
        seen = Observation(mapped[0][i : i + 1], mapped[1][i : i + 1])
        return pipeline.lift(seen, None, ("a",), "topic", Moment(moment))[0].shapes[0]

    first = shape(0, 0.0)
    for i in range(1, 30):
        shape(i, i / 30)
    assert np.abs(shape(0, 1.1) - first).max() > 1e-3
    pipeline.restart("topic")
    np.testing.assert_array_equal(shape(0, 0.0), first)


def test_learned_bones_are_shown_in_units_of_the_reference_length() -> None:
    layout = LAYOUTS["coco17"]
    pipeline = Pipeline(HUMAN, layout, InputOptions(), LiftingOptions(), SmoothingOptions())
    mapped = KeypointMap(layout, HUMAN.layout)(*in_layout(layout, 30))
    for i in range(30):
        seen = Observation(mapped[0][i : i + 1], mapped[1][i : i + 1])
        pipeline.lift(seen, CAMERA, ("a",), "topic", Moment(i / 30))
    assert pipeline.learned_bones(0) == {}
    (text,) = pipeline.learned_bones().values()
    assert "s of sight: " in text and "neck-mid_hip 0.500" in text and "right_knee" not in text
    assert "left_knee-left_ankle" in text and "big_toe" not in text  # coco17 has no toes


def bones_of(text: str) -> dict[str, float]:
    """Return the lengths of a text of learned bones by name."""
    pairs = (bone.rsplit(" ", 1) for bone in text.split(": ")[1].split(", "))
    return {name: float(length) for name, length in pairs}


def test_learned_bones_have_the_unit_of_the_points_and_are_of_those_present() -> None:
    layout = LAYOUTS["coco17"]
    pipeline = Pipeline(HUMAN, layout, InputOptions(), LiftingOptions(), SmoothingOptions())
    mapped = KeypointMap(layout, HUMAN.layout)(*in_layout(layout, 30))
    for i in range(30):
        names = ("a", "b") if i < 10 else ("a",)
        seen = Observation(mapped[0][[i] * len(names)], mapped[1][[i] * len(names)])
        lifted, _ = pipeline.lift(seen, CAMERA, names, "topic", Moment(i / 30))
    assert pipeline.learned_bones(shown={}) == {}
    (text,) = pipeline.learned_bones(shown={"a": 2.12 * lifted.shapes[0]}).values()
    own = bones_of(pipeline.learned_bones()["a"])
    assert bones_of(text) == pytest.approx({n: 2.12 * v for n, v in own.items()}, rel=0.02)
    span = np.linalg.norm(np.subtract(*lifted.shapes[0][[*map(HUMAN.layout.index, TRUNK)]]))
    assert bones_of(text)["neck-mid_hip"] == pytest.approx(2.12 * span, abs=1e-3)


def test_learned_bones_have_the_unit_of_the_points_where_no_bone_joins_the_reference() -> None:
    other = replace(HUMAN, layout=replace(HUMAN.layout, reference=("nose", "left_knee")))
    pipeline = Pipeline(other, None, InputOptions(), LiftingOptions(), SmoothingOptions())
    mapped = KeypointMap(LAYOUTS["coco17"], HUMAN.layout)(*in_layout(LAYOUTS["coco17"], 30))
    for i in range(30):
        seen = Observation(mapped[0][[i]], mapped[1][[i]])
        lifted, _ = pipeline.lift(seen, CAMERA, ("a",), "topic", Moment(i / 30))
    shape = lifted.shapes[0]
    (text,) = pipeline.learned_bones(shown={"a": shape}).values()
    index = other.layout.index
    for name, length in bones_of(text).items():
        a, b = (index(end) for end in name.split("-"))
        assert length == pytest.approx(np.linalg.norm(shape[a] - shape[b]), rel=0.25, abs=0.02)
