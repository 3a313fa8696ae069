# SPDX-License-Identifier: Apache-2.0
"""Columns of a table are understood by the words of their names."""

from __future__ import annotations

import dataclasses

import pytest

from deep_nrsfm_ros.data.formats.columns import find_columns, find_parts, words

POINTS = [f"{name}_{c}" for name in ("nose", "tail") for c in "xy"]


def roles(*names: str, points: bool = False) -> dict[str, str | list[str]]:
    """Return what columns beside those of two keypoints mean."""
    head = [*names, *POINTS]
    found = find_columns(head, range(len(names), len(head)), has_points=points)
    values = dataclasses.asdict(found)
    return {
        role: head[value] if isinstance(value, int) else [head[i] for i in value]
        for role, value in values.items()
        if value not in (None, (), "") and role != "unit"
    }


@pytest.mark.parametrize(
    "name",
    [
        *("frame", "Frame", "frame_no", "frame_num", "framenum", "fnum", "frameNumber", "Frame #"),
        *("frame#", "frame_nr", "img", "image_path", "img_name", "imgname", "video_frame"),
        *("FrameID", "frame_i", "frame_idx", "image_id", "file_name", "filename", "img_path"),
    ],
)
def test_a_column_of_the_frame(name: str) -> None:
    assert roles(name) == {"frame": name}


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        *(("timestamp", ""), ("time", ""), ("t", ""), ("Timestamp", ""), ("header.stamp", "")),
        *(("Time (s)", "seconds"), ("time[ms]", "milliseconds"), ("seconds", "seconds")),
        *(("timestamp_usec", "microseconds"), ("timestampMs", "milliseconds")),
        *(("time_ns", "nanoseconds"), ("frame_time", ""), ("timestamp_us", "microseconds")),
    ],
)
def test_a_column_of_the_time(name: str, unit: str) -> None:
    assert roles(name) == {"time": [name]}
    assert find_columns([name], (), has_points=False).unit == unit


def test_seconds_and_nanoseconds_are_one_time() -> None:
    for pair in (["sec", "nanosec"], ["stamp_sec", "stamp_nanosec"], ["secs", "nsecs"]):
        assert roles(*pair) == {"time": pair}
    assert roles("time_s", "other_ns") == {"time": ["time_s"], "unused": ["other_ns"]}


@pytest.mark.parametrize(
    "name",
    [
        *("track", "id", "ID", "individual", "animal", "subject", "player", "body", "pid"),
        *("person_id", "trackId", "tracking_id", "object_id", "animal_name", "instance"),
    ],
)
def test_a_column_of_the_identity(name: str) -> None:
    assert roles(name) == {"identities": [name]}


def test_what_is_something_else() -> None:
    assert roles("frame_width", "bbox_width", "class", "exposure") == {
        "unused": ["exposure"],
    }
    assert roles("frame_rate", "latency_ms", "video") == {
        "video": "video",
        "unused": ["frame_rate", "latency_ms"],
    }


def test_the_surest_column_goes_first() -> None:
    assert roles("image_path", "frame", "instance", "track") == {
        "frame": "frame",
        "identities": ["track", "instance"],
        "unused": ["image_path"],
    }
    assert roles("instance.score", "track_score") == {"score": "instance.score"}


def test_a_keypoint_a_row() -> None:
    names = ("frame_idx", "node", "track", "x", "y", "track_score", "instance_score", "score")
    found = find_columns(names, (), has_points=True)
    assert (found.frame, found.keypoint, found.identities) == (0, 1, (2,))
    assert (found.x, found.y, found.score, found.confidence) == (3, 4, 6, 7)
    assert not found.unused
    found = find_columns(
        ["frame", "id", "x (px)", "y (px)", "z", "visibility"], (), has_points=True
    )
    assert (found.keypoint, found.x, found.y, found.z, found.confidence) == (1, 2, 3, 4, 5)


@pytest.mark.parametrize(
    "form",
    [
        *("{part}_{c}", "{part}.{c}", "{part} {c}", "{part}_{c} (px)", "{part}_{c} [px]"),
        *("{part}_{c}_px", "{c}_{part}", "('{part}', '{c}')", "('DLC', '{part}', '{c}')"),
        "{part} ({c})",
    ],
)
def test_a_column_for_each_coordinate(form: str) -> None:
    names = [form.format(part=p, c=c) for p in ("nose", "left_ear") for c in ("x", "y", "conf")]
    parts = find_parts(names)
    assert [(part.individual, part.name) for part in parts] == [("", "nose"), ("", "left_ear")]
    assert [dict(part.at) for part in parts] == [
        {"x": 0, "y": 1, "conf": 2},
        {"x": 3, "y": 4, "conf": 5},
    ]


def test_coordinates_without_a_mark_between() -> None:
    parts = find_parts(["noseX", "noseY", "noseScore", "EarLX", "EarLY", "EarLScore"])
    assert [part.name for part in parts] == ["nose", "EarL"]
    assert [set(part.at) for part in parts] == [{"x", "y", "score"}] * 2


@pytest.mark.parametrize("name", ["p", "prob", "vis", "visible", "certainty", "conf", "kp_score"])
def test_a_confidence_by_its_words(name: str) -> None:
    (part,) = find_parts(["nose_x", "nose_y", f"nose_{name}"])
    assert len(part.at) == 3 and part.is_complete


def test_individuals_have_the_same_keypoints() -> None:
    names = ("nose", "ear", "tail", "paw")
    for form in ("person{i}_{name}_{c}", "{name}_{c}_{i}"):
        head = [form.format(i=i, name=name, c=c) for i in (1, 2) for name in names for c in "xy"]
        parts = find_parts(head)
        assert {part.name for part in parts} == set(names)
        assert len({part.individual for part in parts}) == 2
    head = [f"fly.{i}.{name}.{c}" for i in (1, 2) for name in names for c in "xy"]
    assert len({part.name for part in find_parts(head)}) == 8
    legs = [f"leg{i}_{name}_{c}" for i in (1, 2) for name in names for c in "xy"]
    assert {part.individual for part in find_parts(legs)} == {""}


def test_a_box_is_no_keypoint() -> None:
    assert [part.name for part in find_parts([*POINTS, "bbox_x", "bbox_y"])] == ["nose", "tail"]


def test_words() -> None:
    assert words("frameNumber") == ["frame", "number"]
    assert words("Frame #") == ["frame"]
    assert words("trackid") == ["track", "id"]
    assert words("zeit_µs") == ["zeit", "µs"]
