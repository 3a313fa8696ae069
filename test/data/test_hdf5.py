# SPDX-License-Identifier: Apache-2.0
"""HDF5 of DeepLabCut and of SLEAP is read, and runs no code."""

from __future__ import annotations

import json
import pickle
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from deep_nrsfm_ros.data.keypoint_files import KeypointFileError, read_keypoints
from test.data.test_tables import COLUMNS, PARTS, VALUES, assert_mouse


def write_h5(path: Path, form: str, columns: Any = COLUMNS) -> Path:
    """Write a DataFrame as pandas does."""
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        values = VALUES.reshape(5, -1)
        if form == "table":
            group.attrs["pandas_type"] = np.bytes_(b"frame_table")
            group.attrs["non_index_axes"] = np.bytes_(pickle.dumps([(1, columns)], 0))
            table = np.zeros(5, [("index", "i8"), ("values_block_0", "f8", (12,))])
            table["index"], table["values_block_0"] = np.arange(5) * 2, values
            group["table"] = table
        else:
            group.attrs["pandas_type"] = np.bytes_(b"frame")
            group["axis1"], group["block0_values"] = np.arange(5) * 2, values
            for level, labels in enumerate(zip(*columns, strict=True)):
                names = sorted(set(labels))
                group[f"block0_items_level{level}"] = np.array(names, "S12")
                group[f"block0_items_label{level}"] = [names.index(label) for label in labels]
    return path


@pytest.mark.parametrize("form", ["table", "fixed"])
def test_deeplabcut_h5(tmp_path: Path, form: str) -> None:
    found = read_keypoints(write_h5(tmp_path / "a.h5", form))
    assert_mouse(found)
    assert found.frames.numbers.tolist() == [0, 2, 4, 6, 8]


def test_h5_runs_no_code(tmp_path: Path) -> None:
    path = write_h5(tmp_path / "a.h5", "table", [Path("nowhere")])
    with pytest.raises(KeypointFileError, match="holds a Python object pathlib"):
        read_keypoints(path)


def test_other_h5(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.h5"
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(60))
    with pytest.raises(KeypointFileError, match="damaged or no HDF5"):
        read_keypoints(path)
    with h5py.File(path, "w") as file:
        file["tracks"] = np.ones(3)
    with pytest.raises(KeypointFileError, match="no analysis file of SLEAP; it holds tracks"):
        read_keypoints(path)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(KeypointFileError, match=r"needs h5py: pip install .*\[hdf5\]"):
        read_keypoints(path)


def write_sleap(path: Path, axes: tuple[str, ...] = ("track", "xy", "node", "frame")) -> Path:
    """Write an analysis file as SLEAP does; with other axes as sleap-io does."""
    values = np.stack([VALUES, VALUES + [1000, 0, 0]], 1)  # frame, track, node, x y score
    values[1, 1] = np.nan
    values[3, 0, :, 2] = np.nan  # labelled by hand
    usual = ("frame", "track", "node", "xy")
    with h5py.File(path, "w") as file:
        arrays = {
            "tracks": (values[..., :2], usual),
            "point_scores": (values[..., 2], usual[:3]),
            "instance_scores": (values[..., 0, 2], usual[:2]),
        }
        for name, (array, own) in arrays.items():
            order = [axis for axis in axes if axis in own]
            file[name] = array.transpose([own.index(axis) for axis in order])
            if axes != ("track", "xy", "node", "frame"):
                file[name].attrs["dims"] = json.dumps(order)
        file["node_names"] = [name.encode() for name in PARTS]
        file["track_names"] = [b"female", b"male"]
        file["track_occupancy"] = (~np.isnan(values).all((2, 3))).astype(np.uint8)
        file["edge_inds"] = np.zeros((2, 3))
    return path


@pytest.mark.parametrize(
    "axes", [("track", "xy", "node", "frame"), ("frame", "track", "node", "xy")]
)
def test_analysis_of_sleap(tmp_path: Path, axes: tuple[str, ...]) -> None:
    found = read_keypoints(write_sleap(tmp_path / "a.analysis.h5", axes))
    assert found.layout and found.layout.keypoints == PARTS
    assert found.frame.tolist() == [0, 0, 1, 2, 2, 3, 3, 4, 4]
    assert found.identities.tolist() == [
        *("female", "male", "female", "female", "male", "female", "male", "female", "male"),
    ]
    female = found.points[found.identities == "female"]
    np.testing.assert_allclose(female, np.nan_to_num(VALUES[..., :2]), rtol=1e-5)
    sure = found.confidence[found.identities == "female"].round(2)
    assert sure[0].tolist() == [np.float32(0.9)] * 4
    assert sure[3].tolist() == [1, 1, 1, 1]
    assert not found.warnings and not found.findings and not found.notes


def test_one_animal_of_sleap_without_tracks(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["tracks"] = VALUES[:, None, :, :2].transpose(1, 3, 2, 0)
        file["node_names"] = [name.encode() for name in PARTS]
        file["track_names"] = np.zeros(0)
    found = read_keypoints(path)
    assert not found.has_identities()
    np.testing.assert_allclose(found.points, np.nan_to_num(VALUES[..., :2]), rtol=1e-5)
    with h5py.File(path, "w") as file:
        file["tracks"] = np.zeros((2, 3, 4, 5))
        file["node_names"] = [b"a"]
    with pytest.raises(
        KeypointFileError, match=r"shape \(2, 3, 4, 5\), not \(tracks, 2, 1, frames"
    ):
        read_keypoints(path)


def test_a_project_of_sleap_is_to_be_exported(tmp_path: Path) -> None:
    path = tmp_path / "labels.h5"
    with h5py.File(path, "w") as file:
        for name in ("metadata", "frames", "instances", "points", "pred_points"):
            file[name] = np.zeros(3)
    with pytest.raises(KeypointFileError, match="export it .*sleap-convert --format analysis"):
        read_keypoints(path)


def test_an_index_of_times(tmp_path: Path) -> None:
    path = write_h5(tmp_path / "a.h5", "fixed")
    with h5py.File(path, "a") as file:
        del file["df_with_missing/axis1"]
        file["df_with_missing/axis1"] = np.arange(5) / 10
    found = read_keypoints(path)
    assert_mouse(found)
    assert found.stamps.tolist() == [0, 100_000_000, 200_000_000, 300_000_000, 400_000_000]
