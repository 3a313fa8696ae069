# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from benchmarks.baselines.methods import BASELINES, Baseline, block_matrix
from benchmarks.data.synthetic_furniture import CATEGORIES
from benchmarks.harness import Session
from benchmarks.paper import table2_categories
from benchmarks.paper.table2_categories import CAMERAS, CHAIR_CORE, CHAIRS, FACES, images, main
from deep_nrsfm_ros.commands.evaluate import LIFTING


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A folder of 30 faces of 10 points."""
    rng = np.random.default_rng(0)
    faces = rng.standard_normal((10, 3)) + 0.1 * rng.standard_normal((30, 10, 3))
    folder = tmp_path / "data" / "nrsfm"
    folder.mkdir(parents=True)
    savemat(folder / "FRGC_X.mat", {"X": faces.transpose(2, 1, 0)})
    chairs = rng.standard_normal((30, 21, 3))
    chairs[3, 0] = chairs[4, 7] = np.nan  # no top of the back; no arm rest, which is not needed
    scenes = folder.parent / "scenes" / "chairs_keypointnet"
    scenes.mkdir(parents=True)
    np.savez(scenes / "chairs_keypointnet_dev.npz", truth=chairs)
    return folder.parent


@pytest.fixture
def session(data: Path, tmp_path: Path) -> Session:
    return Session(data, tmp_path / "output", (), (0,), 20, 1)


@pytest.mark.parametrize("category", [FACES, *CATEGORIES])
def test_each_object_is_seen_by_cameras_of_its_own(
    session: Session, category: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table2_categories, "OBJECTS", 30)
    dataset = images(session, category)
    assert len(dataset) == 30 * CAMERAS
    assert dataset.shapes is not None
    one = slice(0, CAMERAS)
    assert np.ptp(dataset.shapes[one], axis=0).max() == 0
    assert np.ptp(dataset.points[one], axis=0).max() > 0.1
    # An orthographic image is a linear map of the shape that keeps no length longer.
    for W, S in zip(dataset.points, dataset.shapes, strict=True):
        M = np.linalg.pinv(S) @ W
        np.testing.assert_allclose(S @ M, W, atol=1e-4)
    again = images(session, category)
    np.testing.assert_array_equal(dataset.points, again.points)


def test_chairs_are_those_with_all_points_of_the_core(session: Session) -> None:
    dataset = images(session, CHAIRS)
    assert dataset.points.shape == (29 * CAMERAS, len(CHAIR_CORE), 2)
    assert np.isfinite(dataset.points).all()


def test_command_compares_all_methods_on_each_category(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    simple = "Simple (Dai et al.)"
    for name in [name for name in BASELINES if name != simple]:
        monkeypatch.delitem(BASELINES, name)
    monkeypatch.setitem(BASELINES, simple, Baseline(block_matrix, ({"K": 3},)))
    monkeypatch.setattr(table2_categories, "OBJECTS", 30)
    output = tmp_path / "output"
    main(
        [
            *("--data", str(data), "--output", str(output), "--steps", "20", "--seeds", "0"),
            *("--subjects", FACES, "chair"),
        ]
    )
    assert "stand-in for the IKEA data" in capsys.readouterr().out
    with (output / "table2_categories.csv").open() as file:
        table = list(csv.DictReader(file))
    methods = {row["method"] for row in table if row["category"] == FACES}
    assert len(methods) == len(LIFTING) + 1
    printed = [row for row in table if row["method"] == "paper on IKEA: Deep NRSfM"]
    assert [(row["category"], float(row["shape %"])) for row in printed] == [("chair", 1.15)]
    for row in table:
        assert 0 < float(row["shape %"]) < 100


def test_command_lists_the_categories_there_are(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["--data", str(data), "--subjects", "wardrobe"])
    assert stopped.value.code == 2
    assert "wardrobe" in (said := capsys.readouterr().err)
    assert "sofa" in said
