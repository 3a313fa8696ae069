# SPDX-License-Identifier: Apache-2.0
"""Recordings over time: no lag in the image, identities, unrelated images, gravity."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest

from benchmarks.data.walking_person import FOCAL, IMAGE, in_layout
from deep_nrsfm_ros.data.detections import Detections, gather, stamps_at
from deep_nrsfm_ros.data.over_time import BOTH, CAUSAL, NONE, OverTime
from deep_nrsfm_ros.data.recording import lift_recording
from deep_nrsfm_ros.layouts.presets import BODY25
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.model_files.model_file import load_model

CAMERA = Intrinsics((FOCAL, FOCAL), (IMAGE[0] / 2, IMAGE[1] / 2))
LIFTER = Lifter(load_model("human"))
FRAMES = 45


def walk(noise: float = 0.0, people: int = 1) -> Detections:
    """Return a recording of people who walk side by side, 400 pixels apart."""
    rng = np.random.default_rng(0)
    points, confidence = in_layout(BODY25, FRAMES)
    points = points + noise * rng.standard_normal(points.shape).astype(np.float32)
    frames = []
    for i in range(FRAMES):
        each = np.stack([points[i] + [400.0 * k, 0] for k in range(people)]).astype(np.float32)
        frames.append(Observation(each, np.repeat(confidence[i : i + 1], people, 0)))
    return gather(frames, stamps_at(30, FRAMES), len(BODY25))


def lifted(detections: Detections, smooth: str, up: np.ndarray | None = None) -> Lifted:
    lift = partial(lift_recording, detections, BODY25, LIFTER, intrinsics=CAMERA)
    return lift(over_time=OverTime(smooth, up)).lifted


def image_error(detections: Detections, result: Lifted) -> float:
    """Return the mean distance, in pixels, of lifted points from the keypoints they come from."""
    names = LIFTER.model.layout.keypoints
    at = [BODY25.index(name) for name in names]
    S = result.shapes
    pixels = np.stack((S[..., 0] / S[..., 2], S[..., 1] / S[..., 2]), -1) * FOCAL
    pixels += np.array(IMAGE) / 2
    shown = detections.confidence[:, at] > 0
    return float(np.linalg.norm(pixels - detections.points[:, at], axis=2)[shown].mean())


def jitter(result: Lifted) -> float:
    """Return the second differences of the rotations and the depths, over what is known."""
    S = result.shapes - result.shapes.mean(1, keepdims=True)
    return float(np.abs(np.diff(S[..., 2], 2, axis=0)).mean())


@pytest.mark.parametrize("smooth", [CAUSAL, BOTH])
def test_there_is_no_lag_in_the_image_and_less_jitter(smooth: str) -> None:
    detections = walk(noise=3.0)
    alone, over_time = lifted(detections, NONE), lifted(detections, smooth)
    assert image_error(detections, over_time) < 1.15 * image_error(detections, alone)
    assert jitter(over_time) < 0.95 * jitter(alone)


def test_each_identity_has_a_past_of_its_own() -> None:
    """A person beside another one comes out as alone, also if their order changes."""
    single, pair = walk(), walk(people=2)
    order = np.arange(len(pair)).reshape(-1, 2)
    order[::3] = order[::3, ::-1]
    exchanged = dataclasses.replace(pair, points=pair.points[order.ravel()])
    alone, both = lifted(single, CAUSAL), lifted(exchanged, CAUSAL)
    left = np.argmin(exchanged.points[:, 1, 0].reshape(-1, 2), 1) + 2 * np.arange(FRAMES)
    np.testing.assert_allclose(both.shapes[left], alone.shapes, atol=1e-5)


def test_unrelated_images_are_lifted_each_by_itself() -> None:
    detections = walk()
    rng = np.random.default_rng(1)
    size = rng.uniform(0.5, 2, (FRAMES, 1, 1))
    points = (detections.points - [640, 360]) * size + [640, 360]
    points[:, :, 0] += rng.uniform(-300, 300, (FRAMES, 1))
    order = rng.permutation(FRAMES)
    images = dataclasses.replace(detections, points=points[order].astype(np.float32))
    for over_time, alone in zip(lifted(images, CAUSAL), lifted(images, NONE), strict=True):
        np.testing.assert_array_equal(over_time, alone)


def test_looking_ahead_knows_the_bones_from_the_first_frame() -> None:
    detections = walk(noise=2.0)
    causal, both = lifted(detections, CAUSAL), lifted(detections, BOTH)
    alone = lifted(detections, NONE)
    np.testing.assert_allclose(causal.shapes[0], alone.shapes[0], atol=1e-5)
    assert np.abs(both.shapes[0] - alone.shapes[0]).max() > 1e-3
    determinants = np.linalg.det(both.rotations)
    np.testing.assert_allclose(determinants, 1, atol=1e-5)


@pytest.mark.parametrize("smooth", [NONE, CAUSAL, BOTH])
def test_a_wrong_keypoint_is_named_in_its_frame(smooth: str) -> None:
    detections = walk()
    detections.points[5, BODY25.index("left_wrist")] += 3 * detections.points[5].std(0).max()
    frames, keypoints = np.nonzero(lifted(detections, smooth).wrong)
    names = [LIFTER.model.layout.keypoints[i] for i in keypoints]
    assert (frames.tolist(), names) == ([5], ["left_wrist"])


def test_gravity_sets_a_person_upright() -> None:
    detections, up = walk(), np.array([0.0, -1, 0])
    layout = LIFTER.model.layout
    ends = [layout.index("neck"), layout.index("left_ankle"), layout.index("right_ankle")]

    def lean(result: Lifted) -> float:
        neck, left, right = result.shapes[:, ends].swapaxes(0, 1)
        v = neck - (left + right) / 2
        return float(np.degrees(np.arccos(v @ up / np.linalg.norm(v, axis=1))).mean())

    for smooth in (NONE, CAUSAL):
        assert lean(lifted(detections, smooth, up)) < 0.85 * lean(lifted(detections, smooth))


def test_nobody_is_lifted_without_an_error() -> None:
    nobody = walk()[np.zeros(FRAMES, bool)]
    for smooth in (CAUSAL, BOTH, NONE):
        assert len(lifted(nobody, smooth, np.array([0.0, -1, 0])).shapes) == 0


def test_an_object_that_cannot_be_lifted_is_no_memory() -> None:
    detections = walk()
    confidence = detections.confidence.copy()
    confidence[10:12, 3:] = 0
    gaps = dataclasses.replace(detections, confidence=confidence)
    result = lifted(gaps, CAUSAL)
    assert np.isnan(result.shapes[10:12]).all() and np.isfinite(result.shapes[12:]).all()
