# SPDX-License-Identifier: Apache-2.0
"""Errors by the number of steps: parts of a recording, figures of known shapes, and the program."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from benchmarks.real import fine_tuning
from benchmarks.real.fine_tuning import Part, joined
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import COCO17
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.geometry import random_cameras
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser

LAYOUT = KeypointLayout("box", tuple(COCO17.keypoints[:8]))
_SEEN = list(LAYOUT.keypoints[:6])


def recording(data: Path) -> list[Part]:
    """Return two views of 60 and 40 frames of random shapes; `data` is not read."""
    del data
    rng, parts = np.random.default_rng(0), []
    for frames in (60, 40):
        shapes = rng.normal(0, 300, (1, 8, 3)) + rng.normal(0, 60, (frames, 8, 3))
        rows = random_cameras(frames, rng)
        R = np.concatenate((rows, np.cross(rows[..., 0], rows[..., 1])[..., None]), 2)
        seen = shapes @ R
        confidence = np.ones((frames, 8), np.float32)
        parts.append(Part(LAYOUT, seen[..., :2] + 500, confidence, seen[:, :6], _SEEN))
    return parts


@pytest.fixture
def start() -> Model:
    random = initialise(Architecture(widths=(8, 4)), 8, np.random.default_rng(0))
    L = 2 * np.eye(8, dtype=np.float32)  # the identity would be a start with other keypoints
    network = dataclasses.replace(random, L=L, L_inverse=L / 4)
    return Model("start", network, LAYOUT, Normaliser(), np.eye(3, dtype=np.float32))


@pytest.fixture(autouse=True)
def _known(monkeypatch: pytest.MonkeyPatch, start: Model) -> None:
    monkeypatch.setattr(fine_tuning, "READERS", {"clip": recording, "shelf": recording})
    monkeypatch.setattr(fine_tuning, "load_model", lambda name: start)
    fine_tuning.read.cache_clear()


def test_each_recording_is_cut_by_its_own_time(tmp_path: Path) -> None:
    learned, later = fine_tuning.read("clip", tmp_path)
    views = recording(tmp_path)
    assert [len(part.points) for part in (learned, later)] == [70, 30]
    np.testing.assert_array_equal(learned.points[42:], views[1].points[:28])
    np.testing.assert_array_equal(later.truth[:18], views[0].truth[42:])
    assert len(joined(views).points) == 100


def test_errors_are_of_the_frames_that_have_a_shape_and_a_truth(
    tmp_path: Path, start: Model
) -> None:
    part = recording(tmp_path)[0]
    error, mirrored = fine_tuning.errors(start, part)
    assert 0 < error < 1000 and 0 <= mirrored <= 50
    hidden = part.confidence.copy()
    hidden[::2] = 0  # these frames are not lifted
    assert np.isfinite(fine_tuning.errors(start, part._replace(confidence=hidden))).all()
    unknown = part._replace(truth=np.full_like(part.truth, np.nan))
    assert np.isnan(fine_tuning.errors(start, unknown)).all()


def test_a_row_for_each_recipe(tmp_path: Path, start: Model) -> None:
    (table,) = fine_tuning.benchmark(["clip"], [1], [0.0], tmp_path)
    assert [row.labels for row in table.rows] == [
        ("clip", "0", ""),
        ("clip", "1", "0.6"),
        ("clip", "100, default", "0.0"),
        ("clip", "100, default", "0.6"),
    ]
    later = fine_tuning.read("clip", tmp_path)[1]
    first, *others = (row.figures for row in table.rows)
    assert first["later"] == pytest.approx(fine_tuning.errors(start, later)[0])
    assert all(row["learned"] != first["learned"] for row in others)
    assert all(row["judge"] in (0.0, 1.0) and row["frames"] > 50 for row in others)
