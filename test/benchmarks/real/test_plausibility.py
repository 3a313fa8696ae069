# SPDX-License-Identifier: Apache-2.0
"""The figures tell a person from its mirror image and from a flat one."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from benchmarks.real import plausibility
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.nrsfm.geometry import random_cameras, rotation_from_camera

POSE = {  # x front, y left, z up
    "shoulder": (0.0, 0.2, 1.4), "elbow": (-0.1, 0.25, 1.1), "wrist": (0.1, 0.25, 0.9),
    "hip": (0.0, 0.12, 0.9), "knee": (0.2, 0.12, 0.5), "ankle": (0.0, 0.12, 0.1),
    "big_toe": (0.2, 0.15, 0.0),
}  # fmt: skip
MIDDLE = {"neck": (0.0, 0.0, 1.45), "mid_hip": (0.0, 0.0, 0.9), "nose": (0.15, 0.0, 1.6)}


def keypoint(name: str) -> np.ndarray:
    side, _, part = name.partition("_")
    if side not in plausibility.SIDES:
        return np.array(MIDDLE[name])
    return np.array(POSE[part]) * ([1, 1, 1] if side == "left" else [1, -1, 1])


@pytest.fixture
def people() -> np.ndarray:
    """Return (50, 17, 3) of one person seen from everywhere."""
    body = np.stack([keypoint(name) for name in HUMAN17.keypoints])
    turns = rotation_from_camera(random_cameras(50, np.random.default_rng(0)))
    return body @ turns.swapaxes(1, 2)


SEEN = np.ones((50, len(HUMAN17)), bool)


def test_a_person_is_the_right_way_round_and_steady(people: np.ndarray) -> None:
    found = plausibility.figures(people, SEEN)
    assert (found["faces %"], found["knees %"], found["toes %"]) == (100, 100, 100)
    assert found["bones %"] < 1e-3
    assert 30 < found["depth %"] < 80


def test_a_mirrored_person_is_the_wrong_way_round(people: np.ndarray) -> None:
    found = plausibility.figures(people * [1, 1, -1], SEEN)
    assert (found["faces %"], found["knees %"], found["toes %"]) == (0, 0, 0)


def test_a_flat_person_is_unsteady(people: np.ndarray) -> None:
    found = plausibility.figures(people * [1, 1, 0], SEEN)
    assert found["depth %"] == 0 and found["bones %"] > 10


def test_what_was_not_seen_does_not_count(people: np.ndarray) -> None:
    seen = SEEN.copy()
    seen[:, [HUMAN17.index(f"{side}_ankle") for side in plausibility.SIDES]] = False
    people[:, HUMAN17.index("left_ankle")] *= np.linspace(1, 3, 50)[:, None]
    found = plausibility.figures(people, seen)
    assert np.isnan(found["knees %"]) and np.isnan(found["toes %"])
    assert found["faces %"] == 100


def test_it_draws_each_frame_from_three_sides(people: np.ndarray) -> None:
    figure = Figure()
    dataset = Dataset(people[..., :2].astype(np.float32), SEEN, HUMAN17, "made up")
    plausibility.draw(figure, dataset, {"one": people, "other": people}, [0, 7])
    assert len(figure.axes) == 2 * (1 + 2 * 3)
    assert all(len(axis.lines) == len(HUMAN17.edges) for axis in figure.axes)
