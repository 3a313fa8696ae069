# SPDX-License-Identifier: Apache-2.0
"""Whether NRSfM can work is told from 2D alone, with the figure and the mend."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.sufficiency import assess_sufficiency
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras

P = 14


def dataset(points: np.ndarray, visible: np.ndarray | None = None) -> Dataset:
    f, p = points.shape[:2]
    seen = np.ones((f, p), bool) if visible is None else visible
    return Dataset(points.astype(np.float32), seen, KeypointLayout.numbered(p), "made up")


def shapes(f: int, deformation: float, seed: int = 0) -> np.ndarray:
    """Return (f, P, 3) shapes that deform along two modes."""
    rng = np.random.default_rng(seed)
    modes = np.einsum("fk,kpd->fpd", rng.standard_normal((f, 2)), rng.standard_normal((2, P, 3)))
    return centre(rng.standard_normal((P, 3)) + deformation * modes)


def seen_from(S: np.ndarray, degrees: float, seed: int = 1) -> np.ndarray:
    """Return what cameras see that turn about the vertical by up to +- `degrees`."""
    a = np.radians(degrees) * np.random.default_rng(seed).uniform(-1, 1, len(S))
    M = np.zeros((len(S), 3, 2))
    M[:, 0, 0], M[:, 2, 0], M[:, 1, 1] = np.cos(a), np.sin(a), 1
    return S @ M


def noisy(W: np.ndarray, share: float, seed: int = 2) -> np.ndarray:
    size = np.sqrt((W * W).sum(2).mean())
    return W + share * size * np.random.default_rng(seed).standard_normal(W.shape)


def test_a_deforming_object_from_all_sides_is_fine() -> None:
    S = shapes(400, 0.3)
    found = assess_sufficiency(dataset(S @ random_cameras(400, np.random.default_rng(0))))
    assert found.refusal == "" and found.warnings == ()
    assert found.view_span > 90 and 0.1 < found.deformation < 0.9
    assert len(found.spectrum) == found.keypoints == P and found.frames == 400
    assert np.linalg.norm(found.spectrum) == pytest.approx(1)
    assert "degrees" in found.summary


@pytest.mark.parametrize("degrees", [25.0, 50.0])
def test_view_span_of_a_rigid_object_is_that_of_the_cameras(degrees: float) -> None:
    found = assess_sufficiency(dataset(noisy(seen_from(shapes(500, 0.0), degrees), 0.01)))
    assert found.refusal == ""
    assert found.view_span == pytest.approx(0.9 * degrees, abs=4)


def flat() -> np.ndarray:
    S = shapes(400, 0.0)
    S[..., 2] = 0
    return S @ random_cameras(400, np.random.default_rng(0))


def turning_in_the_image() -> np.ndarray:
    a = np.random.default_rng(0).uniform(0, 6, 400)
    turn = np.stack([np.cos(a), -np.sin(a), np.sin(a), np.cos(a)], 1).reshape(-1, 2, 2)
    return shapes(400, 0.0)[..., :2] @ turn


def on_a_line() -> np.ndarray:
    S = shapes(400, 0.5)
    return S[..., :1] * np.random.default_rng(0).standard_normal((400, 1, 2))


HOPELESS = {
    "one frame": (lambda: seen_from(shapes(1, 0.3), 90), "1 of 1 frames.*at least 10"),
    "a few frames": (lambda: seen_from(shapes(9, 0.3), 90), "9 of 9 frames.*at least 10"),
    "a still view": (lambda: seen_from(shapes(400, 0.0), 0), "views are flat.*move the camera"),
    "a flat object": (flat, "views are flat.*flat object"),
    "turns within the image": (turning_in_the_image, "views are flat"),
    "three points": (lambda: seen_from(shapes(400, 0.3), 90)[:, :3], "only 3 keypoints"),
    "chance": (
        lambda: np.random.default_rng(0).standard_normal((400, P, 2)),
        "no shape in common.*layout",
    ),
}


@pytest.mark.parametrize(("make", "complaint"), HOPELESS.values(), ids=HOPELESS)
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_what_cannot_work_is_refused_with_the_mend(
    make: Callable[[], np.ndarray], complaint: str, noise: float
) -> None:
    assert re.search(complaint, assess_sufficiency(dataset(noisy(make(), noise))).refusal)


def test_points_on_a_line_are_refused() -> None:
    found = assess_sufficiency(dataset(on_a_line()))
    assert "in 400 of 400 frames all keypoints lie on one line" in found.refusal


def test_keypoints_that_are_never_seen_do_not_count() -> None:
    visible = np.zeros((400, P), bool)
    visible[:, [0, 5, 9]] = True
    found = assess_sufficiency(dataset(seen_from(shapes(400, 0.3), 90), visible))
    assert "only 3 keypoints are visible (point_0, point_5, point_9)" in found.refusal


DOUBTFUL = {
    "few frames": (60, 0.3, 90, "60 frames are few"),
    "one side": (400, 0.01, 8, "views span only . degrees"),
    "a rigid object": (400, 0.0, 90, "hardly deforms"),
}


@pytest.mark.parametrize(("f", "deformation", "degrees", "doubt"), DOUBTFUL.values(), ids=DOUBTFUL)
def test_what_is_doubtful_is_warned_of(
    f: int, deformation: float, degrees: float, doubt: str
) -> None:
    found = assess_sufficiency(dataset(seen_from(shapes(f, deformation), degrees)))
    assert found.refusal == ""
    assert any(re.search(doubt, warning) for warning in found.warnings), found.warnings


def test_missing_points_do_not_look_like_variation() -> None:
    S, rng = shapes(500, 0.0), np.random.default_rng(4)
    visible = rng.random((500, P)) < 0.7
    W = seen_from(S, 40)
    whole, holes = (
        assess_sufficiency(dataset(np.where(v[..., None], W, 0), v))
        for v in (np.ones_like(visible), visible)
    )
    assert holes.refusal == ""
    assert holes.view_span == pytest.approx(whole.view_span, abs=6)
    assert holes.deformation < 0.1


def test_an_empty_dataset_is_refused() -> None:
    nothing = assess_sufficiency(dataset(np.zeros((0, P, 2))))
    assert "only 0 keypoints are visible (none)" in nothing.refusal


@settings(max_examples=25, deadline=None)
@given(scale=st.floats(1e-3, 1e3), x=st.floats(-1e3, 1e3), y=st.floats(-1e3, 1e3))
def test_unit_and_place_do_not_matter(scale: float, x: float, y: float) -> None:
    W = seen_from(shapes(50, 0.3), 60)
    before, after = (assess_sufficiency(dataset(X)) for X in (W, scale * (W + [x, y])))
    np.testing.assert_allclose(before.spectrum, after.spectrum, atol=2e-3)
    assert before.refusal == after.refusal


def test_a_start_is_not_recommended_to_a_training_that_has_one() -> None:
    narrow = dataset(noisy(seen_from(shapes(500, 0.0), 10.0), 0.01))
    (alone,) = (w for w in assess_sufficiency(narrow).warnings if "views" in w)
    (helped,) = (w for w in assess_sufficiency(narrow, has_start=True).warnings if "views" in w)
    assert "start from a model" in alone and "may come out mirrored" in alone
    assert "depth rests on the model that the training starts from" in helped
    assert "--from" not in helped


def test_few_frames_of_many_alike_say_so() -> None:
    few = dataset(seen_from(shapes(60, 0.3), 90))
    (said,) = assess_sufficiency(few, near_duplicates=292).warnings
    assert said.startswith("60 frames are few, as 292 more are near-duplicates; expect")
    assert "record thousands that differ" in said
    (said,) = assess_sufficiency(few, near_duplicates=2).warnings
    assert said.startswith("60 frames are few; expect") and "that differ" not in said
