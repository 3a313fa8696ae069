# SPDX-License-Identifier: Apache-2.0
"""Frames, times, identities and confidences are read from JSON of whatever form and names."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.keypoint_files import KeypointFileError, read_keypoints
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.presets import COCO17, LAYOUTS

Q = len(COCO17)
FRAMES = 6
Document = dict[str, Any]


def points(frame: int, person: int = 0, q: int = Q) -> list[list[float]]:
    """Return x, y, confidence of a person, who moves by 4 pixels a frame."""
    values = np.random.default_rng(person).uniform(100, 500, (q, 3))
    values[:, 0] += 700 * person + 4 * frame
    values[:, 2] = np.linspace(0.5, 0.9, q)
    return values.round(3).tolist()


def pairs(frame: int, person: int = 0) -> list[list[float]]:
    return [point[:2] for point in points(frame, person)]


def write(path: Path, documents: list[Any]) -> Path:
    """Write documents as lines, as a list, or as a folder of files, by the name of the path."""
    if path.suffix == ".jsonl":
        path.write_text("\n".join(map(json.dumps, documents)))
    elif path.suffix == ".json":
        path.write_text(json.dumps(documents))
    else:
        path.mkdir()
        for i, document in enumerate(documents):
            (path / f"{i:06}.json").write_text(json.dumps(document))
    return path


def read(path: Path, content: Any = None, **options: Any) -> Detections:
    if content is not None:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_keypoints(path, ReadOptions(**{"layout": COCO17, **options}))


def codes(found: Detections) -> list[str]:
    return [finding.code for finding in found.findings]


def is_silent(found: Detections) -> bool:
    return not (found.warnings or found.findings or found.notes)


def tenths(found: Detections) -> list[int]:
    """Return the stamps in tenths of a second from the first one."""
    return np.round((found.stamps - found.stamps[0]) / 1e8).astype(int).tolist()


PLACES = ("a.jsonl", "a.json", "folder")
OBJECTS: dict[str, Callable[[int], Document]] = {
    "people": lambda i: {"people": [{"pose_keypoints_2d": sum(points(i), [])}]},
    "predictions": lambda i: {"predictions": [{"keypoints": points(i), "score": 0.8}]},
    "instances": lambda i: {"instances": [{"keypoints": pairs(i), "keypoint_scores": [0.9] * Q}]},
    "landmarks": lambda i: {
        "pose_landmarks": [[{"x": x, "y": y, "visibility": c} for x, y, c in points(i)]]
    },
    "object": lambda i: {"keypoints": points(i)},
    "names": lambda i: dict(zip(COCO17.keypoints, points(i), strict=True)),
    "array": lambda i: {"keypoints": [pairs(i)], "scores": [[0.9] * Q]},
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("form", OBJECTS)
def test_the_frame_and_time_of_a_document_count(tmp_path: Path, place: str, form: str) -> None:
    """Whether a document is a line, a file of a folder or an element of a list."""
    layout = None if form == "names" else COCO17
    late_first = [*range(3, FRAMES), *range(3)]
    numbered = [{"frame": 3 * i, **OBJECTS[form](i)} for i in late_first]
    found = read(write(tmp_path / place, numbered), layout=layout)
    assert found.frames.numbers.tolist() == [0, 3, 6, 9, 12, 15]
    assert tenths(found) == [0, 1, 2, 3, 4, 5] and is_silent(found)
    assert np.diff(found.points[:, 0, 0]).round().tolist() == [4] * (FRAMES - 1)
    timed = [{"timestamp_ms": 5000 + 100 * i, **OBJECTS[form](i)} for i in range(FRAMES)]
    (tmp_path / "timed").mkdir()
    found = read(write(tmp_path / "timed" / place, timed), layout=layout)
    assert tenths(found) == [0, 1, 2, 3, 4, 5] and found.frame.tolist() == list(range(FRAMES))
    assert is_silent(found)


def test_a_document_of_one_object_in_each_line(tmp_path: Path) -> None:
    """That is what `json.dumps` of an object a line makes."""
    forms: list[list[Any]] = [
        [{"keypoints": points(i)} for i in range(FRAMES)],
        [points(i) for i in range(FRAMES)],
        [sum(points(i), []) for i in range(FRAMES)],
        [
            {"image_id": i, "category_id": 1, "id": 9 + i, "keypoints": sum(points(i), [])}
            for i in range(FRAMES)
        ],
    ]
    for number, documents in enumerate(forms):
        for place in ("jsonl", "folder"):
            path = tmp_path / f"{number}.{place}"
            found = read(write(path, documents))
            assert found.frame.tolist() == list(range(FRAMES)) and is_silent(found)
            np.testing.assert_allclose(found.points[2], pairs(2), rtol=1e-6)
    people = [
        {"frame": i // 2, "track_id": i % 2, "keypoints": points(i // 2, i % 2)} for i in range(8)
    ]
    found = read(write(tmp_path / "a.jsonl", people))
    assert found.frame.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert found.identities.tolist() == ["0", "1"] * 4


def test_frames_of_nobody_keep_their_place_in_time(tmp_path: Path) -> None:
    seen = [1, 2, 4, 5, 7]
    forms: list[Document] = [{"people": [{"keypoints": points(i)}]} for i in range(9)]
    nobody: list[Any] = [{}, None, [], {"people": []}]
    for place in PLACES:
        for number, empty in enumerate(nobody):
            documents = [forms[i] if i in seen else empty for i in range(9)]
            (tmp_path / str(number)).mkdir(exist_ok=True)
            found = read(write(tmp_path / str(number) / place, documents))
            assert found.frame.tolist() == seen and len(found.stamps) == 9, (place, empty)
            assert is_silent(found)
    lines = [json.dumps(forms[i]) if i in seen else "" for i in range(9)]
    found = read(tmp_path / "b.jsonl", "\n".join(lines) + "\n\n")
    assert found.frames.numbers.tolist() == seen
    assert found.notes == ("3 empty lines count as frames without objects",)
    found = read(tmp_path / "c.jsonl", "\n\n".join(json.dumps(form) for form in forms))
    assert found.frames.numbers.tolist() == list(range(9))
    named = [{"frame": i, **(forms[i] if i in seen else {})} for i in range(9)]
    found = read(write(tmp_path / "named.jsonl", named))
    assert found.frame.tolist() == seen and len(found.stamps) == 9 and is_silent(found)
    people = [{}, {"keypoints": points(0)}, {"keypoints": points(0, 1)}]
    found = read(tmp_path / "people.json", people)
    assert found.frame.tolist() == [0, 0] and "no keypoints, but nothing" in found.warnings[0]


@pytest.mark.parametrize(
    "name",
    [
        *("frame_idx", "frame_no", "frame_num", "frameNumber", "frameIndex", "Frame #", "frame_i"),
        *("img_path", "image_path", "filename", "image_name", "imgname", "video_frame", "img"),
    ],
)
def test_usual_names_of_the_frame(tmp_path: Path, name: str) -> None:
    is_file = any(word in name for word in ("path", "name", "img"))
    objects = [
        {name: f"/data/{3 * i:04}.jpg" if is_file else 3 * i, "keypoints": points(i, person)}
        for i in range(FRAMES)
        for person in range(2)
    ]
    frames = [{name: o[name], "people": [{"keypoints": o["keypoints"]}]} for o in objects[::2]]
    for content, people in ((objects, 2), (frames, 1)):
        found = read(tmp_path / "a.json", content)
        assert found.frames.numbers.tolist() == [0, 3, 6, 9, 12, 15] and is_silent(found)
        assert len(found) == people * FRAMES
    assert is_silent(read(write(tmp_path / "a.jsonl", frames)))


def test_the_number_of_a_frame_beside_its_objects(tmp_path: Path) -> None:
    for name in ("index", "idx", "id", "number"):
        frames = [{name: 3 * i, "people": [{"keypoints": points(i)}]} for i in range(FRAMES)]
        for place in ("json", "jsonl"):
            found = read(write(tmp_path / f"{name}.{place}", frames))
            assert tenths(found) == list(range(FRAMES)) and is_silent(found)
        same = [{**frame, name: 1} for frame in frames]  # of a camera
        found = read(write(tmp_path / "same.jsonl", same))
        assert len(found.stamps) == FRAMES and is_silent(found)


def test_keypoints_with_labels(tmp_path: Path) -> None:
    """Transformers leaves weak keypoints out, and gives the numbers of the others."""
    frames = []
    for i in range(4):
        kept = [k for k in range(Q) if k != i]
        frames.append([{"keypoints": [points(i)[k] for k in kept], "labels": kept}])
    for options in ({}, {"layout": None}):
        found = read(tmp_path / "a.json", frames, **options)
        assert (found.confidence == 0).sum(1).tolist() == [1] * 4 and is_silent(found)
        assert not found.confidence[range(4), range(4)].any()
    weak = [{"keypoints": pairs(0)[3:], "labels": [*range(3, Q)], "conf": [0.5] * (Q - 3)}]
    found = read(tmp_path / "a.json", weak)
    assert found.confidence[0].tolist() == [0] * 3 + [0.5] * (Q - 3)


def test_the_name_of_a_video_is_no_frame(tmp_path: Path) -> None:
    lines = [{"file": "clip.mp4", "people": [{"keypoints": points(i)}]} for i in range(FRAMES)]
    assert len(read(write(tmp_path / "a.jsonl", lines)).stamps) == FRAMES


def test_a_name_that_all_frames_have_names_none(tmp_path: Path) -> None:
    frames = [
        {"frame_id": "camera_link", "time": i / 10, "people": [{"keypoints": points(i)}]}
        for i in range(FRAMES)
    ]
    for place in PLACES:
        found = read(write(tmp_path / place, frames))
        assert tenths(found) == list(range(FRAMES)) and not found.findings
        assert found.frame.tolist() == list(range(FRAMES))


def test_objects_of_several_frames_in_one_are_doubted(tmp_path: Path) -> None:
    """Also where two people take turns, and where there are but a few frames."""
    for frames in (2, 3, FRAMES):
        turns = [
            {"position": i, "keypoints": points(i, person)}
            for i in range(frames)
            for person in range(2)
        ]
        assert codes(read(tmp_path / "a.json", turns)) == ["one-frame"]
    crowd = [{"keypoints": points(0, person)} for person in range(4)]
    assert not codes(read(tmp_path / "a.json", crowd))


@pytest.mark.parametrize(
    "fields",
    [
        lambda i: {"timestamp": f"2024-05-01T10:00:0{i / 10}Z"},
        lambda i: {"timestamp": f"2024-05-01 10:00:0{i / 10}"},
        lambda i: {"time": f"{i / 10}"},
        lambda i: {"time": f"00:00:0{i / 10}"},
        lambda i: {"timestamp_usec": 10**15 + 100_000 * i},
        lambda i: {"timestamp_sec": i / 10},
        lambda i: {"Time (s)": i / 10},
        lambda i: {"time[ms]": 100 * i},
        lambda i: {"t_ms": 100 * i},
        lambda i: {"frame_time": i / 10},
        lambda i: {"header": {"stamp": {"sec": 1714557600, "nanosec": 10**8 * i}}},
        lambda i: {"stamp": {"secs": 17, "nsecs": 10**8 * i}},
        lambda i: {"sec": 1714557600, "nanosec": 10**8 * i},
    ],
)
def test_times_of_any_form(tmp_path: Path, fields: Callable[[int], Document]) -> None:
    objects = [{"frame": i, **fields(i), "keypoints": points(i)} for i in range(FRAMES)]
    alone = [{**fields(i), "keypoints": points(i)} for i in range(FRAMES)]
    for content in (objects, alone):
        found = read(tmp_path / "a.json", content)
        assert tenths(found) == [0, 1, 2, 3, 4, 5] and not found.findings
        assert found.frame.tolist() == list(range(FRAMES))
        assert np.diff(found.points[:, 0, 0]).round().tolist() == [4] * (FRAMES - 1)


def test_times_that_are_not_used_are_named(tmp_path: Path) -> None:
    def timed(times: list[Any]) -> Detections:
        people = [{"frame": i, "time": t, "keypoints": points(i)} for i, t in enumerate(times)]
        return read(tmp_path / "a.json", people)

    odd = timed(["morning", "noon", "evening"])
    assert codes(odd) == ["times"]
    assert "its times ('morning', 'noon', ...) are not used: write" in odd.findings[0].message
    assert "1 of 3 frames have none" in timed([0.1, 0.2, None]).findings[0].message
    assert "in no unit are frames" in timed([0, 1e15, 2e15]).findings[0].message
    took = timed([0.03, 0.05, 0.02, 0.03, 0.04, 0.01])  # the detector took so long
    assert not took.findings and "do not grow with the frames" in took.notes[0]
    assert is_silent(timed([0.03]))


@pytest.mark.parametrize("unit", [1, 10**3, 10**6, 10**9])
def test_names_of_files_that_are_times(tmp_path: Path, unit: int) -> None:
    step, start = unit // 10 or 1, 1_714_557_600 * unit
    for i in range(3):
        (tmp_path / f"{start + i * step}.json").write_text(json.dumps([{"keypoints": points(i)}]))
    found = read(tmp_path)
    assert tenths(found) == ([0, 10, 20] if unit == 1 else [0, 1, 2])
    assert (
        "are taken for times in" in found.warnings[0] and found.stamps[0] == start * 10**9 // unit
    )


def test_large_numbers_of_images_are_no_times(tmp_path: Path) -> None:
    people = [{"image_id": 10_000_010_000 + i, "keypoints": points(i)} for i in range(3)]
    found = read(tmp_path / "a.json", people)
    assert found.stamps.tolist() == [0, 33_333_333, 66_666_667]
    assert "are no count at a rate" in found.warnings[0]


@pytest.mark.parametrize("name", ["{}.{:03}.json", "{}.{:03}000000.json", "{}_{:03}000000.json"])
def test_names_of_files_that_are_seconds_and_a_fraction(tmp_path: Path, name: str) -> None:
    for i in range(12):
        file = tmp_path / name.format(1_714_557_600 + i // 10, 100 * (i % 10))
        file.write_text(json.dumps([{"keypoints": points(i)}]))
    found = read(tmp_path)
    assert tenths(found) == list(range(12)) and not found.findings
    assert "are taken for times in nanoseconds" in found.warnings[0]


def test_a_recording_says_its_rate(tmp_path: Path) -> None:
    frames = [{"people": [{"keypoints": points(i)}]} for i in range(3)]
    found = read(tmp_path / "a.json", {"fps": 10, "frames": frames})
    assert tenths(found) == [0, 1, 2] and found.notes == ("10 frames a second, as it says (`fps`)",)
    assert tenths(read(tmp_path / "a.json", rate=5)) == [0, 2, 4]
    found = read(tmp_path / "a.json", {"frames": frames, "info": {"frame_rate": 10}})
    assert tenths(found) == [0, 1, 2]


@pytest.mark.parametrize(
    "name",
    [
        *("id", "ID", "track", "trackId", "tracking_id", "trackingId", "body_id", "obj_id", "pid"),
        *("person_idx", "player", "subject_id", "instanceId", "id_"),
    ],
)
def test_usual_names_of_identities(tmp_path: Path, name: str) -> None:
    frames = [
        {"people": [{name: who, "keypoints": points(i, who)} for who in ((1, 2) if i else (2, 1))]}
        for i in range(FRAMES)
    ]
    found = read(tmp_path / "a.json", frames)
    assert found.identities.tolist() == ["2", "1", *["1", "2"] * (FRAMES - 1)] and is_silent(found)


def test_numbers_of_entries_are_no_identities(tmp_path: Path) -> None:
    people = [{"frame": i, "id": 70 + i, "keypoints": points(i)} for i in range(FRAMES)]
    found = read(tmp_path / "a.json", people)
    assert set(found.identities) == {"0"} and "and no identity" in found.notes[0]
    for entry in people:
        entry["image_id"] = entry.pop("frame")
    assert is_silent(read(tmp_path / "a.json", people))


def test_identities_of_openpifpaf_and_scores_of_posetrack(tmp_path: Path) -> None:
    """OpenPifPaf tracks by `id_`, beside a category; annotations of PoseTrack have no scores."""
    frames = [
        [
            {"keypoints": sum(points(i, who), []), "category_id": 1, "id_": who, "scores": []}
            for who in ((1, 2) if i else (2, 1))
        ]
        for i in range(3)
    ]
    found = read(tmp_path / "a.json", frames)
    assert found.identities.tolist() == ["2", "1", "1", "2", "1", "2"] and is_silent(found)


def test_kinds_of_objects_are_no_identities(tmp_path: Path) -> None:
    pair = [{"animal": "dog", "keypoints": points(0, who)} for who in range(2)]
    found = read(tmp_path / "a.json", [{"people": pair}] * 3)
    assert found.identities.tolist() == ["0", "1"] * 3
    assert found.notes == (
        "its `animal` is the same for several objects of a frame, and no identity",
    )


def test_tracks_that_hold_their_frames(tmp_path: Path) -> None:
    tracks = {
        str(who): [{"frame": i, "keypoints": points(i, who)} for i in range(3)] for who in (1, 2)
    }
    listed = [{"id": int(who), "frames": frames} for who, frames in tracks.items()]
    for content in (tracks, {"tracks": listed}, listed):
        found = read(tmp_path / "a.json", content)
        assert found.identities.tolist() == ["1", "2"] * 3 and is_silent(found)
        assert found.frame.tolist() == [0, 0, 1, 1, 2, 2]
    by_frame = {str(i): {"7": {"keypoints": points(i)}, "9": points(i, 1)} for i in range(3)}
    assert read(tmp_path / "a.json", by_frame).identities.tolist() == ["7", "9"] * 3


@pytest.mark.parametrize(
    "name",
    [
        *("conf", "confidences", "kp_scores", "kpt_scores", "keypoint_confidence", "visibility"),
        *("keypoints_conf", "keypoints_visible", "keypointScores", "probabilities"),
    ],
)
def test_usual_names_of_confidences(tmp_path: Path, name: str) -> None:
    scores = [point[2] for point in points(0)]
    for content in (
        [{"frame": 0, "keypoints": pairs(0), name: scores}],
        [{"frame": 0, "keypoints": [pairs(0), pairs(0, 1)], name: [scores, scores]}],
    ):
        found = read(tmp_path / "a.json", content)
        np.testing.assert_allclose(found.confidence[-1], scores, rtol=1e-6)
        assert is_silent(found)
    depth = [[x, y, 100.0 * c] for x, y, c in points(0)]
    found = read(tmp_path / "a.json", [{"frame": 0, "keypoints": depth, name: scores}])
    np.testing.assert_allclose(found.confidence[0], scores, rtol=1e-6)
    found = read(tmp_path / "a.json", [{"frame": 0, "keypoints": points(0), name: [0.0] * Q}])
    assert (found.confidence > 0).all()  # each keypoint has its own


def test_fields_that_are_not_used_are_named(tmp_path: Path) -> None:
    def of(**fields: Callable[[int], Any]) -> Detections:
        lines = [
            {"people": [{"keypoints": pairs(i), **{n: f(i) for n, f in fields.items()}}]}
            for i in range(3)
        ]
        return read(write(tmp_path / "a.jsonl", lines))

    found = of(action=lambda i: "walk", box=lambda i: [1, 2, 3, 4], area=lambda i: 5)
    assert found.notes == ("not used: fields action",) and not found.findings
    found = of(path_of_image_file=lambda i: f"{i}", certainty_of_all=lambda i: [0.5] * 3)
    message = found.findings[0].message
    assert "path_of_image_file (is it the frame?)" in message and "call it 'frame'" in message
    assert "number_of_track (is it an id" in of(number_of_track=lambda i: i % 2).findings[0].message
    assert is_silent(of(score_class=lambda i: 1, camera_file=lambda i: "cam"))


def test_several_documents_in_a_file(tmp_path: Path) -> None:
    documents = [{"frame": 3 * i, "predictions": [{"keypoints": points(i)}]} for i in range(4)]
    for text in ("\n".join(map(json.dumps, documents)), "".join(map(json.dumps, documents))):
        found = read(tmp_path / "clip.mp4.openpifpaf.json", text)
        assert found.frames.numbers.tolist() == [0, 3, 6, 9] and not found.findings
        assert "several documents" in found.notes[0]
    pretty = "\n".join(json.dumps([{"keypoints": points(i)}], indent=2) for i in range(4))
    assert read(tmp_path / "a.json", pretty).frame.tolist() == [0, 1, 2, 3]
    found = read(tmp_path / "a.json", pretty[:-200])
    assert found.frame.tolist() == [0, 1, 2] and codes(found) == ["damaged"]


def hand(person: int = 0) -> list[Document]:
    return [{"x": x / 2000, "y": y / 1000, "z": -0.01} for x, y, _ in points(0, person, 21)]


@pytest.mark.parametrize(
    "result",
    [
        {"hand_landmarks": [hand(), hand(1)], "handedness": [[{"score": 0.9}]] * 2},
        {"multi_hand_landmarks": [hand(), hand(1)]},
        {"multi_hand_landmarks": [{"landmark": hand()}, {"landmark": hand(1)}]},
        {"multiHandLandmarks": [hand(), hand(1)], "image": None},
        {"left_hand_landmarks": {"landmark": hand()}, "right_hand_landmarks": hand(1)},
    ],
)
def test_hands_of_mediapipe(tmp_path: Path, result: Document) -> None:
    options = {"layout": None, "fallback": LAYOUTS["hand21"], "image_size": (2000, 1000)}
    for place in PLACES:
        found = read(write(tmp_path / place, [result] * 3), **options)
        assert found.frame.tolist() == [0, 0, 1, 1, 2, 2] and not found.findings
        np.testing.assert_allclose(found.points[1, :, 0], [p["x"] * 2000 for p in hand(1)], 1e-5)


def test_hands_of_openpose_are_those_of_a_model_of_hands(tmp_path: Path) -> None:
    person = {
        "pose_keypoints_2d": sum(points(0), []),
        "hand_left_keypoints_2d": sum(points(0, 1, 21), []),
        "hand_right_keypoints_2d": sum(points(0, 2, 21), []),
    }
    lines = write(tmp_path / "a.jsonl", [{"people": [person]}] * 3)
    found = read(lines, layout=None, fallback=LAYOUTS["hand21"])
    assert found.frame.tolist() == [0, 0, 1, 1, 2, 2] and found.points.shape[1] == 21
    assert read(lines).points.shape == (3, Q, 2)


def test_people_as_arrays(tmp_path: Path) -> None:
    def frame(i: int, n: int) -> Document:
        people = range(n)
        return {
            "keypoints": [pairs(i, who) for who in people],
            "scores": [[0.8] * Q for _ in people],
            "ids": list(people),
            "bbox": [[0, 0, 2000, 2000] for _ in people],
        }

    counts = [1, 2, 0, 2]
    frames = [{"frame": i, **frame(i, n)} for i, n in enumerate(counts)]
    for place in PLACES:
        found = read(write(tmp_path / place, frames))
        assert found.frame.tolist() == [0, 1, 1, 3, 3] and not found.findings
        assert found.identities.tolist() == ["0", "0", "1", "0", "1"]
        np.testing.assert_allclose(found.points[2], pairs(1, 1), rtol=1e-6)
    recordings: list[Any] = [
        {"keypoints": [points(i) for i in range(FRAMES)]},
        {"keypoints": [pairs(i) for i in range(FRAMES)], "scores": [[0.8] * Q] * FRAMES},
        {"keypoints": [[pairs(i)] for i in range(FRAMES)], "scores": [[[0.8] * Q]] * FRAMES},
        [{"bodyparts": [points(i)], "bboxes": [[0, 0, 9, 9]]} for i in range(FRAMES)],
        [{"preds": [points(i)], "image_paths": [f"{i}.jpg"]} for i in range(FRAMES)],
        [{"pred_instances": {"keypoints": [pairs(i)]}, "img_path": f"{i}"} for i in range(FRAMES)],
        {"predictions": [[{"keypoints": points(i)}] for i in range(FRAMES)]},
        {"data": [{"frame_index": i, "skeleton": [{"pose": points(i)}]} for i in range(FRAMES)]},
        {"frames": {str(i): {"people": [{"keypoints": points(i)}]} for i in range(FRAMES)}},
        {str(i): points(i) for i in range(FRAMES)},
    ]
    for content in recordings:
        found = read(tmp_path / "b.json", content)
        assert found.frame.tolist() == list(range(FRAMES)) and is_silent(found)
        np.testing.assert_allclose(found.points[3], pairs(3), rtol=1e-6)


def test_long_arrays_are_frames_too(tmp_path: Path) -> None:
    """What goes with them in a list of its own is not read from so many, and is named."""
    content: Document = {"keypoints": [pairs(0)] * 5000}
    found = read(tmp_path / "a.json", content)
    assert len(found.stamps) == 5000 and is_silent(found)
    found = read(tmp_path / "a.json", {**content, "scores": [[0.5] * Q] * 5000})
    assert codes(found) == ["unused"] and "scores (is it a conf" in found.findings[0].message
    frames = [{"people": [{"keypoints": points(i)}]} for i in range(3)]
    found = read(tmp_path / "a.json", {"timestamps": [0.0, 0.1, 0.2], "frames": frames})
    assert "timestamps (is it the time?)" in found.findings[0].message


def test_easy_vitpose_has_y_first(tmp_path: Path) -> None:
    turned = [{"4": [[y, x, c] for x, y, c in points(i)]} for i in range(3)]
    names = dict(enumerate(COCO17.keypoints))
    found = read(tmp_path / "a.json", {"keypoints": turned, "skeleton": names}, layout=None)
    assert found.layout is COCO17 and found.identities.tolist() == ["4"] * 3
    np.testing.assert_allclose(found.points[1], pairs(1), rtol=1e-6)


def test_many_objects_that_are_left_out_are_a_finding(tmp_path: Path) -> None:
    lines = [[{"keypoints": points(i)[: Q - i % 2]}] for i in range(FRAMES)]
    found = read(write(tmp_path / "a.jsonl", lines))
    assert (
        codes(found) == ["left-out"] and "3 of 6 objects are left out" in found.findings[0].message
    )
    lines = [[{"keypoints": points(i)[: Q - (i == 3)]}] for i in range(12)]
    assert not codes(read(write(tmp_path / "a.jsonl", lines)))


def test_weak_confidences_are_named(tmp_path: Path) -> None:
    weak = [[[x, y, c / 10] for x, y, c in points(i)] for i in range(3)]
    found = read(tmp_path / "a.json", weak, min_confidence=0.07)
    assert "of 51 keypoints have a confidence below --min-confidence 0.07" in found.warnings[0]
    assert is_silent(read(tmp_path / "a.json", weak, min_confidence=0.05))


def test_several_videos_in_a_file_are_doubted(tmp_path: Path) -> None:
    images = [
        {"id": i, "video_id": i // 3, "frame_id": i % 3, "file_name": f"{i}.jpg"} for i in range(6)
    ]
    people = [{"image_id": i, "keypoints": points(i)} for i in range(6)]
    found = read(tmp_path / "a.json", {"images": images, "annotations": people})
    assert codes(found) == ["series"] and "are of 2 videos (0, 1)" in found.findings[0].message


def test_categories_that_nothing_names_are_said(tmp_path: Path) -> None:
    results = [{"image_id": i, "category_id": 1 + i % 2, "keypoints": points(i)} for i in range(4)]
    found = read(tmp_path / "a.json", results)
    assert "several categories (1, 2) without names" in found.warnings[0] and len(found) == 4
    assert is_silent(read(tmp_path / "a.json", category="1"))


def test_large_numbers_of_frames_give_way_to_names(tmp_path: Path) -> None:
    """PoseTrack numbers frames by video and frame; the names of its images count them."""
    images = [
        {"id": i, "frame_id": 10_000_010_000 + i, "file_name": f"v/{i:06}.jpg"} for i in range(3)
    ]
    people = [{"image_id": i, "keypoints": points(i)} for i in range(3)]
    found = read(tmp_path / "a.json", {"images": images, "annotations": people})
    assert found.frames.numbers.tolist() == [0, 1, 2] and is_silent(found)


def test_what_else_is_there_is_told(tmp_path: Path) -> None:
    world = [{"pose_world_landmarks": [[{"x": 0.1, "y": 0.2, "z": 0.3}] * 33]}] * 3
    with pytest.raises(KeypointFileError, match=r"pose_world_landmarks \(3D, and the 2D keypoi"):
        read(tmp_path / "a.json", world)
    rows = [{"frame": i, "nose_x": 1, "nose_y": 2} for i in range(3)]
    with pytest.raises(KeypointFileError, match="rows of a table: write it as .csv"):
        read(tmp_path / "a.json", rows)
    hands = [{"people": [{"hand_left_keypoints_2d": sum(points(0, 0, 21), [])}]}]
    with pytest.raises(KeypointFileError, match="hands are read with --model hand21"):
        read(tmp_path / "a.json", hands)
