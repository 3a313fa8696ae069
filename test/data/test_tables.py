# SPDX-License-Identifier: Apache-2.0
"""Tables of DeepLabCut, SLEAP and MediaPipe are read, with the names that they give."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

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
    texts = [["" if str(cell) == "nan" else str(cell) for cell in row] for row in cells]
    return "".join(",".join(row) + "\n" for row in texts)


def deeplabcut(
    columns: Sequence[tuple[str, ...]], values: np.ndarray, levels: tuple[str, ...]
) -> str:
    heads = [
        (name, *labels) for name, labels in zip(levels, zip(*columns, strict=True), strict=True)
    ]
    return rows(*heads, *((2 * i, *row) for i, row in enumerate(values.tolist())))


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


def test_counts_of_keypoints_are_those_of_the_layout(tmp_path: Path) -> None:
    with pytest.raises(KeypointFileError, match="it names 4 keypoints, coco17 has 17"):
        read(tmp_path / "a.csv", landmarks(VALUES, PARTS), layout=COCO17)


def test_the_coordinate_may_come_before_the_name(tmp_path: Path) -> None:
    head = [f"{c}_{part}" for part in PARTS for c in ("x", "y", "conf")]
    text = rows(head, *VALUES.reshape(5, -1).tolist())
    assert_mouse(read(tmp_path / "a.csv", text))


@pytest.mark.parametrize("prefix", ["kp", "Keypoint_", "landmark "])
def test_numbered_names_are_no_names(prefix: str, tmp_path: Path) -> None:
    head = [f"{prefix}{i}_{c}" for i in range(len(PARTS)) for c in ("x", "y", "conf")]
    text = rows(head, *VALUES.reshape(5, -1).tolist())
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


def wide(
    head: Sequence[str],
    cells: Sequence[Sequence[Any]],
    coordinates: Sequence[str] = ("x", "y", "score"),
    values: np.ndarray = VALUES,
) -> str:
    """Return a table with a column for each coordinate, and some columns before them."""
    own = [f"{part}_{c}" for part in PARTS for c in coordinates]
    lines = values[..., : len(coordinates)].reshape(len(values), -1).tolist()
    table = [(*each, *row) for each, row in zip(cells, lines, strict=True)]
    return rows([*head, *own], *table)


def codes(found: Detections) -> set[str]:
    return {finding.code for finding in found.findings}


TWO = np.repeat(VALUES, 2, 0)
TWO[1::2, :, 0] += 1000


@pytest.mark.parametrize(
    "name", ["frame_no", "fnum", "frameNumber", "Frame #", "img_path", "image_name", "frame_idx"]
)
def test_two_people_of_a_frame(name: str, tmp_path: Path) -> None:
    is_image = name[0] == "i"
    cells = [(f"dir/f{3 * i}.png" if is_image else 3 * i, who) for i in range(5) for who in "ab"]
    found = read(tmp_path / "a.csv", wide([name, "animal"], cells, values=TWO))
    assert found.frames.numbers.tolist() == [0, 3, 6, 9, 12]
    assert found.frame.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert found.identities.tolist() == list("ababababab")
    assert (found.stamps / 1e9).round(3).tolist() == [0, 0.1, 0.2, 0.3, 0.4]
    assert not codes(found) and not found.notes


@pytest.mark.parametrize(
    ("head", "cells"),
    [
        (["frame"], [(i / 10,) for i in range(5)]),
        (["timestamp"], [(f"2024-05-01T10:00:00.{i}00",) for i in range(5)]),
        (["Time (s)"], [(i / 10,) for i in range(5)]),
        (["time[ms]"], [(i * 100,) for i in range(5)]),
        (["timestamp_usec"], [(i * 100_000,) for i in range(5)]),
        (["sec", "nanosec"], [(7 + (8 + i) // 10, (8 + i) % 10 * 10**8) for i in range(5)]),
        (["time"], [(f"00:00:0{i / 10}",) for i in range(5)]),
        (["frame", "timestamp"], [(i, 1714557600 + i / 10) for i in range(5)]),
    ],
)
def test_times(head: list[str], cells: list[tuple[Any, ...]], tmp_path: Path) -> None:
    found = read(tmp_path / "a.csv", wide(head, cells))
    assert_mouse(found)
    assert np.diff(found.stamps).round(-3).tolist() == [100_000_000] * 4
    assert not codes(found)
    names = [*head, "bodypart", "x", "y", "likelihood"]
    lines = [
        (*each, part, *map(str, values))
        for each, person in zip(cells, VALUES.tolist(), strict=True)
        for part, values in zip(PARTS, person, strict=True)
    ]
    found = read(tmp_path / "a.csv", rows(names, *lines))
    assert_mouse(found)
    assert np.diff(found.stamps).round(-3).tolist() == [100_000_000] * 4
    assert not codes(found)


def test_rows_of_one_time_are_one_frame(tmp_path: Path) -> None:
    cells = [(f"2024-05-01 10:00:0{i}", who) for i in range(5) for who in "ab"]
    found = read(tmp_path / "a.csv", wide(["time", "track"], cells, values=TWO))
    assert found.frame.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert found.stamps[0] == 1714557600 * 10**9


def test_times_that_cannot_be_read_are_said(tmp_path: Path) -> None:
    cells: list[tuple[Any, ...]] = [(f"{i} o'clock",) for i in range(5)]
    found = read(tmp_path / "a.csv", wide(["time"], cells))
    (finding,) = found.findings
    assert "5 of 5 frames have no time in column 'time' (\"0 o'clock\" in line 2" in finding.message
    cells = [(i, "" if i == 2 else i / 10) for i in range(5)]
    assert codes(read(tmp_path / "a.csv", wide(["frame", "time"], cells))) == {"times"}


def test_deeplabcut_with_an_index_of_times(tmp_path: Path) -> None:
    text = deeplabcut(COLUMNS, VALUES.reshape(5, -1), ("scorer", "bodyparts", "coords"))
    lines = text.splitlines()
    times = [f"{i / 10},{line.split(',', 1)[1]}" for i, line in enumerate(lines[3:])]
    for name in ([], ["time" + "," * 12]):
        found = read(tmp_path / "a.csv", "\n".join([*lines[:3], *name, *times]))
        assert_mouse(found)
        assert found.stamps.tolist() == [0, 100_000_000, 200_000_000, 300_000_000, 400_000_000]
    found = read(tmp_path / "a.csv", "\n".join([*lines[:3], "frame" + "," * 12, *lines[3:]]))
    assert_mouse(found)
    assert found.frames.numbers.tolist() == [0, 2, 4, 6, 8]


def test_sleap(tmp_path: Path) -> None:
    """The analysis CSV, and the forms "points" and "frames" of sleap-io."""
    who = ("track_1", "track_0")
    cells = [(who[(i + i // 2) % 2], i // 2, 0.5) for i in range(10)]
    values = TWO.copy()
    values[2, :, 2] = np.nan  # labelled by hand
    text = wide(["track", "frame_idx", "instance.score"], cells, values=values)
    found = read(tmp_path / "a.csv", text.replace("_x", ".x").replace("_y", ".y"))
    assert found.layout and found.layout.keypoints == PARTS
    assert found.identities.tolist() == [row[0] for row in cells]
    assert found.frame.tolist() == [row[1] for row in cells]
    assert (found.scores == 0.5).all() and (found.confidence[2] == [1, 0, 1, 1]).sum() >= 3
    assert not codes(found) and not found.notes and not found.warnings
    points = [
        (frame, part, x, y, track, score, score, c)
        for (track, frame, score), person in zip(cells, TWO.tolist(), strict=True)
        for part, (x, y, c) in zip(PARTS, person, strict=True)
    ]
    head: tuple[str, ...] = (
        *("frame_idx", "node", "x", "y", "track", "track_score", "instance_score", "score"),
    )
    again = read(tmp_path / "b.csv", rows(head, *points))
    np.testing.assert_array_equal(again.points, found.points)
    assert again.identities.tolist() == found.identities.tolist() and not codes(again)
    head = ("frame_idx", *(f"inst{i}.{c}" for i in (0, 1) for c in ("track", "score")))
    own = [f"inst{i}.{part}.{c}" for i in (0, 1) for part in PARTS for c in ("x", "y", "score")]
    lines = [
        (
            i,
            cells[2 * i][0],
            0.5,
            cells[2 * i + 1][0],
            0.5,
            *TWO[2 * i : 2 * i + 2].ravel().tolist(),
        )
        for i in range(5)
    ]
    again = read(tmp_path / "c.csv", rows([*head, *own], *lines))
    np.testing.assert_array_equal(again.points, found.points)
    assert again.identities.tolist() == found.identities.tolist() and not codes(again)


@pytest.mark.parametrize("name", ["track", "id", "individual", "subject"])
def test_people_of_landmarks(name: str, tmp_path: Path) -> None:
    lines = [
        (i // 2, "ab"[i % 2], part, *map(str, values))
        for i, person in enumerate(TWO.tolist())
        for part, values in zip(PARTS, person, strict=True)
    ]
    text = rows(("frame", name, "bodypart", "x", "y", "likelihood"), *lines)
    found = read(tmp_path / "a.csv", text)
    assert found.identities.tolist() == list("ababababab") and not codes(found)
    found = read(tmp_path / "a.csv", text.replace(name, "colour", 1))
    assert len(found) == 5 and codes(found) == {"repeated"}
    assert "20 of 40 rows" in found.findings[0].message
    assert found.notes == ("not used: columns colour",)


def test_a_number_of_the_row_is_no_identity(tmp_path: Path) -> None:
    cells = [(i // 2, i) for i in range(10)]
    found = read(tmp_path / "a.csv", wide(["frame", "id"], cells, values=TWO))
    assert not found.has_identities()


def test_unused_columns_are_said(tmp_path: Path) -> None:
    cells: list[tuple[Any, ...]] = [("x", 3, "red", 1) for _ in range(5)]
    found = read(tmp_path / "a.csv", wide(["class", "exposure", "colour", "bbox_w"], cells))
    assert found.notes == ("not used: columns exposure, colour",) and not codes(found)
    cells = [(i, 3, 4) for i in range(5)]
    found = read(tmp_path / "a.csv", wide(["frame_pos_of_clip", "fps", "pid_of_cam"], cells))
    (finding,) = found.findings
    assert "frame_pos_of_clip (is it the frame?)" in finding.message
    assert "call it 'frame'" in finding.message
    cells = [(i // 2, "ab"[i % 2]) for i in range(10)]
    found = read(tmp_path / "a.csv", wide(["frame", "name"], cells, values=TWO))
    (finding,) = found.findings
    assert "column 'name' tells the objects of a frame apart" in finding.message


def test_a_third_column_of_each_keypoint_may_be_its_confidence(tmp_path: Path) -> None:
    found = read(tmp_path / "a.csv", wide([], [()] * 5, ("x", "y", "quality")))
    (finding,) = found.findings
    assert "column 'quality' of each keypoint" in finding.message
    columns = [(scorer, part, c.replace("likelihood", "sureness")) for scorer, part, c in COLUMNS]
    text = deeplabcut(columns, VALUES.reshape(5, -1), ("scorer", "bodyparts", "coords"))
    (finding,) = read(tmp_path / "a.csv", text).findings
    assert "column 'sureness' of each keypoint" in finding.message
    assert "call it 'likelihood'" in finding.message
    for name in ("p", "prob", "vis", "visible", "certainty", "kp_score"):
        found = read(tmp_path / "a.csv", wide([], [()] * 5, ("x", "y", name)))
        assert_mouse(found)
        assert not codes(found)


def test_rows_without_a_frame_of_several_animals(tmp_path: Path) -> None:
    found = read(tmp_path / "a.csv", wide(["track"], [("ab"[i % 2],) for i in range(5)]))
    assert "and 2 identities (track): add a column 'frame'" in found.findings[0].message
    found = read(tmp_path / "a.csv", wide(["track"], [("ab"[i // 3],) for i in range(5)]))
    assert not codes(found)
    found = read(tmp_path / "a.csv", wide([""], [(i,) for i in range(5)]))
    assert not codes(found)
    found = read(tmp_path / "a.csv", wide([""], [(3 * i,) for i in range(5)]))
    assert "call it 'frame'" in found.findings[0].message


def test_several_videos_are_said(tmp_path: Path) -> None:
    lines = [("labeled-data", "ab"[i // 3], f"img{i % 3:03}.png") for i in range(5)]
    text = rows(
        ("scorer", "", "", *["me"] * 8),
        ("bodyparts", "", "", *[part for part in PARTS for _ in "xy"]),
        ("coords", "", "", *["x", "y"] * 4),
        *(
            (*names, *row)
            for names, row in zip(lines, VALUES[:, :, :2].reshape(5, -1).tolist(), strict=True)
        ),
    )
    found = read(tmp_path / "a.csv", text)
    assert "2 videos or cameras (a, b)" in found.findings[0].message
    cells = [("ab"[i // 3] + ".mp4", i) for i in range(5)]
    for name in ("video", "video_path", "file"):
        found = read(tmp_path / "a.csv", wide([name, "frame"], cells))
        assert codes(found) == {"videos"} and found.frames.numbers.tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    "form", ["{part}_{c} (px)", "{part}_{c}[px]", "{part}_{c}_px", "('{part}', '{c}')"]
)
def test_headers(form: str, tmp_path: Path) -> None:
    head = [form.format(part=p, c=c) for p in PARTS for c in ("x", "y", "score")]
    head = [f'"{cell}"' for cell in head]
    assert_mouse(read(tmp_path / "a.csv", rows(head, *VALUES.reshape(5, -1).tolist())))


def test_coordinates_in_another_unit_are_said(tmp_path: Path) -> None:
    head = [f"{p}_{c} (mm)" for p in PARTS for c in "xy"]
    found = read(tmp_path / "a.csv", rows(head, *VALUES[..., :2].reshape(5, -1).tolist()))
    assert "in mm by the names of its columns" in found.findings[0].message


@pytest.mark.parametrize("marks", [None, (), ("bodyparts", "coords"), ("", "")])
def test_two_header_rows(marks: tuple[str, ...] | None, tmp_path: Path) -> None:
    heads = [[part for part in PARTS for _ in range(3)], ["x", "y", "likelihood"] * 4]
    lines = VALUES.reshape(5, -1).tolist()
    if marks:
        heads = [[mark, *row] for mark, row in zip(marks, heads, strict=True)]
        lines = [[i, *row] for i, row in enumerate(lines)]
    if marks is None:  # cells that are merged, and a row of the scorer
        heads = [["DLC"] * 12, ["" if i % 3 else p for i, p in enumerate(heads[0])], heads[1]]
    assert_mouse(read(tmp_path / "a.csv", rows(*heads, *lines)))


def test_three_dimensions_are_refused(tmp_path: Path) -> None:
    values = VALUES.copy()
    values[..., 2] = np.random.default_rng(1).uniform(900, 1800, values.shape[:2])
    text = wide(["Frame"], [(i,) for i in range(5)], "xyz", values)
    assert "it is 3D (z changes: z of nose is" in complaint(tmp_path / "a.csv", text)
    columns = [("DLC_3D", part, c) for part in PARTS for c in "xyz"]
    text = deeplabcut(columns, values.reshape(5, -1), ("scorer", "bodyparts", "coords"))
    assert "it is 3D" in complaint(tmp_path / "a.csv", text)
    names = ("x", "y", "z", "error", "ncams", "score")
    more = np.concatenate([values, np.ones_like(values)], -1)
    more[..., 2] = 0
    text = wide(["fnum"], [(i,) for i in range(5)], names, more)
    assert "it is 3D (nose has z, error and ncams)" in complaint(tmp_path / "a.csv", text)
    lines = [
        (i, part, *xyz)
        for i, person in enumerate(values.tolist())
        for part, xyz in zip(PARTS, person, strict=True)
    ]
    text = rows(("frame", "joint", "x", "y", "z"), *lines)
    assert "it is 3D" in complaint(tmp_path / "a.csv", text)


def test_tables_of_several_cameras_and_without_names(tmp_path: Path) -> None:
    lines = VALUES[..., :2].reshape(5, -1).tolist()
    head = [f"pt{i}_cam1_{c}" for i in range(4) for c in "XY"]
    found = read(tmp_path / "a.csv", rows(head, *lines))
    assert found.points.shape == (5, 4, 2) and found.layout is None
    head = [f"pt{i}_cam{j}_{c}" for i in range(2) for j in (1, 2) for c in "XY"]
    assert "several cameras (cam1, cam2)" in complaint(tmp_path / "a.csv", rows(head, *lines))
    assert "no names of columns but numbers" in complaint(tmp_path / "a.csv", rows(*lines))
    text = 'nose,tail\n"(1, 2)","(3, 4)"\n'
    assert "several numbers, such as '(3, 4)'" in complaint(tmp_path / "a.csv", text)
    cells = [(i // 2, f"cam{i % 2}") for i in range(10)]
    found = read(tmp_path / "a.csv", wide(["frame", "camera"], cells, values=TWO))
    assert "2 videos or cameras (cam0, cam1)" in found.findings[0].message


def test_cells_with_a_unit_are_said(tmp_path: Path) -> None:
    text = wide([], [()] * 5)
    found = read(tmp_path / "a.csv", text.replace("\n", "px\n", 2).replace("scorepx", "score"))
    assert "1 of 58 cells are no numbers, such as '0.9px' in line 2" in found.findings[0].message
