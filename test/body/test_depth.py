# SPDX-License-Identifier: Apache-2.0
"""Place and size of objects from measured depth."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.body.depth import (
    Agreement,
    DepthScale,
    RangeScale,
    believed_scales,
    fit_depth,
    surface_radii,
)
from deep_nrsfm_ros.body.mean_scale import RANGE
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from test.fixtures.standing_person import standing_person

NAN = float("nan")
RADII = surface_radii(HUMAN17, 0.5)
P = len(HUMAN17)
CONFIDENT = np.ones((1, P))


def person(distance: float = 4.0) -> np.ndarray:
    """Return points (1, 17, 3) of a person who faces the camera, in its axes."""
    front, left, up = standing_person().T
    return np.stack([left, -up, distance - front], -1)[None]


def depth(size: float, distance: float = 4.0) -> np.ndarray:
    """Return the measured depth (1, 17) of a person `size` times as large and as far away."""
    return np.asarray(size * (person(distance)[..., 2] - RADII))


def scale() -> DepthScale:
    return DepthScale(RADII, Agreement(0.15, 3))


@pytest.mark.parametrize("size", [0.6, 1.0, 1.4])
def test_a_person_of_any_size_is_put_where_the_depth_is(size: float) -> None:
    (found,), fit = scale()(("anna",), person(), CONFIDENT, depth(size), 0.0)
    assert found == pytest.approx(size)
    assert fit.agree.all() and fit.measured[0] == P
    assert not fit.occluded.any() and not fit.beside.any()


def test_the_surface_is_nearer_than_the_joint() -> None:
    deep = dict(zip(HUMAN17.keypoints, RADII, strict=True))
    assert deep["left_hip"] == deep["mid_hip"] > deep["right_wrist"] > deep["nose"] == 0
    np.testing.assert_allclose(surface_radii(HUMAN17, 0.25), RADII / 2)


def test_what_hides_a_keypoint_and_what_is_behind_the_person_have_no_vote() -> None:
    measured = depth(0.8)
    hidden = [HUMAN17.index(f"{side}_{part}") for side in ("left", "right") for part in ("knee",)]
    missed, hole = HUMAN17.index("left_wrist"), HUMAN17.index("right_wrist")
    measured[0, hidden], measured[0, missed], measured[0, hole] = 1.9, 6.0, NAN
    (found,), fit = scale()(("anna",), person(), CONFIDENT, measured, 0.0)
    assert found == pytest.approx(0.8)
    assert np.flatnonzero(fit.occluded).tolist() == hidden
    assert np.flatnonzero(fit.beside).tolist() == [missed]
    assert fit.agree.sum() == P - 4 and fit.measured[0] == P - 1


def test_a_person_is_not_put_on_the_wall_behind() -> None:
    """As where the depth is not registered: most keypoints have that of a wall."""
    measured = depth(1.0)
    measured[0, :12] = 5.6
    believed = believed_scales(HUMAN17, 0.5)
    (far,), _ = DepthScale(RADII, Agreement(0.2, 3))(("a",), person(), CONFIDENT, measured, 0.0)
    (found,), fit = DepthScale(RADII, Agreement(0.2, 3, believed))(
        ("a",), person(), CONFIDENT, measured, 0.0
    )
    assert far > 1.35
    assert found == pytest.approx(1.0)
    assert fit.beside[0, :12].all()


def test_people_have_a_largest_size_whatever_they_are_taken_to_be_and_other_objects_have_not() -> (
    None
):
    low, high = believed_scales(HUMAN17, 0.5)
    assert low < 0.5 < 1.2 < high < 1.35
    assert believed_scales(HUMAN17, 0.25) == pytest.approx((2 * low, 2 * high))
    machine = KeypointLayout("machine", tuple("abcd"))
    assert believed_scales(machine, 0.5) == RANGE


def test_a_keypoint_without_confidence_is_named_but_has_no_vote() -> None:
    measured, confidence = np.full((1, P), 1.9), np.zeros((1, P))
    confidence[0, :3] = 1
    measured[0, :3] = depth(0.8)[0, :3]
    (found,), fit = scale()(("anna",), person(), confidence, measured, 0.0)
    assert found == pytest.approx(0.8)
    assert fit.measured[0] == fit.agree.sum() == 3 and fit.occluded.sum() == P - 3


def test_most_of_a_known_person_may_be_hidden() -> None:
    measured = depth(1.0)
    measured[0, 7:] = 2.5  # a board in front of ten of seventeen
    (alone,), _ = scale()(("anna",), person(), CONFIDENT, measured, 0.0)
    assert alone < 0.8
    fits = scale()
    fits(("anna",), person(), CONFIDENT, depth(1.0), 0.0)
    (found,), fit = fits(("anna",), person(), CONFIDENT, measured, 0.1)
    assert found == pytest.approx(1.0) and fit.occluded.sum() == 10


def test_without_depth_a_person_keeps_the_size_found_before() -> None:
    fits, none = scale(), np.full((1, P), NAN)
    (found,), fit = fits(("anna",), person(), CONFIDENT, none, 0.0)
    assert np.isnan(found) and np.isnan(fit.scales).all() and fit.measured[0] == 0
    two = np.where(np.arange(P) < 2, depth(0.7), NAN)  # fewer than three say nothing
    assert np.isnan(fits(("anna",), person(), CONFIDENT, two, 0.1)[0][0])
    fits(("anna",), person(), CONFIDENT, depth(0.7), 0.2)
    (found,), fit = fits(("anna",), person(), CONFIDENT, none, 5.0)
    assert found == pytest.approx(0.7) and np.isnan(fit.scales).all()
    assert np.isnan(fits(("",), person(), CONFIDENT, none, 5.0)[0][0])


def test_objects_that_are_not_lifted_and_absurd_depths_change_nothing() -> None:
    shapes = np.concatenate([person(), np.full((1, P, 3), NAN), person()])
    measured = np.concatenate([depth(1.1), depth(1.1), np.full((1, P), 900.0)])
    names = ("anna", "bert", "cem")
    found, fit = scale()(names, shapes, np.ones((3, P)), measured, 0.0)
    np.testing.assert_allclose(found, [1.1, NAN, NAN])
    assert np.isfinite(fit.scales).tolist() == [True, False, False]


def test_no_object_is_no_problem() -> None:
    none = np.zeros((0, P))
    fit = fit_depth(none, none, none > 0, np.zeros(0), Agreement(0.15, 3))
    assert fit.scales.shape == (0,)


def beam() -> RangeScale:
    return RangeScale(RADII, [(a, b) for a, b in HUMAN17.edge_indices()])


def test_a_range_is_the_distance_of_the_trunk_on_the_axis() -> None:
    shape = person() - [0, 0.25, 0]  # the axis meets the trunk half way
    (found,), met = beam()(("anna",), shape, 0.9 * (4 - 0.08), 0.01, 0.0)
    assert met == 0 and found == pytest.approx(0.9, abs=0.01)


def test_a_range_is_that_of_the_first_person_in_the_beam() -> None:
    shapes = np.concatenate([person(6.0), person(4.0), person(3.0) + [1.0, 0, 0]])
    names, ranges = ("anna", "bert", "cem"), beam()
    found, met = ranges(names, shapes, 3.6, 0.02, 0.0)
    assert met == 1 and found[1] < 1 and np.isnan(found[[0, 2]]).all()
    found, met = ranges(names, shapes, NAN, 0.02, 0.1)
    assert met == -1 and found[1] < 1  # as before


def test_a_range_of_nobody_changes_nothing() -> None:
    for shapes in (person() + [1, 0, 0], np.full((1, P, 3), NAN), person() - [0, 0, 8.0]):
        found, met = beam()(("anna",), shapes, 3.0, 0.02, 0.0)
        assert met == -1 and np.isnan(found).all()
    assert beam()(("anna",), person(), 0.2, 0.02, 0.0)[1] == -1  # far too near
