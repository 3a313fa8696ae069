# SPDX-License-Identifier: Apache-2.0
"""Keypoints come from files of every kind alike, and what is wrong with one is said by name."""

from __future__ import annotations

import dataclasses
import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.data.bags import Frame, write_bag
from deep_nrsfm_ros.data.detections import Detections, gather, stamps_at
from deep_nrsfm_ros.data.keypoint_files import KeypointFileError, read_keypoints
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.presets import BODY25, COCO17
from deep_nrsfm_ros.lifting.observation import to_observation
from deep_nrsfm_ros.messages.decoding import MULTI_ARRAY

Q = len(COCO17)
OPTIONS = ReadOptions(layout=COCO17)
PERSON = json.dumps({"image_id": 5, "keypoints": [0] * 3 * Q})
COUNTS = (1, 0, 2, 3, 1)  # objects in each frame


@pytest.fixture
def seen() -> Detections:
    """Return five frames of 0 to 3 people at 10 Hz, some keypoints missing."""
    rng = np.random.default_rng(0)
    values = rng.uniform(1, 1000, (sum(COUNTS), Q, 3))
    values[..., 2] = rng.uniform(0.2, 1, values.shape[:2])
    values[rng.random(values.shape[:2]) < 0.1] = 0
    people = to_observation(values)
    parts = np.split(np.arange(len(values)), np.cumsum(COUNTS)[:-1])
    frames = [type(people)(people.points[p], people.confidence[p]) for p in parts]
    return gather(frames, stamps_at(10, len(COUNTS)), Q)


def triples(seen: Detections) -> list[list[float]]:
    both = np.concatenate([seen.points, seen.confidence[..., None]], -1)
    return both.astype(float).reshape(len(seen), -1).tolist()


def write_openpose(folder: Path, seen: Detections) -> list[str]:
    """Write a file a frame, named so that they sort as numbers only; return their texts."""
    folder.mkdir()
    texts, rows = [], triples(seen)
    for frame in range(len(seen.stamps)):
        people = [{"pose_keypoints_2d": rows[i]} for i in np.flatnonzero(seen.frame == frame)]
        texts.append(json.dumps({"people": people}))
        (folder / f"cam_{8 + frame}_keypoints.json").write_text(texts[-1])
    return texts


def assert_same(found: Detections, expected: Detections) -> None:
    for name in ("confidence", "frame", "identities", "stamps"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
    np.testing.assert_array_equal(found.points, expected.points)


def write(kind: str, folder: Path, seen: Detections) -> Path:
    """Write the same people as a file of any kind; return its path."""
    rows = triples(seen)
    if kind == "openpose folder":
        write_openpose(folder / "json", seen)
        return folder / "json"
    if kind.startswith("jsonl"):
        text = "\n".join(write_openpose(folder / "json", seen)).encode()
        path = folder / f"people.{kind}"
        path.write_bytes(gzip.compress(text) if kind.endswith("gz") else text)
        return path
    if kind.startswith("coco"):
        entries: list[dict[str, Any]] = [
            {"image_id": int(f), "keypoints": row, "score": 0.9}
            for f, row in zip(seen.frame, rows, strict=True)
        ]
        images = [{"id": i, "file_name": f"{i}.jpg"} for i in range(len(seen.stamps))]
        path = folder / "people.json"
        path.write_text(json.dumps({"images": images, "annotations": entries}))
        return path
    if kind == "npz":
        path = folder / "people.npz"
        order = np.arange(len(seen))[::-1]  # any order of frames will do
        np.savez(
            path,
            points=seen.points[order],
            confidence=seen.confidence[order],
            frame=seen.frame[order],
            identities=seen.identities[order],
            stamps=seen.stamps,
        )
        return path
    rows_of = [np.flatnonzero(seen.frame == f) for f in range(len(seen.stamps))]
    frames = (
        Frame(int(stamp), seen.points[rows], seen.confidence[rows])
        for stamp, rows in zip(seen.stamps, rows_of, strict=True)
    )
    input_type = {"input_type": MULTI_ARRAY} if "array" in kind else {}
    write_bag(folder / "bag", "/people", frames, kind.split()[0], **input_type)
    return folder / "bag"


KINDS = ("openpose folder", "jsonl", "jsonl.gz", "coco", "npz", "mcap", "sqlite3", "mcap array")
STAMPED = ("npz", "mcap", "sqlite3", "mcap array")


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_gives_the_same_people(kind: str, tmp_path: Path, seen: Detections) -> None:
    rate = None if kind in STAMPED else 10
    found = read_keypoints(write(kind, tmp_path, seen), ReadOptions(rate=rate, layout=COCO17))
    if kind == "npz":  # the objects of a frame stay in their order, which was turned round
        found = found[np.lexsort((found.identities, found.frame))]
    if kind == "openpose folder":  # the first file has number 8
        found = dataclasses.replace(found, stamps=found.stamps - 800_000_000)
    assert_same(found, seen)
    assert found.layout == COCO17 and not found.warnings


@pytest.mark.parametrize(
    ("sizes", "expected"),
    [
        ([(640, 480), (640, 480)], (640, 480)),
        ([(640, 480), (480, 640)], None),
        ([(640, 480), None], None),
        ([(640, 0), (640, 0)], None),
        ([(640, 10**400)], None),
        ([("640", 480.0)], None),
        ([], None),
    ],
)
def test_coco_says_the_size_of_all_its_images(
    tmp_path: Path, seen: Detections, sizes: list[Any], expected: Any
) -> None:
    images = [
        {"id": i, **(dict(zip(("width", "height"), size, strict=True)) if size else {})}
        for i, size in enumerate(sizes)
    ]
    people = [{"image_id": 0, "keypoints": triples(seen)[0]}]
    path = tmp_path / "people.json"
    path.write_text(json.dumps({"images": images, "annotations": people}))
    assert read_keypoints(path, OPTIONS).image_size == expected


def test_coco_results_without_images(tmp_path: Path, seen: Detections) -> None:
    rows = triples(seen)
    results = [
        {"image_id": f"{9 + f}.jpg", "keypoints": rows[i], "track_id": 7 + i}
        for i, f in reversed([*enumerate(seen.frame.tolist())])
    ]
    (tmp_path / "results.json").write_text(json.dumps(results))
    found = read_keypoints(tmp_path / "results.json", OPTIONS)
    assert found.frame.tolist() == [0, 1, 1, 2, 2, 2, 3]  # the frame of nobody is not told of
    assert sorted(found.identities.tolist()) == sorted(map(str, range(7, 14)))
    np.testing.assert_array_equal(found.points[0], seen.points[0])


def test_plain_npz_is_a_frame_each(tmp_path: Path, seen: Detections) -> None:
    np.savez(tmp_path / "a.npz", points=seen.points)
    found = read_keypoints(tmp_path / "a.npz", ReadOptions(rate=50, layout=COCO17))
    assert found.frame.tolist() == list(range(7)) and set(found.identities) == {"0"}
    assert found.stamps.tolist() == [20_000_000 * i for i in range(7)]
    np.testing.assert_array_equal(found.confidence > 0, (seen.points != 0).any(-1))


def test_largest_is_one_a_frame(seen: Detections) -> None:
    seen.points[seen.frame == 3] *= np.array([0.1, 1, 0.5], np.float32)[:, None, None]
    found = seen.largest()
    assert found.frame.tolist() == [0, 2, 3, 4]
    assert found.identities[2] == "1"
    np.testing.assert_array_equal(found.stamps, seen.stamps)


def test_low_confidence_is_missing(tmp_path: Path, seen: Detections) -> None:
    for kind in ("coco", "npz"):
        found = read_keypoints(
            write(kind, tmp_path, seen), ReadOptions(min_confidence=0.6, layout=COCO17)
        )
        assert (found.confidence > 0).sum() == (seen.confidence >= 0.6).sum()


@pytest.mark.parametrize(
    ("arrays", "expected"),
    [
        ({"poses": np.zeros(3)}, r"no array `points` \(objects, 17, 2\); there are: `poses`"),
        (
            {"points": np.zeros((4, 18, 2))},
            r"\(4, 18, 2\): its objects have 18 .* has 17",
        ),
        ({"points": np.array([["a"]])}, "`points` is <U1"),
        ({"points": np.array([None])}, "a.npz: array `points` holds Python objects.*astype"),
        ({"points": np.zeros((4, 17, 2)), "confidence": np.zeros(4)}, r"`confidence` is .*\(4,\)"),
        ({"points": np.zeros((2, 17, 2)), "frame": np.array([0, -1])}, "counted from 0"),
        ({"points": np.zeros((2, 17, 2)), "frame": np.array([0, 2**60])}, "at most 1000000 frames"),
        ({"points": np.zeros((2, 17, 2)), "frame": np.array([0, np.nan])}, "no whole one"),
        (
            {"points": np.zeros((2, 17, 2)), "identities": np.array(["a"])},
            r"`identities` is \(1,\); \(2,\)",
        ),
        ({"points": np.zeros((2, 17, 2)), "stamps": np.zeros(1)}, r"`stamps` is .* \(2,\)"),
    ],
)
def test_wrong_arrays_are_named(tmp_path: Path, arrays: dict[str, Any], expected: str) -> None:
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(KeypointFileError, match=expected):
        read_keypoints(tmp_path / "a.npz", OPTIONS)


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a.json", "{", "a.json: the file ends early"),
        ("a.json", "{}", "neither COCO"),
        ("a.json", "[1]", "neither COCO"),
        ("a.json", '[{"image_id": 1}]', "have no keypoints, but image_id"),
        ("a.json", '[{"image_id": 5, "keypoints": [1, 2, 3]}]', "have 1 keypoints.*has 17"),
        (
            "a.json",
            '{"people": [{"pose_keypoints_2d": [1, 2, 3]}]}',
            "have 1 keypoints; .* has 17",
        ),
        ("a.jsonl", '{"people": []}\n{"nobody": []}', "cannot be read .line 2: neither COCO"),
        ("a.json", f"[{PERSON.replace('5', '[5]')}]", "`image_id` that is neither"),
        (
            "a.json",
            f"[{PERSON.replace('[0,', '[{},', 1)}]",
            "keypoints that are no numbers",
        ),
        pytest.param("a.json", "[" * 100_000, "nested too deep", id="deep json"),
        pytest.param("a.jsonl", "[" * 100_000, "line 1: it is nested too deep", id="deep jsonl"),
        ("a.jsonl", "", "is empty"),
        ("a.jsonl.gz", "no gzip", "a.jsonl.gz: "),
        ("a.npz", "no zip", "a.npz: "),
        ("a.poses", "", "a.poses: it is of no known kind; expected a bag"),
        ("a.txt", "", r"a.txt: plain text .* np.save\(NEW, np.loadtxt\(FILE\).reshape"),
        ("a.MAT", "", "a.MAT: .*scipy.io.loadmat"),
        ("a.parquet", "", "pandas.read_parquet.*to_csv"),
        ("a.xlsx", "", "save it as .csv"),
        ("a.nwb", "", "pynwb"),
        ("a.bvh", "", "it is motion capture, which is 3D already"),
        ("a.c3d", "", "it is motion capture, which is 3D already"),
        ("a.pkl", "", "could run code"),
        ("a.yaml", "", "json.dump"),
        ("a.mp4", "", "run a detector first"),
        ("a.json.zip", "", "it is an archive: unpack it"),
        ("a.trc.gz", "", "it is compressed: unpack it"),
        ("a.mcap", "no bag", "a.mcap cannot be read"),
        ("folder/a.txt", "", "it holds .txt files: YOLO labels"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, name: str, text: str, expected: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    with pytest.raises(ValueError, match=expected):
        read_keypoints(path.parent if path.parent != tmp_path else path, OPTIONS)


@pytest.mark.parametrize("suffix", [".json.gz", ".ndjson", ".ndjson.gz", ".JSONL.GZ", ".csv.gz"])
def test_other_names_and_compressed_files_are_read(
    suffix: str, tmp_path: Path, seen: Detections
) -> None:
    if ".csv" in suffix:
        text = "frame," + ",".join(f"{name}_x,{name}_y" for name in COCO17.keypoints)
        rows = np.random.default_rng(0).uniform(1, 500, (3, 2 * Q))
        text += "".join(f"\n{i}," + ",".join(map(str, row)) for i, row in enumerate(rows))
    else:
        plain = write("coco" if suffix == ".json.gz" else "jsonl", tmp_path, seen)
        text = plain.read_text()
    path = tmp_path / f"other{suffix}"
    is_packed = suffix.lower().endswith(".gz")
    path.write_bytes(gzip.compress(text.encode()) if is_packed else text.encode())
    done = list[tuple[int, int]]()
    found = read_keypoints(path, OPTIONS, lambda *counts: done.append(counts))
    if ".csv" in suffix:
        np.testing.assert_allclose(found.points.reshape(3, -1), rows, rtol=1e-6)
        return
    assert_same(found, read_keypoints(plain, OPTIONS))
    assert all(0 <= part <= whole for part, whole in done) and done
    whole = path.read_bytes()
    if is_packed and ".json.gz" in suffix:
        path.write_bytes(whole[: len(whole) // 2])
        cut = read_keypoints(path, OPTIONS)
        assert [finding.code for finding in cut.findings] == ["damaged"]
        assert 0 < len(cut) < len(found)


def test_a_damaged_table_is_read_up_to_the_damage(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rows = "".join(f"{i},{x},{y}\n" for i, (x, y) in enumerate(rng.uniform(1, 9, (999, 2))))
    whole = gzip.compress(f"frame,nose_x,nose_y\n{rows}".encode())
    (tmp_path / "a.csv.gz").write_bytes(whole[: len(whole) // 2])
    found = read_keypoints(tmp_path / "a.csv.gz")
    assert 100 < len(found) < 900
    assert [finding.code for finding in found.findings] == ["damaged"]
    (tmp_path / "a.csv.gz").write_bytes(b"frame,nose_x,nose_y")
    with pytest.raises(KeypointFileError, match="a.csv.gz: Not a gzipped file"):
        read_keypoints(tmp_path / "a.csv.gz")


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(KeypointFileError, match="nowhere does not exist"):
        read_keypoints(tmp_path / "nowhere", OPTIONS)


def test_bags_of_another_layout_say_so(tmp_path: Path, seen: Detections) -> None:
    with pytest.raises(ValueError, match=r"no readable message in .*bag \(5 found\).* has 25"):
        read_keypoints(write("mcap", tmp_path, seen), ReadOptions(layout=BODY25))
