# SPDX-License-Identifier: Apache-2.0
"""Curation finds what was spoiled on purpose, keeps what is sound, and counts all of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.data.curation import KEEP_ALL, Curation, changed_frames, curate, spread_out
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.wording import in_python

P = 12
LAYOUT = KeypointLayout.numbered(P)
ONLY_OUTLIERS = Curation(min_visible=0, min_change=0.0)
ONLY_THIN = Curation(min_visible=0, outlier_threshold=0.0)

some = settings(max_examples=25, deadline=None)


def dataset(f: int = 800, seed: int = 0, noise: float = 0.01) -> Dataset:
    """Return what random cameras see of an object with two modes, in pixels."""
    rng = np.random.default_rng(seed)
    basis = rng.standard_normal((3, P, 3)) * np.array([1, 0.3, 0.3])[:, None, None]
    weights = np.column_stack([np.ones(f), rng.standard_normal((f, 2))])
    shapes = centre(np.einsum("fk,kpd->fpd", weights, basis)).astype(np.float32)
    W = shapes @ random_cameras(f, rng)
    W += noise * rng.standard_normal(W.shape)
    points = (320 + 90 * W).astype(np.float32)
    return Dataset(points, np.ones((f, P), bool), LAYOUT, "made up", shapes)


def spoiled(sound: Dataset, frames: np.ndarray, keypoint: int) -> Dataset:
    """Return the dataset with one keypoint far off in the chosen frames."""
    points = sound.points.copy()
    points[frames, keypoint] += [400, -300]
    return dataclasses.replace(sound, points=points)


def test_what_is_off_is_as_it_is() -> None:
    given_ = dataset(50)
    left = curate(given_, KEEP_ALL)
    np.testing.assert_array_equal(left.dataset.points, given_.points)
    np.testing.assert_array_equal(left.dataset.visible, given_.visible)
    np.testing.assert_array_equal(left.frames, np.arange(50))
    assert left.summary == "" and left.warnings == () and left.outlier_frames == ()


def test_frames_with_few_visible_points_are_left_out() -> None:
    whole = dataset(60)
    whole.visible[[3, 7], 2:] = False
    left = curate(whole, Curation(min_visible=3, min_change=0.0, outlier_threshold=0.0))
    assert left.few_visible == 2 and len(left.dataset) == 58
    assert not {3, 7} & set(left.frames.tolist())
    assert "of 60 frames, left out 2 with too few visible keypoints" in left.summary
    assert whole.shapes is not None
    np.testing.assert_array_equal(left.dataset.shapes, whole.shapes[left.frames])


def test_nothing_visible_is_an_error_that_names_the_mend() -> None:
    dark = dataclasses.replace(dataset(5), visible=np.zeros((5, P), bool))
    with pytest.raises(ValueError, match="none of the 5 frames shows 4 keypoints.*min-confidence"):
        curate(dark)


def test_options_are_checked() -> None:
    with pytest.raises(ValueError, match=r"min_change is 2"):
        curate(dataset(5), Curation(min_change=2.0))


@pytest.mark.parametrize("objects", [1, 2, 3])
def test_a_still_camera_on_still_objects_is_thinned(objects: int) -> None:
    rng = np.random.default_rng(1)
    poses = dataset(4 * objects)
    in_turn = np.repeat(poses.points.reshape(4, objects, P, 2), 50, axis=0)
    points: np.ndarray = in_turn.reshape(-1, P, 2)
    # It may come nearer, move across the image and jitter.
    size, place = rng.uniform(0.5, 2, (len(points), 1, 1)), rng.uniform(0, 300, (len(points), 1, 2))
    points = size * (points + 0.2 * rng.standard_normal(points.shape)) + place
    still = Dataset(points.astype(np.float32), np.ones(points.shape[:2], bool), LAYOUT, "still")
    left = curate(still, ONLY_THIN)
    assert len(left.dataset) == 4 * objects
    assert left.near_duplicates == len(still) - 4 * objects
    duplicates = f"{left.near_duplicates} near-duplicates"
    assert f"{duplicates} (--min-change 0, train.min_change 0: keep them)" in left.summary
    with in_python():
        assert duplicates in left.summary and "--min-change" not in left.summary


def test_different_frames_are_not_thinned() -> None:
    assert len(curate(dataset(100), ONLY_THIN).dataset) == 100


def test_a_frame_that_shows_more_is_not_a_duplicate() -> None:
    pose = np.repeat(dataset(1).points, 4, axis=0)
    visible = np.ones((4, P), bool)
    visible[:2, 0] = False
    visible[3, 1] = False
    assert changed_frames(pose, visible, 0.02).tolist() == [True, False, True, False]


@pytest.mark.parametrize("f", [300, 6000])
def test_jumps_are_hidden_and_hardly_anything_else(f: int) -> None:
    sound = dataset(f)
    frames = np.arange(0, f, 25)
    left = curate(spoiled(sound, frames, 4), ONLY_OUTLIERS)
    hidden = ~left.dataset.visible
    jumped = np.isin(left.frames, frames)
    assert hidden[jumped, 4].mean() > 0.9
    assert hidden[~jumped].mean() < 0.01
    assert left.hidden[4] == hidden[:, 4].sum() and left.hidden.sum() == hidden.sum()
    assert (left.dataset.points[hidden] == 0).all()
    assert f"hid {hidden.sum()} outlying keypoints in {left.corrected} frames" in left.summary
    assert left.total == f == len(left.dataset) + left.inconsistent


def test_the_worst_are_shown_as_they_were_given() -> None:
    bad = spoiled(dataset(400), np.array([17, 300]), 4)
    left = curate(bad, ONLY_OUTLIERS)
    assert {s.frame for s in left.outlier_frames[:2]} == {17, 300}
    first = left.outlier_frames[0]
    np.testing.assert_array_equal(first.points, bad.points[first.frame])
    assert first.outliers[4] and first.deviation > 6 and not first.dropped
    deviations = [s.deviation for s in left.outlier_frames]
    assert deviations == sorted(deviations, reverse=True)


def test_a_hopeless_frame_is_left_out() -> None:
    bad = dataset(400)
    rng = np.random.default_rng(5)
    bad.points[50, :6] = rng.uniform(-2000, 2000, (6, 2))
    left = curate(bad, ONLY_OUTLIERS)
    assert 50 not in left.frames and left.inconsistent >= 1
    assert any(s.frame == 50 and s.dropped for s in left.outlier_frames)
    assert "that contradict the rest" in left.summary


def test_a_keypoint_that_is_often_wrong_is_named() -> None:
    bad = spoiled(dataset(400), np.arange(0, 400, 8), 4)
    (warning,) = curate(bad, ONLY_OUTLIERS).warnings
    assert warning.startswith("point_4 was an outlier in ") and "swapped" in warning


def test_missing_points_do_not_disturb() -> None:
    sound = dataset(600)
    visible = np.random.default_rng(3).random((600, P)) < 0.8
    visible[:, -1] = False  # never seen at all
    frames = np.flatnonzero(visible[:, 4])[::20]
    bad = dataclasses.replace(spoiled(sound, frames, 4), visible=visible)
    bad.points[~visible] = 0
    left = curate(bad, ONLY_OUTLIERS)
    hidden = visible[left.frames] & ~left.dataset.visible
    assert hidden[np.isin(left.frames, frames), 4].mean() > 0.8
    assert hidden[~np.isin(left.frames, frames)].mean() < 0.01


@some
@given(
    scale=st.floats(0.01, 100),
    angle=st.floats(0, 6.3),
    shift=st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)),
)
def test_place_and_size_in_the_image_do_not_matter(
    scale: float, angle: float, shift: tuple[float, float]
) -> None:
    bad = spoiled(dataset(150), np.arange(0, 150, 30), 4)
    before = curate(bad)
    points = (bad.points - 320) * scale + np.array(shift)
    moved = curate(dataclasses.replace(bad, points=points.astype(np.float32)))
    np.testing.assert_array_equal(before.frames, moved.frames)
    np.testing.assert_array_equal(before.dataset.visible, moved.dataset.visible)


@some
@given(
    seed=st.integers(0, 1000),
    f=st.integers(1, 40),
    share=st.floats(0.3, 1),
    options=st.builds(
        Curation,
        min_visible=st.integers(0, 5),
        min_change=st.sampled_from([0.0, 0.02, 0.5]),
        outlier_threshold=st.sampled_from([0.0, 2.0, 6.0]),
    ),
)
def test_every_frame_is_accounted_for(seed: int, f: int, share: float, options: Curation) -> None:
    rng = np.random.default_rng(seed)
    visible = rng.random((f, P)) < share
    visible[0] = True
    points = np.where(visible[..., None], rng.standard_normal((f, P, 2)), 0).astype(np.float32)
    left = curate(Dataset(points, visible, LAYOUT, "noise"), options)
    out = left.few_visible + left.near_duplicates + left.inconsistent
    assert len(left.dataset) == len(left.frames) == f - out
    assert (np.diff(left.frames) > 0).all()
    assert not (left.dataset.visible & ~visible[left.frames]).any()
    assert (left.dataset.visible.sum(1) >= min(options.min_visible, P)).all()
    assert left.hidden.sum() == (visible[left.frames] & ~left.dataset.visible).sum()


def test_apart_skips_neighbours() -> None:
    frames = np.array([0, 1, 2, 50, 51, 90])
    assert spread_out(np.array([4, 3, 0, 1, 5]), frames, 10, 2) == [4, 0]
    assert spread_out(np.array([4, 3, 0, 1, 5]), frames, 10, 9) == [4, 0, 5]


@pytest.mark.parametrize("missing", [0, 0.02, 0.3])
def test_new_frames_at_once_are_those_that_are_found_one_by_one(missing: float) -> None:
    rng = np.random.default_rng(1)
    f = 150
    steps = 30 * rng.random((f, 1, 1)) ** 6  # some frames hardly move
    start = 100 * rng.standard_normal((P, 2))
    points = start + np.cumsum(steps * rng.standard_normal((f, P, 2)), 0)
    visible = rng.random((f, P)) >= missing

    def scaled(frame: int, shown: np.ndarray) -> np.ndarray:
        X = points[frame, shown] - points[frame, shown].mean(0)
        return X / np.sqrt((X**2).sum() / len(X))

    kept: list[int] = []
    for i in range(f):
        shown = visible[i]
        near = [
            np.square(scaled(i, shown) - scaled(k, shown)).sum() < 0.05**2 * shown.sum()
            for k in kept[-4:]
            if not (shown & ~visible[k]).any()
        ]
        if not any(near):
            kept.append(i)
    assert f / 10 < len(kept) < f
    found = changed_frames(points.astype(np.float32), visible, 0.05)
    assert np.flatnonzero(found).tolist() == kept


def test_progress_counts_to_one_total() -> None:
    still = dataset(10)[np.repeat(np.arange(10), 50)]
    counts: list[tuple[int, int]] = []
    curate(still, Curation(), lambda done, total: counts.append((done, total)))
    assert len(still) == 500 and counts == [(250, 500), (500, 500)]
