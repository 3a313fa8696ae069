# SPDX-License-Identifier: Apache-2.0
"""The reliability table: errors of known size are told, and a known calibration is found."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from benchmarks.robustness import confidence_calibration
from benchmarks.robustness.confidence_calibration import (
    ALL,
    BORDER,
    CUTS,
    EVERY,
    FITTED_CUTS,
    GAPS,
    ONE_SIDE,
    Predictions,
)
from deep_nrsfm_ros.layouts.presets import CMU31, HUMAN17
from deep_nrsfm_ros.lifting.confidence import CORRECT_DISTANCE, Calibration, Coefficients


def test_from_end_to_end(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(confidence_calibration, "STRIDE", 1)
    monkeypatch.setattr(confidence_calibration, "CACHE", tmp_path)
    confidence_calibration.main(["--data", str(data), "--output", str(tmp_path)])
    rows = list(csv.DictReader((tmp_path / "confidence_calibration.csv").open()))
    whole = [row for row in rows if row["confidence"] == ALL]
    # Of the models of people as coco17 sees them, too.
    people = ["human"] * 14 + ["human17"] * 14
    assert [row["model"] for row in whole] == [*people, *["cmu31"] * 7]
    assert [row["cut"] for row in whole[:7]] == [*CUTS, EVERY]
    # Its motion capture is nonsense, of which no model knows anything.
    assert all(float(row["seen near %"]) < 60 for row in whole if row["cut"] == GAPS)
    assert (tmp_path / "confidence_calibration.png").stat().st_size > 1000
    assert (
        "shipped, fitted to subject 131: visible: constant"
        in (tmp_path / "confidence_calibration.md").read_text()
    )


def test_the_fit_prints_what_the_package_holds(
    data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(confidence_calibration, "STRIDE", 1)
    confidence_calibration.main(["--data", str(data), "--fit"])
    lines = capsys.readouterr().out.splitlines()
    fitted = eval("".join(lines[:4]).partition(" = ")[2], {"Calibration": Calibration} | globals())
    assert isinstance(fitted, Calibration) and np.isfinite(fitted).all()
    assert lines[4].startswith("fitted in")


def test_the_fit_finds_what_the_chances_were_made_of() -> None:
    rng = np.random.default_rng(0)
    truth = Calibration(
        Coefficients(0.5, -1.5, -0.8, 1.2, -0.6, -1.0, 0.0),
        Coefficients(-1.0, -0.5, -1.2, 0.4, -0.3, -0.8, -2.0),
    )
    terms, visible = rng.standard_normal((8000, 10, 7)), rng.random((8000, 10)) < 0.6
    terms[..., 0] = 1
    seen, missing = (terms @ np.array(part) for part in truth)
    odds = np.where(visible, seen, missing)
    hit = rng.random(odds.shape) < 1 / (1 + np.exp(-odds))
    error = np.where(hit, CORRECT_DISTANCE / 2, 2 * CORRECT_DISTANCE)
    parts = [(terms[i::2], Predictions(error[i::2], error[i::2], visible[i::2])) for i in range(2)]
    np.testing.assert_allclose(confidence_calibration.fit(parts), truth, atol=0.1)


def test_reliable_confidence_is_told_from_boasting() -> None:
    rng = np.random.default_rng(0)
    chance, visible = rng.random((3000, 10)), rng.random((3000, 10)) < 0.5
    error = np.where(rng.random(chance.shape) < chance, CORRECT_DISTANCE / 2, 2 * CORRECT_DISTANCE)
    fair, boast, of_missing = (
        dict(confidence_calibration.reliability(Predictions(said, error, visible)))[ALL]
        for said in (chance, chance**0.5, np.where(visible, chance, chance**0.5))
    )
    assert fair["off %"] < 3 and boast["off %"] > 10
    assert of_missing["seen off %"] < 4 and of_missing["missing off %"] > 10
    assert fair["rank"] < -0.4
    assert fair["near %"] == pytest.approx(50, abs=2)


def test_errors_are_measured_from_the_visible_points() -> None:
    rng = np.random.default_rng(0)
    T = rng.standard_normal((20, 8, 3))
    visible = np.arange(8) < rng.integers(4, 8, 20)[:, None]
    S = 3 * T + rng.standard_normal((20, 1, 3))
    S[~visible] += 3.0
    found = confidence_calibration.errors(S, T, visible, np.full(20, 2.0))
    np.testing.assert_allclose(found[visible], 0, atol=1e-9)
    np.testing.assert_allclose(found[~visible], 3**0.5 / 2)


def test_cameras_keep_the_shape_and_see_it_whole() -> None:
    rng = np.random.default_rng(0)
    S = rng.standard_normal((50, 12, 3))
    T, points = confidence_calibration.project(S, rng)
    inner, before = (np.linalg.norm(X[:, :1] - X[:, 1:], axis=2) for X in (T, S))
    ratio = inner / before
    np.testing.assert_allclose(ratio, ratio[:, :1] + 0 * ratio, rtol=1e-6)
    assert np.isfinite(points).all()


@pytest.mark.parametrize("layout", [HUMAN17, CMU31])
def test_cuts_hide_what_they_say(layout: object) -> None:
    assert layout in (HUMAN17, CMU31)
    of = HUMAN17 if layout == HUMAN17 else CMU31
    rng = np.random.default_rng(0)
    points = rng.standard_normal((200, len(of), 2)).astype(np.float32)
    left = {cut: confidence_calibration.cut_off(points, of, cut, rng) for cut in FITTED_CUTS}
    expected = {HUMAN17.name: (9, 6, 4, 2), CMU31.name: (11, 8, 6, 4)}[of.name]
    counts = [int((~left[cut]).sum(1).max()) for cut in CUTS[1:5]]
    assert tuple(counts) == expected
    assert (left["legs alone"] == ~left["at the waist"]).all()
    halves = np.unique(left[ONE_SIDE], axis=0)
    assert len(halves) == 2 and (halves[0] | halves[1]).all()
    for visible, at in zip(left[BORDER], points, strict=True):
        # A line parts them: some direction separates their means.
        assert 0 < visible.sum() < len(of)
        assert np.linalg.norm(at[visible].mean(0) - at[~visible].mean(0)) > 0.5
