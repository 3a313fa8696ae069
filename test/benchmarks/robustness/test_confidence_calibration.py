"""The reliability table: errors of known size are told, and a known calibration is found."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from benchmarks.robustness import confidence_calibration
from benchmarks.robustness.confidence_calibration import ALL, Predictions
from deep_nrsfm_ros.lifting.confidence import CORRECT_DISTANCE, Calibration


def test_from_end_to_end(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(confidence_calibration, "STRIDE", 1)
    monkeypatch.setattr(confidence_calibration, "CACHE", tmp_path)
    confidence_calibration.main(["--data", str(data), "--output", str(tmp_path)])
    rows = list(csv.DictReader((tmp_path / "confidence_calibration.csv").open()))
    whole = [row for row in rows if row["confidence"] == ALL]
    assert [row["model"] for row in whole] == ["human", "cmu31"]
    # Its motion capture is nonsense, of which no model knows anything.
    assert all(float(row["near %"]) < 50 for row in whole)
    assert (tmp_path / "confidence_calibration.png").stat().st_size > 1000
    assert (
        "fitted to subject 131: constant=" in (tmp_path / "confidence_calibration.md").read_text()
    )


def test_the_fit_finds_what_the_chances_were_made_of() -> None:
    rng = np.random.default_rng(0)
    truth = Calibration(-2.0, -1.5, -0.8, 1.2, -0.6)
    evidence = rng.standard_normal((4000, 10, 5))
    evidence[..., 0], evidence[..., 4] = 1, rng.random((4000, 10)) < 0.3
    hit = rng.random((4000, 10)) < 1 / (1 + np.exp(-evidence @ truth))
    error = np.where(hit, CORRECT_DISTANCE / 2, 2 * CORRECT_DISTANCE)
    parts = [Predictions(error, error[i::2], evidence[i::2]) for i in range(2)]
    np.testing.assert_allclose(confidence_calibration.fit(parts), truth, atol=0.1)


def test_reliable_confidence_is_told_from_boasting() -> None:
    rng = np.random.default_rng(0)
    chance = rng.random((3000, 10))
    error = np.where(rng.random(chance.shape) < chance, CORRECT_DISTANCE / 2, 2 * CORRECT_DISTANCE)
    fair, boast = (
        dict(confidence_calibration.reliability(said, error))[ALL] for said in (chance, chance**0.5)
    )
    assert fair["off %"] < 3 and boast["off %"] > 10
    assert fair["rank points"] < -0.4
    assert fair["near %"] == pytest.approx(50, abs=2)


def test_cameras_keep_the_shape_and_see_it_whole() -> None:
    rng = np.random.default_rng(0)
    S = rng.standard_normal((50, 12, 3))
    T, points, confidence = confidence_calibration.project(S, rng)
    inner, before = (np.linalg.norm(X[:, :1] - X[:, 1:], axis=2) for X in (T, S))
    ratio = inner / before
    np.testing.assert_allclose(ratio, ratio[:, :1] + 0 * ratio, rtol=1e-6)
    assert np.isfinite(points).all() and set(np.unique(confidence)) == {0, 1}
