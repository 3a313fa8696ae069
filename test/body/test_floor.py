# SPDX-License-Identifier: Apache-2.0
"""Size and place of people who stand on a floor."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.body.floor import CLEARANCE, FloorScale, floor_factor, floor_scale

UP = np.array([0, -1.0, 0])
HEIGHT = 1.4


def person(size: float = 1.0, raised: float = 0.0) -> np.ndarray:
    """Return points (1, 4, 3) of a person 3 m before a level camera, as lifted at another size."""
    heights = np.array([CLEARANCE, CLEARANCE + 0.1, 0.9, 1.7]) + raised
    points = np.stack([0 * heights, HEIGHT - heights, 3 + 0 * heights], -1)
    return size * points[None]


@pytest.mark.parametrize("size", [0.6, 1.0, 1.5])
def test_a_person_of_any_size_is_put_on_the_floor(size: float) -> None:
    (scale,) = floor_scale(person(size), UP, HEIGHT)
    np.testing.assert_allclose(scale * person(size), person())


def test_what_cannot_be_a_person_on_the_floor_is_left() -> None:
    above = person() - [0, 3.0, 0]
    assert np.isnan(floor_scale(np.concatenate([above, person(9.0)]), UP, HEIGHT)).all()
    assert FloorScale(HEIGHT)(("a",), above, UP, 0.0) == 1


def test_a_jump_changes_the_size_little() -> None:
    floor = FloorScale(HEIGHT)
    for i in range(60):
        (scale,) = floor(("anna",), person(0.8), UP, i / 30)
    assert scale == pytest.approx(1.25)
    for i in range(60, 70):
        (scale,) = floor(("anna",), 0.8 * person(raised=0.5), UP, i / 30)
    assert scale == pytest.approx(1.25, rel=0.12)
    (alone,) = floor(("",), 0.8 * person(raised=0.5), UP, 70 / 30)
    assert alone > 1.8


def test_nan_changes_nothing() -> None:
    floor = FloorScale(HEIGHT)
    floor(("anna",), person(0.8), UP, 0.0)
    (scale,) = floor(("anna",), np.full((1, 4, 3), np.nan), UP, 0.1)
    assert scale == pytest.approx(1.25)


def test_a_size_that_does_not_exist_is_not_believed() -> None:
    giants, believed = person(0.5), (0.4, 1.3)
    assert FloorScale(HEIGHT)(("a",), giants, UP, 0.0) == pytest.approx(2)
    assert FloorScale(HEIGHT)(("a",), giants, UP, 0.0, believed) == 1
    assert floor_factor(giants, UP, HEIGHT) == pytest.approx(2)
    assert floor_factor(person(0.1), UP, HEIGHT) == pytest.approx(10)
    assert floor_factor(person() - [0, 3.0, 0], UP, HEIGHT) == np.inf
    assert np.isnan(floor_factor(np.full((1, 4, 3), np.nan), UP, HEIGHT))
