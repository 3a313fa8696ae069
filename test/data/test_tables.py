# SPDX-License-Identifier: Apache-2.0
"""Tables of DeepLabCut, MediaPipe and Sports2D are read, with the names that they give."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.keypoint_files import KeypointFileError, read_keypoints
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import COCO17, MEDIAPIPE33

PARTS = ("nose", "left_ear", "right_ear", "tail_base")
VALUES = np.random.default_rng(0).uniform(50, 900, (5, len(PARTS), 3)).round(3)
VALUES[..., 2] = 0.9
VALUES[2, 1, :2] = np.nan


def read(path: Path, text: str, **options: Any) -> Detections:
    path.write_text(text)
    return read_keypoints(path, ReadOptions(**options))


def assert_mouse(found: Detections) -> None:
    assert found.layout and found.layout.keypoints == PARTS
    assert found.frame.tolist() == list(range(5))
    np.testing.assert_allclose(found.points, np.nan_to_num(VALUES[..., :2]), rtol=1e-5)
    assert found.confidence[2].tolist() == [np.float32(0.9), 0, *[np.float32(0.9)] * 2]


def rows(*cells: Any) -> str:
    return "".join(",".join(map(str, row)) + "\n" for row in cells)


def deeplabcut(
    columns: Sequence[tuple[str, ...]], values: np.ndarray, levels: tuple[str, ...]
) -> str:
    heads = [
        (name, *labels) for name, labels in zip(levels, zip(*columns, strict=True), strict=True)
    ]
    return rows(*heads, *((2 * i, *row) for i, row in enumerate(values.tolist()))).replace(
        "nan", ""
    )


COLUMNS = [("DLC", part, c) for part in PARTS for c in ("x", "y", "likelihood")]


def test_deeplabcut_csv(tmp_path: Path) -> None:
    text = deeplabcut(COLUMNS, VALUES.reshape(5, -1), ("scorer", "bodyparts", "coords"))
    found = read(tmp_path / "a.csv", text)
    assert_mouse(found)
    assert found.frames.numbers.tolist() == [0, 2, 4, 6, 8]
    assert (found.stamps / 1e9).round(3).tolist() == [0, 0.067, 0.133, 0.2, 0.267]


def test_deeplabcut_with_individuals(tmp_path: Path) -> None:
    columns = [("DLC", who, part, c) for who in ("m1", "m2") for _, part, c in COLUMNS]
    values = np.tile(VALUES.reshape(5, -1), 2)
    values[1, :12] = np.nan
    text = deeplabcut(columns, values, ("scorer", "individuals", "bodyparts", "coords"))
    found = read(tmp_path / "a.csv", text)
    assert found.frame.tolist() == [0, 0, 1, 2, 2, 3, 3, 4, 4]
    assert found.identities.tolist()[:3] == ["m1", "m2", "m2"]


def test_labelled_data_of_deeplabcut(tmp_path: Path) -> None:
    text = rows(
        ("scorer", "", "", *["me"] * 8),
        ("bodyparts", "", "", *[part for part in PARTS for _ in "xy"]),
        ("coords", "", "", *["x", "y"] * 4),
        *(
            ("labeled-data", "clip", f"img{n:03}.png", *row)
            for n, row in zip((3, 5), VALUES[:2, :, :2].reshape(2, -1).tolist(), strict=True)
        ),
    )
    found = read(tmp_path / "a.csv", text)
    assert found.frames.names.tolist() == ["img003.png", "img005.png"]
    assert found.frames.numbers.tolist() == [3, 5] and (found.confidence == 1).all()


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
    with pytest.raises(KeypointFileError, match="no table of DeepLabCut; it holds tracks"):
        read_keypoints(path)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(KeypointFileError, match=r"needs h5py: pip install .*\[hdf5\]"):
        read_keypoints(path)


def landmarks(values: np.ndarray, names: Any) -> str:
    lines = [
        (frame, name, x, y, 0, c)
        for frame, person in enumerate(values.tolist())
        for name, (x, y, c) in zip(names, person, strict=True)
    ]
    return rows(("frame", "landmark", "x", "y", "z", "visibility"), *lines)


def test_a_landmark_a_row(tmp_path: Path) -> None:
    assert_mouse(read(tmp_path / "a.csv", landmarks(VALUES, PARTS)))
    values = np.random.default_rng(0).uniform(0.1, 0.9, (3, 33, 3))
    text = landmarks(values, range(33))
    with pytest.raises(KeypointFileError, match="give --image-width and --image-height"):
        read(tmp_path / "a.csv", text, layout=MEDIAPIPE33)
    found = read(tmp_path / "a.csv", text, layout=MEDIAPIPE33, image_size=(1280, 720))
    np.testing.assert_allclose(found.points, values[..., :2] * [1280, 720], rtol=1e-5)


@pytest.mark.parametrize("form", ["{part}_{c}", "{part}.{c}", "{c}{i}"])
def test_a_column_for_each_coordinate(tmp_path: Path, form: str) -> None:
    head = [form.format(part=p, c=c, i=i) for i, p in enumerate(PARTS) for c in ("x", "y", "v")]
    lines = [(i, *row) for i, row in enumerate(VALUES.reshape(5, -1).tolist())]
    found = read(tmp_path / "a.csv", rows(("frame", *head), *lines))
    if "part" in form:
        assert_mouse(found)
    else:
        np.testing.assert_allclose(found.points, np.nan_to_num(VALUES[..., :2]), rtol=1e-5)


def columns(*without: str) -> str:
    """Return a table of a column for each coordinate, without some of them."""
    head = [f"{part}_{c}" for part in PARTS for c in ("x", "y", "v")]
    kept = [i for i, name in enumerate(head) if name not in without]
    lines = VALUES.reshape(5, -1)[:, kept].tolist()
    return rows([head[i] for i in kept], *lines)


def test_a_coordinate_without_the_other_is_named(tmp_path: Path) -> None:
    found = read(tmp_path / "a.csv", columns("nose_y", "left_ear_x"))
    assert found.layout and found.layout.keypoints == PARTS[2:]
    (finding,) = found.findings
    assert "nose has x but no y, left_ear has y but no x" in finding.message
    whole = ("nose_x", "nose_y", "nose_v", "left_ear_v")
    assert not read(tmp_path / "a.csv", columns(*whole)).findings
    lacking = [(column, i) for i, column in enumerate(COLUMNS) if column[1:] != ("nose", "y")]
    values = VALUES.reshape(5, -1)[:, [i for _, i in lacking]]
    levels = ("scorer", "bodyparts", "coords")
    found = read(tmp_path / "a.csv", deeplabcut([c for c, _ in lacking], values, levels))
    assert "nose has x but no y" in found.findings[0].message


def test_landmarks_without_a_frame(tmp_path: Path) -> None:
    """A landmark that comes again begins the next frame, where no column says the frame."""
    text = landmarks(VALUES, PARTS)
    unnumbered = "".join(line.split(",", 1)[1] + "\n" for line in text.splitlines())
    assert_mouse(read(tmp_path / "a.csv", unnumbered))
    lines = text.splitlines()
    found = read(tmp_path / "a.csv", "\n".join([*lines, *lines[1:4]]))
    assert len(found) == 5
    assert found.warnings[0].startswith("left out: 3 that are rows before another one of the same")


def test_other_tables(tmp_path: Path) -> None:
    with pytest.raises(KeypointFileError, match="its columns are date, price"):
        read(tmp_path / "a.csv", "date,price\n1,2\n")
    with pytest.raises(KeypointFileError, match="needs the rows scorer, bodyparts and coords"):
        read(tmp_path / "a.csv", "scorer,a\n1,2\n")
    for text in ("", "\n", " , \n"):
        with pytest.raises(KeypointFileError, match="a.csv: the file is empty"):
            read(tmp_path / "a.csv", text)


def trc(values: np.ndarray, names: Any, units: str = "m") -> str:
    head = ["Frame#", "Time", *[cell for name in names for cell in (name, "", "")]]
    lines = [
        ["PathFileType", "4", "(X/Y/Z)", "a.trc"],
        ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"],
        ["25", "25", str(len(values)), str(len(names)), units],
        head,
        ["", "", *[f"{c}{i}" for i in range(len(names)) for c in "XYZ"]],
        *([str(i + 1), str((i + 10) / 25), *map(str, row.ravel())] for i, row in enumerate(values)),
    ]
    return "\n".join("\t".join(line) for line in lines).replace("nan", "")


def test_trc_of_sports2d(tmp_path: Path) -> None:
    values = VALUES.copy()
    values[..., 2] = 0
    names = ("Nose", "LEar", "REar", "LShoulder")
    found = read(tmp_path / "a_px_person00.trc", trc(values, names))
    expected = ("nose", "left_ear", "right_ear", "left_shoulder")
    assert found.layout and found.layout.keypoints == expected and not found.warnings
    np.testing.assert_allclose(found.points, np.nan_to_num(values[..., :2]), rtol=1e-5)
    assert found.stamps.tolist() == [(i + 10) * 40_000_000 for i in range(5)]
    assert found.frames.numbers.tolist() == [1, 2, 3, 4, 5]
    found = read(tmp_path / "a_m_person00.trc", trc(values / 1000, names))
    assert "taken for metres with y up" in found.warnings[0]
    np.testing.assert_allclose(found.points[0], values[0, :, :2] / [1000, -1000], rtol=1e-5)
    values[..., 2] = VALUES[..., 0]
    with pytest.raises(KeypointFileError, match="its markers are 3D"):
        read(tmp_path / "a.trc", trc(values, names))
    with pytest.raises(KeypointFileError, match="no TRC"):
        read(tmp_path / "a.trc", "hello")


def test_counts_of_keypoints_are_those_of_the_layout(tmp_path: Path) -> None:
    with pytest.raises(KeypointFileError, match="it names 4 keypoints, coco17 has 17"):
        read(tmp_path / "a.csv", landmarks(VALUES, PARTS), layout=COCO17)


def test_the_coordinate_may_come_before_the_name(tmp_path: Path) -> None:
    head = [f"{c}_{part}" for part in PARTS for c in ("x", "y", "conf")]
    text = rows(head, *VALUES.reshape(5, -1).tolist()).replace("nan", "")
    assert_mouse(read(tmp_path / "a.csv", text))


@pytest.mark.parametrize("prefix", ["kp", "Keypoint_", "landmark "])
def test_numbered_names_are_no_names(prefix: str, tmp_path: Path) -> None:
    head = [f"{prefix}{i}_{c}" for i in range(len(PARTS)) for c in ("x", "y", "conf")]
    text = rows(head, *VALUES.reshape(5, -1).tolist()).replace("nan", "")
    found = read(tmp_path / "a.csv", text)
    assert found.layout is None
    np.testing.assert_allclose(found.points, np.nan_to_num(VALUES[..., :2]), rtol=1e-5)
    own = KeypointLayout("mouse", PARTS)
    assert read(tmp_path / "a.csv", text, fallback=own).layout == own
    known = KeypointLayout("numbers", tuple(f"{prefix}{i}" for i in range(len(PARTS))))
    named = read(tmp_path / "a.csv", text, fallback=known)
    assert named.layout and named.layout.keypoints == known.keypoints
    assert "its objects have 4 keypoints; the keypoint layout coco17 has 17" in (
        complaint(tmp_path / "a.csv", text, fallback=COCO17)
    )


def complaint(path: Path, text: str, **options: Any) -> str:
    with pytest.raises(KeypointFileError) as error:
        read(path, text, **options)
    return str(error.value)
