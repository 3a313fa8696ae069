# SPDX-License-Identifier: Apache-2.0
"""The steadiness table: known motions give known figures."""

from __future__ import annotations

import csv
import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.robustness import smoothing
from benchmarks.robustness.smoothing import Clip
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.nrsfm.geometry import centre, rotation_from_vector

RATE = 50.0


def turning(degrees: float, frames: int = 100) -> Lifted:
    """Return an object of RMS radius 1 that turns about z by so much a frame."""
    rng = np.random.default_rng(0)
    S = centre(rng.standard_normal((17, 3)))
    S /= np.sqrt((S * S).sum(1).mean())
    R = np.array([rotation_from_vector(np.radians([0, 0, degrees * i])) for i in range(frames)])
    ones = np.ones(frames)
    parts = (S @ R.swapaxes(1, 2), R, ones, np.zeros((frames, 2)), ones, np.ones((frames, 17)))
    numbers = (part.astype(np.float32) for part in parts)
    return Lifted._make((*numbers, np.zeros((frames, 17), np.bool_)))


def test_from_end_to_end(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(smoothing, "CACHE", tmp_path)
    monkeypatch.setattr(smoothing, "STILL_FRAMES", 9)
    monkeypatch.setattr(smoothing, "_LAGS", np.array([0.0, 0.01]))
    smoothing.main(["--data", str(data), "--output", str(tmp_path)])
    rows = list(csv.DictReader((tmp_path / "smoothing.csv").open()))
    assert len(rows) == 14
    held = {row["filter"]: row for row in rows if "held" in row["clip"]}
    assert float(held["on"]["rotation deg"]) < float(held["off"]["rotation deg"])


def test_a_steady_turn_does_not_shake() -> None:
    lifted = turning(2.0)
    clip = Clip(lifted.translation, lifted.confidence, RATE, noisy=False)
    found = smoothing.figures(lifted, lifted, clip)
    assert found["rotation deg"] == pytest.approx(2, abs=1e-2)
    assert 1 < found["points %"] < 100 * np.radians(2)
    assert found["acceleration %"] < 0.2 and found["lag ms"] == 0


def test_a_delay_is_the_lag() -> None:
    lifted = turning(2.0)
    late = lifted.shapes[:-3]
    assert smoothing.lag(lifted.shapes[3:], late, RATE) == pytest.approx(3 / RATE)


def test_only_the_largest_person_of_a_video_is_followed(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    small, large = (size * rng.random((25, 3)) for size in (1, 10))
    small[:, 2] = large[:, 2] = 0.9
    crowd = [{"pose_keypoints_2d": p.ravel().tolist()} for p in (small, large)]
    with gzip.open(tmp_path / "video.jsonl.gz", "wt") as file:
        for people in (crowd, [], crowd[::-1]):
            file.write(json.dumps({"people": people}) + "\n")
    clip = smoothing.video_clip(tmp_path / "video.jsonl.gz")
    assert clip.points.shape == (2, 25, 2)
    np.testing.assert_array_equal(*clip.points)
    assert np.ptp(clip.points[0]) > 5
