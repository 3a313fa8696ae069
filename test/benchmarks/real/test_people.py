# SPDX-License-Identifier: Apache-2.0
"""The figures of people over time on cases whose answer is known, and the program on tiny data."""

from __future__ import annotations

import csv
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.data import people_scenes
from benchmarks.data.people_scenes import Track, displaced, filmed, lightly_noisy, noisy
from benchmarks.real import people
from benchmarks.real.mediapipe_comparison import mean_person
from deep_nrsfm_ros.data.pose2sim import JOINTS
from deep_nrsfm_ros.layouts.presets import BODY25, HUMAN17

LIMBS = [HUMAN17.index(joint) for joint in JOINTS]


@pytest.fixture
def track(walking: Any) -> Track:
    """Return a person who walks, as a camera sees it, without noise."""
    return filmed(walking(90), 120.0, 0)


@pytest.fixture
def walking() -> Any:
    """Return f frames (f, 17, 3) of a figure, m, y up, that swings its limbs."""
    rng = np.random.default_rng(0)
    rest, swing = rng.normal(0, 0.4, (17, 3)), rng.normal(0, 0.2, (17, 3))

    def motion(frames: int) -> np.ndarray:
        return rest + [0, 1, 0] + swing * np.sin(np.arange(frames) / 6)[:, None, None]

    return motion


def test_the_truth_projects_to_the_keypoints(track: Track) -> None:
    X = track.truth / track.truth[..., 2:]
    assert np.allclose(track.intrinsics.pixels(X[..., :2]), track.points[:, LIMBS], atol=1e-6)
    assert track.up[1] < -0.9  # the image's y points down


def test_a_perfect_system_has_no_error(track: Track) -> None:
    unit = track.reference_length
    row = people.figures([("one", people.shape_errors(track, track.truth / unit, 1.0))])
    assert row.pop("frames") == 90
    assert row.pop("lag ms") == pytest.approx(0, abs=3)
    assert row.pop("image lag ms") == pytest.approx(0, abs=3)
    assert {name: abs(value) < 1e-3 for name, value in row.items()} == dict.fromkeys(row, True)
    assert "missing mm" not in row


def test_pitch_is_positive_where_the_head_is_too_far_away(track: Track) -> None:
    tilt = Rotation.from_euler("x", -10, degrees=True).as_matrix()
    above = np.array([0, -1.0, 0]) @ tilt.T
    assert above[2] > 0
    row = people.figures([("one", people.shape_errors(track, track.truth @ tilt.T, None))])
    assert row["pitch deg"] == pytest.approx(10)
    assert row["rotation deg"] == pytest.approx(10)
    assert row["PA mm"] == pytest.approx(0, abs=1e-6)
    assert "place mm" not in row


def test_lag_is_the_delay_in_all_axes_and_in_the_image(track: Track) -> None:
    late = np.concatenate([track.truth[:1], track.truth[:1], track.truth[:-2]])
    row = people.figures([("one", people.shape_errors(track, late, None))])
    assert row["lag ms"] == pytest.approx(2000 / people_scenes.CMU_RATE, abs=3)
    in_depth = track.truth.copy()
    in_depth[..., 2] = late[..., 2]
    row = people.figures([("one", people.shape_errors(track, in_depth, None))])
    assert row["image lag ms"] == pytest.approx(0, abs=3)
    assert row["lag ms"] > 10


def test_noise_hides_and_moves_keypoints(walking: Any) -> None:
    exact = filmed(walking(3000), 0.0, 1)
    track = noisy(exact, 2)
    shown = track.confidence > 0
    limbs = shown[:, LIMBS]
    assert 1 - limbs.mean() == pytest.approx(people_scenes.DROPOUTS, rel=0.3)
    ends = (~limbs[:-1] & limbs[1:]).sum() / (~limbs).sum()
    assert 1 / (ends * people_scenes.CMU_RATE) == pytest.approx(people_scenes.DROPOUT_TIME, rel=0.3)
    size = np.sqrt(np.square(exact.points - exact.points.mean(1, keepdims=True)).sum(2).mean(1))
    error = ((track.points - exact.points) / size[:, None, None])[:, LIMBS][limbs]
    assert np.sqrt(np.median(error**2) / 0.455) == pytest.approx(people_scenes.NOISE, rel=0.1)
    neck, shoulders = HUMAN17.index("neck"), [HUMAN17.index("left_shoulder")]
    assert (shown[:, neck] <= shown[:, shoulders[0]]).all()


def test_displaced_keypoints_are_a_share_and_stay_for_a_while(walking: Any) -> None:
    exact = filmed(walking(3000), 0.0, 1)
    moved = displaced(exact, 0.05, 2)
    apart = np.linalg.norm(moved.points - exact.points, axis=2) > 0
    assert apart.mean() == pytest.approx(0.05, rel=0.2)
    lasting = apart[1:] & apart[:-1]
    offset = moved.points - exact.points
    size = np.sqrt(np.square(exact.points - exact.points.mean(1, keepdims=True)).sum(2).mean(1))
    relative = offset / size[:, None, None]
    np.testing.assert_allclose(relative[1:][lasting], relative[:-1][lasting])
    assert relative[apart].std() == pytest.approx(people_scenes.GROSS, rel=0.1)


def test_light_noise_is_new_in_each_frame(walking: Any) -> None:
    exact = filmed(walking(3000), 0.0, 1)
    track = lightly_noisy(exact, 2)
    shown = (track.confidence > 0)[:, LIMBS]
    assert 1 - shown.mean() == pytest.approx(people_scenes.LIGHT_DROPOUTS, rel=0.3)
    size = np.sqrt(np.square(exact.points - exact.points.mean(1, keepdims=True)).sum(2).mean(1))
    error = ((track.points - exact.points) / size[:, None, None])[:, LIMBS]
    assert error[shown].std() == pytest.approx(people_scenes.LIGHT_NOISE, rel=0.1)
    both = shown[1:] & shown[:-1]
    assert abs(np.corrcoef(error[1:][both].ravel(), error[:-1][both].ravel())[0, 1]) < 0.05


def write_shelf(folder: Path, motion: np.ndarray) -> None:
    """Write a scene of one person before two cameras, in the layout BODY25."""
    folder.mkdir(parents=True)
    f, places = len(motion), [BODY25.index(name) for name in HUMAN17.keypoints]
    world = np.full((f, 1, 25, 3), np.nan)
    world[:, 0, places] = motion @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up
    views = []
    for turn in (0, 90):
        R = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        R = R @ Rotation.from_euler("z", turn, degrees=True).as_matrix()
        views.append((R, -R @ world[0, 0, places].mean(0) + [0, 0, 5]))
    K = np.array([[900.0, 0, 500], [0, 900, 400], [0, 0, 1]])
    points = np.stack([((X := world[:, 0] @ R.T + t) / X[..., 2:]) @ K.T for R, t in views], 1)[
        :, :, None, :, :2
    ]
    np.savez(
        folder / "shelf_dev.npz",
        points=points,
        confidence=np.isfinite(points[..., 0]) * 0.8,
        truth=world,
        K=np.stack([K, K]),
        dist=np.zeros((2, 5)),
        R=np.stack([R for R, _ in views]),
        t=np.stack([t for _, t in views]),
    )


def test_the_program_prints_a_row_for_each_system(
    tmp_path: Path,
    data: Path,
    walking: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    (folder / "cmu").symlink_to(data / "cmu")
    data = folder
    write_shelf(data / "scenes" / "shelf", walking(40))
    np_mpii = {"points": np.random.default_rng(0).normal(0, 90, (4, 16, 2)) + 300}
    (data / "scenes" / "people_mpii").mkdir()
    np.savez(
        data / "scenes" / "people_mpii" / "people_mpii.npz",
        points=np_mpii["points"],
        points_annotated=np_mpii["points"],
        missing=np.zeros((4, 16), bool),
    )
    monkeypatch.setattr(people, "mean_person", partial(mean_person, subjects=("01",), stride=1))
    monkeypatch.setattr(people_scenes, "HELD_OUT", ("01",))
    monkeypatch.setattr(people_scenes, "CMU_STRIDE", 1)

    def no_clip(output: Path) -> None:
        raise ValueError("no clip here")

    monkeypatch.setattr(people_scenes, "scenes", no_clip)
    chosen = ("frame by frame", "in time, gravity")
    out = tmp_path / "out"
    words = ("--data", str(data), "--output", str(out), "--focal-error", "0.5", "--systems")
    people.main([*words, *chosen])
    printed = capsys.readouterr().out
    assert "no rows of the pose2sim clip: no clip here" in printed
    rows = list(csv.DictReader((tmp_path / "out" / "people.csv").open()))
    systems = {(row["scene"], row["system"], row["intrinsics"]) for row in rows}
    names = ("shelf_dev", "CMU 03, 131", "CMU 03, 131, light noise", "CMU 03, 131, still")
    known = ("yes", "0.5", "no")
    assert systems == {
        *((scene, system, i) for scene in names for system in chosen for i in known),
        *((scene, "mean shape", "") for scene in names),
    }
    assert all(float(row["PA mm"]) > 0 for row in rows)
    place = {(r["scene"], r["system"], r["intrinsics"]): r["place mm"] for r in rows}
    for scene in names:  # half as far away, so half of 5 m off
        true, rough = (float(place[scene, chosen[0], known]) for known in ("yes", "0.5"))
        assert rough > true + 500
    seen = list(csv.DictReader((tmp_path / "out" / "people_without_truth.csv").open()))
    assert [row["scene"] for row in seen] == ["MPII, detector", "MPII, annotated"]
    assert (tmp_path / "out" / "people_MPII_detector.png").stat().st_size > 1000
