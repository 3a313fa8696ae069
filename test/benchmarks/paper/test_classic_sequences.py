# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from benchmarks.paper import classic_sequences
from benchmarks.paper.classic_sequences import BASELINES, in_camera_axes, main, normalised_error
from deep_nrsfm_ros.commands.evaluate import LIFTING
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras, rotation_from_camera

FRAMES, POINTS = 40, 12


def rows(X: np.ndarray) -> np.ndarray:
    """(f, p, d) as a matrix with d rows a frame."""
    return X.swapaxes(1, 2).reshape(-1, X.shape[1])


@pytest.fixture
def shapes() -> np.ndarray:
    rng = np.random.default_rng(0)
    mean, mode = rng.standard_normal((2, POINTS, 3))
    return centre(mean + 0.3 * rng.standard_normal((FRAMES, 1, 1)) * mode)


@pytest.fixture
def cameras() -> np.ndarray:
    return random_cameras(FRAMES, np.random.default_rng(1)).astype(float)


@pytest.fixture
def turned(shapes: np.ndarray, cameras: np.ndarray) -> np.ndarray:
    """The shapes in the axes of the cameras."""
    return shapes @ rotation_from_camera(cameras).swapaxes(1, 2)


@pytest.fixture
def data(tmp_path: Path, shapes: np.ndarray, cameras: np.ndarray, turned: np.ndarray) -> Path:
    """A folder of two sequences of the same object."""
    folder = tmp_path / "data" / "nrsfm"
    folder.mkdir(parents=True)
    savemat(folder / "drink.mat", {"W": rows(shapes @ cameras), "S": rows(shapes)})
    truth = {"shape3D": rows(turned)}
    savemat(folder / "face_mocap.mat", {"W": rows(turned[..., :2]), "GT": truth})
    return folder.parent


def test_error_counts_in_standard_deviations_of_the_truth(shapes: np.ndarray) -> None:
    larger = 1.1 * shapes  # no rotation mends it
    expected = 0.1 * np.linalg.norm(shapes, axis=2).mean() / shapes.std(1).mean()
    assert normalised_error(larger, shapes) == pytest.approx(expected)
    assert normalised_error(10 * larger, 10 * shapes) == pytest.approx(expected)


def test_error_forgives_one_reflection(shapes: np.ndarray) -> None:
    turn = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
    turn *= -np.sign(np.linalg.det(turn))
    assert normalised_error(shapes @ turn, shapes) < 1e-9


def test_error_frame_by_frame_forgives_what_the_other_does_not(
    shapes: np.ndarray, turned: np.ndarray
) -> None:
    assert normalised_error(turned, shapes) > 0.1
    assert normalised_error(turned, shapes, by_frame=True) < 1e-6


@pytest.mark.parametrize("mirror", [1, -1])
def test_shapes_are_taken_to_the_axes_of_their_images_up_to_depth(
    shapes: np.ndarray, cameras: np.ndarray, turned: np.ndarray, mirror: int
) -> None:
    found = in_camera_axes(shapes @ np.diag([1, 1, mirror]), shapes @ cameras)
    np.testing.assert_allclose(found[..., :2], turned[..., :2], atol=1e-6)
    np.testing.assert_allclose(found[..., 2], mirror * turned[..., 2], atol=1e-6)


def test_command_compares_all_methods_on_each_sequence(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(classic_sequences, "RANKS", (2,))
    for name in list(BASELINES)[2:]:
        monkeypatch.delitem(BASELINES, name)
    output = tmp_path / "output"
    main(
        [
            *("--data", str(data), "--output", str(output), "--steps", "20", "--seeds", "0"),
            *("--subjects", "drink", "face_mocap"),
        ]
    )
    assert "Classic sequences" in capsys.readouterr().out
    with (output / "classic_sequences.csv").open() as file:
        table = list(csv.DictReader(file))
    for sequence in ("drink", "face_mocap"):
        by_method = {row["method"]: row for row in table if row["sequence"] == sequence}
        assert len(by_method) == len(LIFTING) + 4
        assert all(row["frames"] == str(FRAMES) for row in by_method.values())
        assert float(by_method["Simple (Dai et al.), K = 2"]["e3D"]) < 0.05
        assert float(by_method["default recipe, network alone"]["e3D"]) > 0.05


def test_command_says_which_sequence_it_cannot_read(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["--data", str(data), "--subjects", "yoga"])
    assert stopped.value.code == 2
    assert "yoga.mat" in capsys.readouterr().err
