# SPDX-License-Identifier: Apache-2.0
"""Arrays in temporary files, and recordings of which memory holds the keypoints but once."""

from __future__ import annotations

import io
import json
import tracemalloc
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from deep_nrsfm_ros import large_arrays
from deep_nrsfm_ros.commands import lift as command
from deep_nrsfm_ros.data.lifted_files import write_recording
from deep_nrsfm_ros.large_arrays import concatenated, empty, release, take


def coco_file(path: Path, people: int) -> Path:
    """Write people who jitter, two in each image; return the path."""
    rng = np.random.default_rng(0)
    base = rng.uniform(100, 600, (2, 17, 2))
    annotations = []
    for i in range(people):
        points = base[i % 2] + rng.normal(0, 3, (17, 2))
        keypoints = np.column_stack((points, np.full(17, 0.9))).round(1).ravel().tolist()
        annotations.append({"image_id": i // 2, "category_id": 1, "keypoints": keypoints})
    images = [{"id": i, "file_name": f"{i:06}.jpg"} for i in range(-(-people // 2))]
    path.write_text(json.dumps({"images": images, "annotations": annotations}))
    return path


def lift(path: Path, output: Path, *options: str) -> None:
    """Lift a file of people in the layout coco17."""
    arguments = [str(path), "--output", str(output), "--keypoint-layout", "coco17", "--force"]
    command.main([*arguments, *options])


def peak(path: Path, output: Path, *options: str) -> int:
    """Return the bytes that reading, lifting and writing need at most, without the model."""
    arguments = [str(path), "--output", str(output), "--keypoint-layout", "coco17", *options]
    args = command.arguments().parse_args(arguments)
    model, layout = command.read_model(args)
    tracemalloc.start()
    try:
        detections, source, _ = command.read_objects(args, model, layout)
        recording = command.lift_objects(args, model, source, detections)
        command.summary_of(args, model, recording)
        write_recording(output, recording, model.name)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("large", [1, 1 << 40])
def test_rows_and_joined_arrays_are_the_same_in_files_and_memory(
    large: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(large_arrays, "LARGE", large)
    monkeypatch.setattr(large_arrays, "_RELEASED", 1)
    rng = np.random.default_rng(0)
    array = rng.random((9000, 2, 3), np.float32)
    rows = np.flatnonzero(rng.random(9000) > 0.3)
    chosen = take(array, rows)
    np.testing.assert_array_equal(chosen, array[rows])
    assert isinstance(chosen.base, np.ndarray) == (large == 1)
    joined = concatenated([chosen, array, array[:0]])
    np.testing.assert_array_equal(joined, np.concatenate([array[rows], array]))
    assert concatenated([array]) is array
    assert take(array, rows[:0]).shape == (0, 2, 3)


def test_a_large_array_keeps_its_values_when_released(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(large_arrays, "LARGE", 1000)
    large, small = empty((1000, 3), np.float32), empty((10, 3), np.float32)
    assert small.base is None and large.base is not None
    large[:] = np.arange(3000).reshape(1000, 3)
    release([large, small, np.ones(3)])
    np.testing.assert_array_equal(large, np.arange(3000).reshape(1000, 3))
    large[5] = -1
    release([large[:10]])
    assert (large[5] == -1).all() and large[999, 2] == 2999


def test_without_room_an_array_is_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(large_arrays, "LARGE", 1000)
    monkeypatch.setattr("os.posix_fallocate", Mock(side_effect=OSError("no space left")))
    assert empty((1000, 3), np.float32).base is None


@pytest.mark.parametrize("smooth", ["causal", "both", "none"])
def test_files_and_memory_give_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, smooth: str
) -> None:
    path = coco_file(tmp_path / "people.json", 300)
    for suffix in ("npz", "json"):
        lift(path, tmp_path / f"memory.{suffix}", "--smooth", smooth)
    monkeypatch.setattr(large_arrays, "LARGE", 0)
    for module in ("data.over_time._BLOCK", "lifting.lifter._RELEASED"):
        monkeypatch.setattr(f"deep_nrsfm_ros.{module}", 7)
    for suffix in ("npz", "json"):
        lift(path, tmp_path / f"files.{suffix}", "--smooth", smooth)
        written = (tmp_path / f"files.{suffix}").read_bytes()
        assert written == (tmp_path / f"memory.{suffix}").read_bytes()
    with np.load(tmp_path / "files.npz") as arrays:
        whole = io.BytesIO()
        np.savez_compressed(whole, allow_pickle=False, **arrays)
    assert whole.getvalue() == (tmp_path / "files.npz").read_bytes()


def test_memory_for_each_person_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(large_arrays, "LARGE", 1 << 14)
    few, many = 1500, 3000
    options = ("--smooth", "none")
    peaks = [
        peak(coco_file(tmp_path / f"{n}.json", n), tmp_path / "out.npz", *options)
        for n in (10, few, many)  # the first one loads modules
    ]
    growth = (peaks[2] - peaks[1]) / (many - few)
    # 1035 here, of which 204 are the keypoints; a copy of all shapes adds 300.
    assert growth < 1250, f"{growth:.0f} bytes a person"


def test_an_interrupted_file_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, output = coco_file(tmp_path / "people.json", 20), tmp_path / "out.npz"
    output.write_bytes(b"old")
    failing = Mock(side_effect=OSError("no space left on device"))
    monkeypatch.setattr("deep_nrsfm_ros.data.lifted_files._Member.write", failing)
    with pytest.raises(SystemExit):
        lift(path, output)
    assert output.read_bytes() == b"old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.npz", "people.json"]
