# SPDX-License-Identifier: Apache-2.0
"""Virtual people: both sides alike, joints where they are drawn, poses kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deep_nrsfm_ros.data import virtual_people as module
from deep_nrsfm_ros.data.mocap import Motion, TrialSelection, human17
from deep_nrsfm_ros.data.virtual_people import read_virtual_people, virtual_people
from deep_nrsfm_ros.layouts.presets import CMU31, HUMAN17, HUMAN25, preset

F = 400


@pytest.fixture(scope="module")
def motion() -> Motion:
    """Return a person, the same on both sides, who stands with a bent left knee."""
    right = {
        "root": (0, 1, 0),
        "rhipjoint": (-0.1, 0.9, 0),
        "rfemur": (-0.2, 0.5, 0),
        "rtibia": (-0.2, 0.1, 0),
        "rfoot": (-0.2, 0, 0.1),
        "rtoes": (-0.2, 0, 0.2),
        "lowerback": (0, 1.1, 0),
        "upperback": (0, 1.2, 0),
        "thorax": (0, 1.3, 0),
        "lowerneck": (0, 1.4, 0),
        "upperneck": (0, 1.5, 0),
        "head": (0, 1.7, 0),
        "rclavicle": (-0.2, 1.4, 0),
        "rhumerus": (-0.4, 1.2, 0),
        "rradius": (-0.6, 1.1, 0),
        "rwrist": (-0.62, 1.1, 0),
    }
    joints = np.zeros((F, 31, 3))
    for name, place in right.items():
        joints[:, CMU31.index(name)] = place
        if name[0] == "r" and name != "root":
            joints[:, CMU31.index("l" + name[1:])] = place * np.array([-1, 1, 1])
    joints[:, CMU31.index("lfemur"), 2] = 0.2
    upright = np.eye(3, dtype=np.float32)
    return Motion(
        joints.astype(np.float32),
        np.tile(upright, (F, 1, 1)),
        np.tile(upright, (F, 2, 1, 1)),
    )


def joint(S: np.ndarray, name: str) -> np.ndarray:
    place: np.ndarray = S[:, HUMAN17.index(name)].astype(float)
    return place


def length(S: np.ndarray, a: str, b: str) -> np.ndarray:
    return np.asarray(np.linalg.norm(joint(S, a) - joint(S, b), axis=1))


def test_bodies_and_joints_are_drawn_in_their_ranges(motion: Motion) -> None:
    S = virtual_people(motion, HUMAN17, np.random.default_rng(0))
    plain = human17(motion)
    for bone in (("shoulder", "elbow"), ("elbow", "wrist"), ("knee", "ankle")):
        relative = [
            length(S, *(f"{side}_{joint}" for joint in bone))
            / length(plain, *(f"{side}_{joint}" for joint in bone))
            for side in ("left", "right")
        ]
        assert np.mean(relative) == pytest.approx(1, abs=0.08)
        assert 0.07 < np.std(relative[1]) < 0.15
    apart = length(S, "left_hip", "right_hip") / 0.2
    assert apart.min() > 0.9 * 0.75 and 1.1 < apart.mean() < 1.2 and 1.3 < apart.max() < 1.4 * 1.25
    narrow = length(S, "left_shoulder", "right_shoulder") / 0.4
    assert narrow.mean() == pytest.approx(np.mean(module.SHOULDERS_APART), abs=0.03)
    nose = joint(S, "nose") - joint(plain, "nose")
    assert nose.std(0)[1] > 0.03 and nose[:, 1].mean() > 0.05  # up to the top of the head
    for name, sides in HUMAN17.derived.items():
        np.testing.assert_allclose(
            joint(S, name), np.mean([joint(S, side) for side in sides], 0), atol=1e-6
        )


def test_both_sides_are_alike(motion: Motion) -> None:
    S = virtual_people(motion, HUMAN17, np.random.default_rng(0))
    mirror = np.array([-1, 1, 1])
    for part in ("shoulder", "elbow", "wrist", "hip", "big_toe"):
        # The left knee is bent: what hangs from it is elsewhere.
        if part != "big_toe":
            left, right = joint(S, f"left_{part}"), joint(S, f"right_{part}")
            np.testing.assert_allclose(left * mirror, right, atol=1e-5)
    bent = joint(S, "left_knee") - joint(S, "left_hip")
    assert (bent[:, 2] > 0.05).mean() > 0.99  # the pose stays


def test_a_dataset_of_them_is_before_cameras_of_their_own(
    motion: Motion, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "selected_trials", lambda selection: [Path("01/01_01.amc")] * 2)
    monkeypatch.setattr(module, "read_asf", lambda path: ())
    monkeypatch.setattr(module, "read_amc", lambda path, skeleton: motion)
    selection = TrialSelection(Path("cmu"), ("01",), "all", 20)
    people = read_virtual_people(selection, 30)
    assert len(people) == 30 and people.visible.all() and people.layout == HUMAN17
    assert people.shapes is not None
    np.testing.assert_allclose(people.points.mean(1), 0, atol=1e-5)
    for W, S in zip(people.points, people.shapes, strict=True):
        M = np.linalg.lstsq(S.astype(float), W, rcond=None)[0]
        np.testing.assert_allclose(S @ M, W, atol=1e-4)
        np.testing.assert_allclose(M.T @ M, np.eye(2), atol=1e-3)
    assert len(read_virtual_people(selection, 1000)) == 2 * F // 20
    again = read_virtual_people(selection, 30)
    np.testing.assert_array_equal(people.points, again.points)


def test_eyes_ears_heels_and_small_toes_are_added_to_the_same_people(motion: Motion) -> None:
    fewer = virtual_people(motion, HUMAN17, np.random.default_rng(0))
    S = virtual_people(motion, HUMAN25, np.random.default_rng(0))
    np.testing.assert_array_equal(S[:, :17], fewer)
    part = {name: S[:, i].astype(float) for i, name in enumerate(HUMAN25.keypoints)}
    for side, sign in (("left", 1), ("right", -1)):
        assert (sign * (part[f"{side}_ear"] - part["nose"])[:, 0] > 0.05).all()
        assert (sign * (part[f"{side}_eye"] - part["nose"])[:, 0] > 0.02).all()
        assert ((part[f"{side}_eye"] - part[f"{side}_ear"])[:, 2] > 0.03).all()
        out = sign * (part[f"{side}_small_toe"] - part[f"{side}_heel"])[:, 0]
        assert out.mean() == pytest.approx(0.065, abs=0.01)
        assert (part[f"{side}_heel"] - part[f"{side}_ankle"])[:, 1].mean() < -0.03


def test_other_layouts_have_no_virtual_people() -> None:
    with pytest.raises(ValueError, match="human25, not of coco_wholebody133"):
        read_virtual_people(TrialSelection(Path("cmu"), ("01",)), 3, preset("coco_wholebody133"))
