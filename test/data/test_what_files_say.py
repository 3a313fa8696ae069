# SPDX-License-Identifier: Apache-2.0
"""What a file says of itself is used; an odd entry is left out and named, and the rest is read."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.formats.frame_numbers import numbers_in
from deep_nrsfm_ros.data.formats.json_items import JsonItem, json_items
from deep_nrsfm_ros.data.formats.names import layout_of_names, misspelt, preset_spelling
from deep_nrsfm_ros.data.keypoint_files import KeypointFileError, read_keypoints
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.presets import BODY25, COCO17, HUMAN17, LAYOUTS
from deep_nrsfm_ros.lifting.sanity import check

Q = len(COCO17)


def person(seed: int = 0, q: int = Q) -> list[float]:
    """Return x, y, confidence of q keypoints, one after the other."""
    values = np.random.default_rng(seed).uniform(100, 500, (q, 3))
    values[:, 2] = 0.9
    return values.ravel().tolist()


def pairs(seed: int = 0) -> list[list[float]]:
    return np.reshape(person(seed), (Q, 3))[:, :2].tolist()


def save(path: Path, content: Any) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def read(path: Path, content: Any, **options: Any) -> Detections:
    return read_keypoints(save(path, content), ReadOptions(**options))


def openpose(*people: list[float], **fields: Any) -> dict[str, Any]:
    return {"people": [{"pose_keypoints_2d": p, **fields} for p in people]}


def test_nobody_and_odd_entries_leave_the_others(tmp_path: Path) -> None:
    folder = tmp_path / "json"
    contents: list[Any] = [
        openpose(person()),
        openpose([], person(1)),
        openpose([]),
        openpose(person(2), [1, 2, 3]),
        {"people": [{"pose_keypoints_2d": None}, {"face_keypoints_2d": [1]}, 5]},
        {"people": []},
        "",
        '{"people": [',
    ]
    for i, content in enumerate(contents):
        save(folder / f"clip_{i:04}_keypoints.json", content)
        save(folder / f"._clip_{i:04}_keypoints.json", "\0Mac OS X")
    save(folder / "calibration.json", {"K": [[1, 0, 0]]})
    save(folder / "notes.txt", "mine")
    (folder / "rendered.png").touch()
    found = read_keypoints(folder, ReadOptions(layout=COCO17))
    assert found.frame.tolist() == [0, 1, 3] and len(found.stamps) == 6
    text = "\n".join(found.warnings)
    for expected in (
        "8 that are hidden files (._clip_0000_keypoints.json, ",
        "1 that are no .json files (notes.txt)",
        "3 that have no keypoints (clip_0001_keypoints.json, clip_0002",
        "1 that have no keypoints, but face_keypoints_2d (clip_0004",
        "1 that are no object (clip_0004_keypoints.json: 5)",
        "1 that have 1 keypoints, not 17 (clip_0003_keypoints.json)",
        "3 that cannot be read (calibration.json: neither COCO",
    ):
        assert expected in text
    assert "png" not in text


def test_only_what_leaves_nothing_is_an_error(tmp_path: Path) -> None:
    save(tmp_path / "json" / "calibration.json", {"K": []})
    with pytest.raises(KeypointFileError, match="no file in it has keypoints; .*calibration.json"):
        read_keypoints(tmp_path / "json")
    found = read(tmp_path / "a.json", openpose([]), layout=COCO17)
    assert len(found) == 0 and found.points.shape == (0, Q, 2)


def test_numbers_in_file_names_are_times(tmp_path: Path) -> None:
    for number in (0, 3, 25, 100):
        save(tmp_path / "json" / f"cam2_{number}_keypoints.json", openpose(person()))
    found = read_keypoints(tmp_path / "json", ReadOptions(layout=COCO17))
    assert found.frames.numbers.tolist() == [0, 3, 25, 100]
    assert found.frames.names[2] == "cam2_25_keypoints.json"
    assert (found.stamps / 1e9).round(3).tolist() == [0, 0.1, 0.833, 3.333]


def test_numbers_of_images_are_times(tmp_path: Path) -> None:
    images = [{"id": 70 + i, "file_name": f"f{n}.jpg"} for i, n in enumerate((12, 2, 9))]
    entries = [{"image_id": 70 + i, "keypoints": person(i)} for i in range(3)]
    content = {"annotations": entries, "images": images}
    found = read(tmp_path / "a.json", content, rate=1, layout=COCO17)
    assert found.frames.numbers.tolist() == [2, 9, 12]
    assert found.frames.names.tolist() == ["f2.jpg", "f9.jpg", "f12.jpg"]
    assert found.stamps.tolist() == [2_000_000_000, 9_000_000_000, 12_000_000_000]
    assert found.points[0, 0].tolist() == np.array(person(1)[:2], np.float32).tolist()


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["a7b10.json", "a7b9.json"], [10, 9]),
        (["cam1_5", "cam2_5"], [1, 2]),
        (["cam1_5", "cam2_6"], None),
        (["a5", "b6"], None),
        (["a5", "a05"], None),
        (["img_25_keypoints"], [25]),
        (["9" * 30], None),
        (["a"], None),
        ([], None),
    ],
)
def test_numbers_in_names(names: list[str], expected: list[int] | None) -> None:
    found = numbers_in(names)
    assert (None if found is None else found.tolist()) == expected


def test_numbers_that_are_times_of_day_are_no_frames(tmp_path: Path) -> None:
    for i in range(3):
        save(tmp_path / "json" / f"{1_700_000_000_000 + 40 * i}.json", openpose(person()))
    found = read_keypoints(tmp_path / "json", ReadOptions(rate=25, layout=COCO17))
    assert found.stamps.tolist() == [0, 40_000_000, 80_000_000]
    assert "1700000000080 are no count at a rate" in found.warnings[0]


@pytest.mark.parametrize("field", ["person_id", "idx", "track_id"])
def test_identities_of_the_file(tmp_path: Path, field: str) -> None:
    people = [
        {"keypoints": person(i), "image_id": i // 3, field: value}
        for i, value in enumerate([4, [9], -1, [-1], 4.0, "anna"])
    ]
    found = read(tmp_path / "a.json", people, layout=COCO17)
    assert found.identities.tolist() == ["4", "9", "", "", "4", "anna"]


def test_one_identity_twice_in_a_frame(tmp_path: Path) -> None:
    people = [{"keypoints": person(i), "image_id": 0, "idx": 3} for i in range(3)]
    found = read(tmp_path / "a.json", people, layout=COCO17)
    assert found.identities.tolist() == ["3", "", ""]
    assert "2 objects have the identity of another" in found.warnings[0]


def test_no_identities_are_the_index(tmp_path: Path) -> None:
    content = openpose(person(), person(1), person_id=[-1])
    assert read(tmp_path / "a.json", content, layout=COCO17).identities.tolist() == ["0", "1"]


@pytest.mark.parametrize("key", ["keypoints", "pose_keypoints", "pose_keypoints_2d"])
def test_keypoints_of_any_form(tmp_path: Path, key: str) -> None:
    flat = person()
    triples = np.reshape(flat, (Q, 3))
    scores = triples[:, 2].tolist()
    forms: list[dict[str, Any]] = [
        {key: flat},
        {key: triples.tolist()},
        {key: [triples.tolist()]},
        {key: pairs(), "keypoint_scores": scores},
        {key: pairs(), "scores": scores},
        {key: triples[:, :2].ravel().tolist(), "scores": scores},
        {key: [{"x": x, "y": y, "score": s} for x, y, s in triples.tolist()]},
    ]
    for i, form in enumerate(forms):
        found = read(tmp_path / f"{i}.json", {"people": [form]}, layout=COCO17)
        np.testing.assert_array_equal(found.points[0], triples[:, :2].astype(np.float32))
        np.testing.assert_allclose(found.confidence, 0.9)
    for plain in (pairs(), triples[:, :2].ravel().tolist()):
        found = read(tmp_path / "plain.json", {"people": [{key: plain}]}, layout=COCO17)
        assert (found.confidence == 1).all() and len(found) == 1


@pytest.mark.parametrize("people", [1, 2])
def test_arrays_as_lists_are_read_as_npy_is(tmp_path: Path, people: int) -> None:
    array = np.array([[person(10 * f + i) for i in range(people)] for f in range(3)])
    array = array.reshape(3, people, Q, 3)
    array = array[:, 0] if people == 1 else array
    np.save(tmp_path / "a.npy", array)
    expected = read_keypoints(tmp_path / "a.npy", ReadOptions(layout=COCO17))
    flat = array.reshape(*array.shape[:-2], 3 * Q)
    for content in (array.tolist(), flat.tolist()):
        found = read(tmp_path / "a.json", content, layout=COCO17)
        np.testing.assert_array_equal(found.points, expected.points)
        np.testing.assert_array_equal(found.confidence, expected.confidence)
        np.testing.assert_array_equal(found.frame, expected.frame)
        assert not found.warnings


def test_keypoints_by_name_make_the_layout(tmp_path: Path) -> None:
    triples = np.reshape(person(), (Q, 3)).tolist()
    named = dict(zip(COCO17.keypoints, triples, strict=True))
    fields = {name: {"x": x, "y": y, "confidence": s} for name, (x, y, s) in named.items()}
    reordered = dict(reversed(fields.items()))
    for content in ([named] * 2, [fields] * 2, [reordered] * 2, [[{"keypoints": fields}]] * 2):
        found = read(tmp_path / "a.json", content)
        assert found.layout is not None and found.frame.tolist() == [0, 1]
        order = [found.layout.keypoints.index(name) for name in COCO17.keypoints]
        np.testing.assert_allclose(found.points[1, order], np.array(triples)[:, :2], rtol=1e-6)
        np.testing.assert_allclose(found.confidence, 0.9)


def test_names_say_the_places_of_keypoints(tmp_path: Path) -> None:
    """Frames may give them in another order, or lack some, which later frames have."""
    names = COCO17.keypoints
    whole = dict(zip(names, np.reshape(person(), (Q, 3)).tolist(), strict=True))
    backwards = dict(reversed(whole.items()))
    lacking = {name: whole[name] for name in names[3:]}
    null: dict[str, Any] = {**whole, "left_ear": None}
    frames = [lacking, whole, backwards, null]
    fields = [
        [{"name": name, "x": v[0], "y": v[1], "score": v[2]} for name, v in frame.items() if v]
        for frame in frames
    ]
    for content in (
        frames,
        [{"frame": 10 * i, "track_id": 7, **frame} for i, frame in enumerate(frames)],
        [{"keypoints": one, "frame": 10 * i} for i, one in enumerate(fields)],
    ):
        found = read(tmp_path / "a.json", content)
        assert not found.warnings and found.frame.tolist() == [0, 1, 2, 3]
        assert found.layout and found.layout.keypoints == (*names[3:], *names[:3])
        at = found.layout.keypoints.index
        for name, value in whole.items():
            seen = found.confidence[:, at(name)] > 0
            assert seen.tolist() == [name in names[3:], True, True, name != "left_ear"]
            np.testing.assert_allclose(found.points[seen, at(name), 0], value[0], rtol=1e-6)
    found = read(tmp_path / "a.json", [{"track_id": 7, "time": i / 10, **whole} for i in range(3)])
    assert found.layout is COCO17 and found.identities.tolist() == ["7"] * 3
    assert np.diff(found.stamps).tolist() == [100_000_000] * 2


def test_a_list_of_a_few_numbers_is_no_object(tmp_path: Path) -> None:
    for content in ([[1, 2]], [[[1, 2], [3, 4]]], [{"a": 1, "b": 2, "c": 3}]):
        with pytest.raises(KeypointFileError):
            read(tmp_path / "a.json", content, layout=COCO17)


def test_null_and_nan_are_missing(tmp_path: Path) -> None:
    values = person()
    values[3:6], values[6:9] = [None, None, 0], [float("nan"), 1, 1]  # type: ignore[list-item]
    found = read(tmp_path / "a.json", [{"image_id": 1, "keypoints": values}], layout=COCO17)
    assert found.confidence[0, :4].tolist() == [np.float32(0.9), 0, 0, np.float32(0.9)]


RIGHT_FIRST = [
    COCO17.keypoints[i + 1 if i % 2 else i - 1] if i else COCO17.keypoints[0] for i in range(Q)
]


def coco(names: list[str], **more: Any) -> dict[str, Any]:
    entry = {"image_id": 1, "category_id": 1, "keypoints": person()}
    return {
        "annotations": [entry],
        "categories": [{"id": 1, "name": "person", "keypoints": names}],
        **more,
    }


def test_names_of_a_category_make_the_layout(tmp_path: Path) -> None:
    found = read(tmp_path / "a.json", coco(RIGHT_FIRST), fallback=HUMAN17)
    assert found.layout and found.layout.keypoints == tuple(RIGHT_FIRST)
    found = read(tmp_path / "a.json", coco(list(COCO17.keypoints)), fallback=HUMAN17)
    assert found.layout is COCO17


def test_names_that_contradict_the_layout_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(KeypointFileError, match="keypoint 1 is right_eye, that of coco17 is le"):
        read(tmp_path / "a.json", coco(RIGHT_FIRST), layout=COCO17)
    german = [f"Punkt {i}" for i in range(Q)]
    assert read(tmp_path / "a.json", coco(german), layout=COCO17).layout is COCO17
    many = [str(i) for i in range(18)]
    with pytest.raises(KeypointFileError, match="it names 18 keypoints, coco17 has 17"):
        read(tmp_path / "a.json", coco(many), layout=COCO17)


def test_one_category_is_chosen(tmp_path: Path) -> None:
    dog = [f"dog_{i}" for i in range(5)]
    content = coco(list(COCO17.keypoints))
    content["categories"].append({"id": 2, "name": "dog", "keypoints": dog})
    content["categories"].append({"id": 3, "name": "car"})
    content["annotations"] += [
        {"image_id": 1, "category_id": 2, "keypoints": person(1, 5)},
        {"image_id": 1, "category_id": 3, "bbox": [1, 2, 3, 4]},
    ]
    with pytest.raises(KeypointFileError, match=r"person \(1\), dog \(2\); choose one with --cat"):
        read(tmp_path / "a.json", content)
    for name in ("dog", "2"):
        found = read(tmp_path / "a.json", content, category=name)
        assert found.layout and found.layout.keypoints == tuple(dog) and len(found) == 1
    with pytest.raises(KeypointFileError, match="no category 'cat' with keypoints; there are: per"):
        read(tmp_path / "a.json", content, category="cat")


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["Nose", "LShoulder", "RBigToe"], ["nose", "left_shoulder", "right_big_toe"]),
        (["shoulder_l", "Left Knee", "right-ankle"], ["left_shoulder", "left_knee", "right_ankle"]),
        (["leftElbow", "lshoulder", "REye"], ["left_elbow", "left_shoulder", "right_eye"]),
        (["snout", "TailBase", "l"], ["snout", "TailBase", "l"]),
    ],
)
def test_spelling_of_names(names: list[str], expected: list[str]) -> None:
    assert [preset_spelling(name) for name in names] == expected


def test_names_of_a_preset_are_the_preset() -> None:
    assert layout_of_names(list(BODY25.keypoints)) is BODY25
    assert layout_of_names([n.title().replace("_", " ") for n in COCO17.keypoints]) is COCO17


def instance(seed: int, **more: Any) -> dict[str, Any]:
    scores = [0.9] * Q
    return {"keypoints": pairs(seed), "keypoint_scores": scores, "bbox_score": 0.8, **more}


def test_mmpose(tmp_path: Path) -> None:
    names = {str(i): name for i, name in enumerate(COCO17.keypoints)}
    frames = [
        {"frame_id": 1, "instances": [instance(0, track_id=5), instance(1, track_id=6)]},
        {"frame_id": 3, "instances": []},
        {"frame_id": 4, "instances": [instance(2)]},
    ]
    for meta in (
        {"dataset_name": "coco", "keypoint_id2name": names},
        {"dataset_name": "coco"},
    ):
        content = {"meta_info": meta, "instance_info": frames}
        found = read(tmp_path / "video.json", content, fallback=HUMAN17)
        assert found.layout is COCO17
        assert found.frames.numbers.tolist() == [1, 3, 4] and found.frame.tolist() == [0, 0, 2]
        assert found.identities.tolist() == ["5", "6", ""]
        assert found.scores.tolist() == [np.float32(0.8)] * 3
    people = [instance(0), instance(1)]
    for image in (people, {"predictions": [people]}):
        found = read(tmp_path / "image.json", image, layout=COCO17)
        assert found.frame.tolist() == [0, 0]
        assert found.frames.names.tolist() == ["image.json"]


def test_alphapose_by_image(tmp_path: Path) -> None:
    content = {f"{i}.jpg": {"version": "v0.3", **openpose(person(i))} for i in (3, 7)}
    found = read(tmp_path / "a.json", content, layout=COCO17)
    assert found.frames.names.tolist() == ["3.jpg", "7.jpg"] and len(found) == 2
    bodies = {"1.jpg": {"version": "0.1", "bodies": [{"joints": person()}]}}
    assert len(read(tmp_path / "a.json", bodies, layout=COCO17)) == 1


def test_scores_leave_people_out(tmp_path: Path) -> None:
    people = [
        {"image_id": 0, "keypoints": person(i), "score": score}
        for i, score in enumerate((0.9, 0.2, 2.5))
    ]
    found = read(tmp_path / "a.json", people, layout=COCO17, min_score=0.5)
    assert found.scores.tolist() == [np.float32(0.9), 2.5]
    assert found.warnings == ("left out: 1 that have a score below --min-score 0.5",)
    for entry in people:
        del entry["score"]
    with pytest.raises(KeypointFileError, match="no object a score: leave out --min-score"):
        read(tmp_path / "a.json", people, layout=COCO17, min_score=0.5)


def test_the_largest_is_no_ghost(tmp_path: Path) -> None:
    sizes = {0.2: 10.0, 0.8: 1.0, 0.9: 0.5}
    people = [
        {"image_id": 0, "keypoints": (np.array(person()) * size).tolist(), "score": score}
        for score, size in sizes.items()
    ]
    found = read(tmp_path / "a.json", people, layout=COCO17)
    assert found.largest().scores.tolist() == [np.float32(0.8)]


def test_a_mark_of_missing_keypoints(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(50, 900, (60, Q, 2))
    points[::2, 3] = -1
    np.savez(tmp_path / "a.npz", points=points)
    found = read_keypoints(tmp_path / "a.npz")
    (finding,) = check(found.points, found.confidence)
    assert "--missing-value=-1 for files" in finding.message
    found = read_keypoints(tmp_path / "a.npz", ReadOptions(missing_value=-1))
    assert not found.warnings and (found.confidence == 0).sum() == 30
    assert not found.points[::2, 3].any()


def test_arrays_of_others(tmp_path: Path) -> None:
    path, points = tmp_path / "a.npz", np.ones((6, Q, 2))
    np.savez(
        path, points=points, metadata=np.array({"w": 1280}, object), ids=np.array(["a"] * 6, object)
    )
    found = read_keypoints(path, ReadOptions(layout=COCO17))
    assert len(found) == 6 and not found.warnings
    np.savez(path, points=points, identities=np.array(["a"] * 6, object))
    assert "`identities` holds Python objects" in read_keypoints(path).warnings[0]
    np.savez(path, positions_2d=np.array({"S1": {}}, object), metadata=np.array({}, object))
    with pytest.raises(KeypointFileError, match=r"VideoPose3D's data_2d_\*.npz .*np.savez\(NEW"):
        read_keypoints(path)
    objects = np.array([None, [1]], object)
    np.savez(path, boxes=objects, keypoints=objects, segments=objects)
    with pytest.raises(KeypointFileError, match="detections of Detectron.*`keypoints`"):
        read_keypoints(path)


def test_arrays_name_their_keypoints_and_frames(tmp_path: Path) -> None:
    np.savez(
        tmp_path / "a.npz",
        points=np.ones((3, Q, 2)),
        names=np.array(COCO17.keypoints),
        frame_numbers=np.array([4, 5, 9]),
        frame_names=np.array(["a", "b", "c"]),
        scores=np.array([0.1, 0.9, 0.9]),
    )
    found = read_keypoints(tmp_path / "a.npz", ReadOptions(rate=1, min_score=0.5))
    assert found.layout is COCO17 and found.frame.tolist() == [1, 2]
    assert found.stamps.tolist() == [4_000_000_000, 5_000_000_000, 9_000_000_000]
    assert found.frames.names.tolist() == ["a", "b", "c"]


def test_plain_arrays(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(1, 9, (4, 2, Q, 3))
    np.save(tmp_path / "a.npy", points)
    found = read_keypoints(tmp_path / "a.npy", ReadOptions(rate=10))
    assert found.frame.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert found.stamps.tolist() == [0, 100_000_000, 200_000_000, 300_000_000]
    np.save(tmp_path / "a.npy", points[:, 0, :, :2])
    assert read_keypoints(tmp_path / "a.npy").frame.tolist() == [0, 1, 2, 3]
    np.save(tmp_path / "a.npy", np.array([{}], object))
    with pytest.raises(KeypointFileError, match="it holds Python objects"):
        read_keypoints(tmp_path / "a.npy")


def test_an_option_that_cannot_act_is_an_error(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", points=np.ones((1, Q, 2)), stamps=np.array([5]))
    for options, expected in (
        (ReadOptions(topic="/people"), "--topic has no effect on a file that is no bag"),
        (ReadOptions(category="dog"), "--category has no effect on a file that is not COCO"),
        (ReadOptions(rate=5), "`stamps` of its own: leave out --rate"),
        (ReadOptions(min_score=0.5), "no array `scores`"),
    ):
        with pytest.raises(KeypointFileError, match=expected):
            read_keypoints(tmp_path / "a.npz", options)


def test_a_file_that_ends_early_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    text = json.dumps([{"image_id": i, "keypoints": person(i)} for i in range(5)])
    found = read(tmp_path / "a.json", text[:-300], layout=COCO17)
    (finding,) = found.findings
    assert len(found) == 4 and finding.code == "damaged"
    end = f"the file ends early at character {len(text) - 300}, after 4 whole elements"
    assert "read up to a damaged place" in finding.message and end in finding.message
    broken = text.replace('"image_id": 2', '"image_id" 2')
    found = read(tmp_path / "a.json", broken, layout=COCO17)
    place = broken.index('"image_id" 2') + len('"image_id" ')
    assert f"at character {place}, after 2 whole elements" in found.findings[0].message
    with pytest.raises(KeypointFileError, match="a.json: the file is empty"):
        read(tmp_path / "a.json", " ")
    lines = gzip.compress("\n".join(json.dumps(openpose(person())) for _ in range(200)).encode())
    (tmp_path / "a.jsonl.gz").write_bytes(lines[:-200])
    found = read_keypoints(tmp_path / "a.jsonl.gz", ReadOptions(layout=COCO17))
    assert f"after {len(found)} frames" in found.findings[0].message


class Slow:
    """A file that gives a few bytes at a time."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def read(self, size: int = -1, /) -> bytes:
        part, self.data = self.data[:3], self.data[3:]
        return part


def test_items_of_a_document_in_parts() -> None:
    text = '\ufeff{"a": [1, [2, "ü]"], {}], "b": 1234567, "c": [], "d": {"e": [1]}}'
    assert list(json_items(Slow(text.encode()))) == [
        JsonItem("a", 1, True),
        JsonItem("a", [2, "ü]"], True),
        JsonItem("a", {}, True),
        JsonItem("b", 1234567, False),
        JsonItem("c", [], False),
        JsonItem("d", {"e": [1]}, False),
    ]
    assert list(json_items(Slow(b"[12, 345]"))) == [
        JsonItem(None, 12, True),
        JsonItem(None, 345, True),
    ]
    with pytest.raises(ValueError, match="ends early"):
        list(json_items(Slow(b'[1, {"a": 2')))
    with pytest.raises(ValueError, match="after its end"):
        list(json_items(Slow(b"[1] 2")))


def test_normalised_keypoints_become_pixels(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0.1, 1, (4, Q, 2))
    points[0, 0] = -1
    np.save(tmp_path / "a.npy", points)
    options = ReadOptions(image_size=(1280, 720), missing_value=-1)
    found = read_keypoints(tmp_path / "a.npy", options)
    np.testing.assert_allclose(found.points[1:], points[1:] * [1280, 720], rtol=1e-5)
    assert found.confidence[0, 0] == 0
    np.save(tmp_path / "a.npy", points * 500)
    found = read_keypoints(tmp_path / "a.npy", options)
    np.testing.assert_allclose(found.points[1:], points[1:] * 500, rtol=1e-5)


@pytest.mark.parametrize(
    ("box", "is_doubted"),
    [
        ([100, 100, 400, 400], False),
        ([100, 100, 500, 500], False),  # two corners
        ([[100, 100, 500, 500]], False),  # of MMPose
        ([1, 2, 3, 4], False),  # a placeholder
        (None, False),
        ({"x": 1}, False),
        ([10**400, 1, 2, 3], False),
        ([900, 700, 400, 400], True),
        ([900, 700, 1300, 1100], True),
    ],
)
def test_keypoints_that_are_not_in_their_box(tmp_path: Path, box: Any, is_doubted: bool) -> None:
    people = [{"image_id": i, "keypoints": person(i), "bbox": box} for i in range(5)]
    found = read(tmp_path / "a.json", people, layout=COCO17)
    assert [f.code for f in found.findings] == ["crop"] * is_doubted


def test_times_of_frames(tmp_path: Path) -> None:
    """They are read in any unit; frames without a number follow one another."""
    for field, unit, said in (
        ("timestamp", 1.0, "taken for seconds"),
        ("timestamp", 1e3, "taken for milliseconds"),
        ("time", 1e6, "taken for microseconds"),
        ("timestamp_ms", 1e3, ""),
    ):
        times = [0.0, 0.1, 0.2, 0.5]
        frames = [{field: unit * (50 + t), **openpose(person(i))} for i, t in enumerate(times)]
        found = read(tmp_path / "a.json", {"frames": frames}, layout=COCO17)
        assert found.frame.tolist() == [0, 1, 2, 3]
        assert (found.stamps - found.stamps[0]).tolist() == [round(t * 1e9) for t in times]
        assert any(said in warning for warning in found.warnings) == bool(said)
    with pytest.raises(KeypointFileError, match="times of its own: leave out --rate"):
        read(tmp_path / "a.json", {"frames": frames}, layout=COCO17, rate=10)


def test_a_list_of_results_of_mediapipe_is_frames(tmp_path: Path) -> None:
    """MediaPipe gives a result for each image, however a script writes the list of them."""
    persons = [
        [{"x": x, "y": y, "z": 0.0, "visibility": 0.9} for x, y in np.array(pairs(i)) / 1000]
        for i in range(3)
    ]
    size = (1000, 1000)
    for content in (
        [{"pose_landmarks": one} for one in persons],
        [{"pose_landmarks": [one]} for one in persons],
        [{"pose_landmarks": {"landmark": one}} for one in persons],
        [{"landmarks": one} for one in persons],
        persons,
        [[one] for one in persons],
        {"frames": persons},
    ):
        found = read(tmp_path / "a.json", content, layout=COCO17, image_size=size)
        assert found.frame.tolist() == [0, 1, 2] and not found.warnings
        assert found.frames.numbers.tolist() == [0, 1, 2]
        np.testing.assert_allclose(found.points[2], pairs(2), rtol=1e-5)
    nobody = [{"pose_landmarks": value} for value in (persons[0], [], None, persons[1])]
    found = read(tmp_path / "a.json", nobody, layout=COCO17, image_size=size)
    assert found.frame.tolist() == [0, 3] and len(found.stamps) == 4 and not found.warnings
    found = read(tmp_path / "a.json", persons[0], layout=COCO17, image_size=size)
    assert found.points.shape == (1, Q, 2)


def test_results_of_mediapipe_in_a_document_of_a_frame_are_people(tmp_path: Path) -> None:
    person_ = [{"x": x, "y": y, "visibility": 0.9} for x, y in pairs()]
    other = [{"x": x, "y": y, "visibility": 0.9} for x, y in pairs(1)]
    both = [{"landmarks": person_}, {"landmarks": other}]
    lines = "\n".join([json.dumps(both)] * 2)
    assert read(tmp_path / "a.jsonl", lines, layout=COCO17).frame.tolist() == [0, 0, 1, 1]
    named = [{**one, "track_id": i} for i, one in enumerate(both)]
    assert read(tmp_path / "a.json", named, layout=COCO17).frame.tolist() == [0, 0]
    timed = [{**one, "timestamp_ms": 40 * i} for i, one in enumerate(both)]
    assert read(tmp_path / "a.json", timed, layout=COCO17).stamps.tolist() == [0, 40_000_000]


def test_one_object_many_times_in_a_frame_is_doubted(tmp_path: Path) -> None:
    moved = [(np.reshape(person(), (Q, 3)) + [3 * i, 0, 0]).tolist() for i in range(6)]
    found = read(tmp_path / "a.json", [{"keypoints": one} for one in moved], layout=COCO17)
    assert "all 6 objects are of one frame" in found.findings[0].message
    side = [(np.reshape(person(i), (Q, 3)) + [500 * i, 0, 0]).tolist() for i in range(6)]
    found = read(tmp_path / "a.json", [{"keypoints": one} for one in side], layout=COCO17)
    assert not found.findings and len(found.stamps) == 1


def test_a_place_is_named_once(tmp_path: Path) -> None:
    content = [{"image_id": 1, "keypoints": person()}, *[{"image_id": 1, "box": [1]}] * 5]
    found = read(tmp_path / "a.json", content, layout=COCO17)
    assert found.warnings == ("left out: 5 that have no keypoints, but image_id, box (a.json)",)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["left_knie", "RIGHT_ANCLE"], {"left_knie": "left_knee", "RIGHT_ANCLE": "right_ankle"}),
        (["left_knie", "left_knee"], {}),  # none is missing
        (["left_knie", "left_heel", "left_hand", "chin"], {"left_knie": "left_knee"}),
        (["Left Hand", "tail_base", "knie_right"], {"knie_right": "right_knee"}),
    ],
)
def test_names_that_are_nearly_those_of_a_model(names: list[str], expected: Any) -> None:
    wanted = [*COCO17.keypoints[:13], "left_knee", "right_knee", "right_ankle"]
    assert misspelt(names, wanted) == expected


def test_too_few_names_are_the_fault(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", points=np.ones((2, Q, 2)), names=np.array(COCO17.keypoints[:16]))
    with pytest.raises(KeypointFileError, match="its `names` are 16, and `points` has 17 keypo"):
        read_keypoints(tmp_path / "a.npz")
    with pytest.raises(KeypointFileError, match="have 17 keypoints, and it names 16: correct"):
        read(tmp_path / "a.json", coco(list(COCO17.keypoints[:16])))


def test_confidence_of_0_to_100_is_doubted(tmp_path: Path) -> None:
    """It is read as ever: what is above 1 counts as 1."""
    values = np.reshape(person(), (Q, 3)) * [1, 1, 100]
    np.save(tmp_path / "a.npy", np.tile(values, (3, 1, 1)))
    people = [{"image_id": 0, "keypoints": values.ravel().tolist()}]
    for found in (
        read(tmp_path / "a.json", people, layout=COCO17),
        read_keypoints(tmp_path / "a.npy"),
    ):
        assert [f.code for f in found.findings] == ["confidence-scale"]
        assert "up to 90: it must be 0 to 1" in found.findings[0].message
        assert (found.confidence == 1).all()


def test_landmarks_of_mediapipe_say_their_layout(tmp_path: Path) -> None:
    rows = np.reshape(person(q=33), (33, 3)).tolist()
    landmarks = [{"x": x / 640, "y": y / 640, "visibility": c} for x, y, c in rows]
    frames = [{"pose_landmarks": landmarks}] * 3
    size = {"image_size": (640, 640)}
    for options in (size, {**size, "fallback": HUMAN17}):
        found = read(tmp_path / "a.json", frames, **options)
        assert found.layout is LAYOUTS["mediapipe33"] and len(found) == 3
    with pytest.raises(KeypointFileError, match="have 33 keypoints; the keypoint layout coco17"):
        read(tmp_path / "a.json", frames, **size, layout=COCO17)
    hand = read(tmp_path / "b.json", [{"landmarks": landmarks[:21]}] * 3, **size)
    assert hand.layout is None


def test_frames_by_name_or_number(tmp_path: Path) -> None:
    points = np.reshape(person(), (Q, 3)).tolist()
    named = dict(zip(COCO17.keypoints, points, strict=True))
    found = read(tmp_path / "a.json", {str(i): named for i in (3, 1, 2)})
    assert found.layout is COCO17 and found.frames.numbers.tolist() == [1, 2, 3]
    rows = read(tmp_path / "b.json", {f"image_{i}": {"keypoints": person()} for i in (0, 1)})
    assert len(rows) == 2 and rows.layout is None
    with pytest.raises(KeypointFileError, match=r"nor of a script of your own .*`skeleton`"):
        read(tmp_path / "c.json", {"skeleton": {"keypoints": ["nose"]}})


def test_points_relative_to_one_of_them_are_named(tmp_path: Path) -> None:
    values = np.random.default_rng(0).uniform(-200, 200, (9, Q, 2))
    values[:, 0] = 0
    np.save(tmp_path / "a.npy", values)
    lines = [json.dumps({"people": [{"keypoints": row}]}) for row in values.tolist()]
    for found in (read_keypoints(tmp_path / "a.npy"), read(tmp_path / "a.jsonl", "\n".join(lines))):
        assert [finding.code for finding in found.findings] == ["origin"]
