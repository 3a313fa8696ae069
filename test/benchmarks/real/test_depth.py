# SPDX-License-Identifier: Apache-2.0
"""The rendered depth of the benchmark: capsules, a wall, a board, noise and holes."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.data.people_scenes import Track, filmed
from benchmarks.real.depth import (
    HOLES,
    WALL,
    Case,
    Scene,
    capsule_depth,
    measured_depth,
    measured_range,
    noisy_depth,
    summary,
)
from test.fixtures.standing_person import standing_person


def person() -> Track:
    """Return ten frames of a person who stands before the camera."""
    front, left, up = standing_person().T
    motion = np.stack([left, up + 0.9, front], -1)
    return filmed(np.repeat(motion[None], 10, 0), 0.0, 0)


def scene(track: Track, case: Case) -> Scene:
    return Scene(track, 1.0, case, np.random.default_rng(0))


def test_rays_enter_a_capsule_at_its_side_and_at_its_ends() -> None:
    start, end = np.array([[[-1.0, 0, 4]]]), np.array([[[1.0, 0, 4]]])
    d = np.array([[[0.0, 0, 1], [0.2, 0, 1], [0, 0.1, 1], [0.32, 0, 1], [0.1, 0, -1]]])
    depth = capsule_depth(d, start, end, 0.5)[0]
    assert depth[:2] == pytest.approx([3.5, 3.5])  # the side is parallel to the image
    assert 3.5 < depth[2] < 4
    x, _, z = depth[3] * d[0, 3]
    assert np.hypot(x - 1, z - 4) == pytest.approx(0.5) and x > 1
    assert np.isnan(depth[4])
    assert np.isnan(capsule_depth(np.array([[[0.0, 0.2, 1]]]), start, end, 0.5)).all()
    along = capsule_depth(np.array([[[0.0, 0, 1]]]), np.array([[[0, 0, 3.0]]]), 2 * start, 0.5)
    assert along[0, 0] == pytest.approx(2.5)


def test_the_surface_is_before_the_joints_and_the_wall_behind() -> None:
    track = person()
    rays = track.truth[..., :2] / track.truth[..., 2:]
    inside = track.truth[..., 2] / 1000 - scene(track, Case()).depth(rays)
    assert (inside > 0.02).all() and (inside < 0.3).all()
    wall = scene(track, Case()).depth(np.full((10, 1, 2), 5.0))
    assert wall == pytest.approx(track.truth[..., 2].mean() / 1000 + WALL)


def test_a_board_hides_the_legs_from_its_second_on() -> None:
    track = person()
    rays = track.truth[..., :2] / track.truth[..., 2:]
    gap = track.truth[..., 2] / 1000 - scene(track, Case(hidden=0.5, since=0.15)).depth(rays)
    assert (gap[:, -4:].min(1) > 0.6).tolist() == (track.seconds >= 0.15).tolist()
    assert (gap[:, :2] < 0.3).all()  # shoulders


def test_noise_grows_with_the_depth_and_leaves_holes() -> None:
    rng = np.random.default_rng(0)
    near, far = (noisy_depth(np.full((400, 12, 25), z), rng) for z in (2.0, 4.0))
    assert np.nanstd(far) == pytest.approx(4 * np.nanstd(near), rel=0.1)
    assert np.isnan(near).mean() == pytest.approx(HOLES + 0.05, abs=0.02)


def test_the_sensors_measure_the_person() -> None:
    track, rng = person(), np.random.default_rng(0)
    pixels = track.intrinsics.pixels(track.truth[..., :2] / track.truth[..., 2:])
    pixels[3, 2] = np.nan
    for sensor in ("image", "cloud"):
        case = Case(sensor, delay=2)
        measured = measured_depth(scene(track, case), track, pixels, case, rng)
        assert np.isnan(measured[:2]).all() and np.isnan(measured[3, 2])
        inside = (track.truth[..., 2] / 1000 - measured)[2:]
        assert 0 < np.nanmedian(inside) < 0.2 and np.isfinite(inside).mean() > 0.4
    distance = measured_range(scene(track, Case()), track, rng)
    assert distance == pytest.approx(track.truth[..., 2].mean() / 1000 - 0.12, abs=0.15)


def test_figures_are_medians_means_and_shares() -> None:
    values = np.array([0.0, 0.0, 1.0, 3.0])
    assert summary({"place mm": values, "agree": values, "found %": values > 0}) == {
        "place mm": 0.5,
        "agree": 1.0,
        "found %": 50.0,
    }
    assert summary({"false %": np.zeros(0)}) == {}
