# SPDX-License-Identifier: Apache-2.0
"""Files and bags of people as programs and people write them, after public bug reports.

Each case is a function that writes an input into a folder, with the objects that a reader should
find in it. Keypoints are those of two people who walk and turn before a camera.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from benchmarks.data.walking_person import FOCAL, IMAGE, skeleton
from deep_nrsfm_ros.data.bags import frames, write_bag
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25, COCO17, HUMAN17, LAYOUTS
from deep_nrsfm_ros.messages.decoding import MULTI_ARRAY, POINT_CLOUD

Floats = NDArray[Any]

FRAMES = 30
RATE = 30.0  # Hz, unless the input gives another
SIZE = ("--image-width", str(IMAGE[0]), "--image-height", str(IMAGE[1]))


class Truth(NamedTuple):
    """The true keypoints of a person in human17.

    Attributes:
        shapes: (f, 17, 3) in metres in camera axes; NaN where the person has no joint.
        pixels: (f, 17, 2).
        joints: (f, 2) pixels of all joints by name.
    """

    shapes: Floats
    pixels: Floats
    joints: dict[str, Floats]


class Row(NamedTuple):
    """An object that a reader should find.

    Attributes:
        frame: of the true motion.
        seconds: its time; only differences count.
        identity: in the input; None = any.
        person: 0 or 1.
    """

    frame: int
    seconds: float
    identity: str | None = None
    person: int = 0


class Case(NamedTuple):
    """An odd input.

    Attributes:
        kind: of oddity, a row of the table.
        name: of the input, and the public report that it is after.
        write: writes it into a folder and returns its path.
        rows: the objects in it, in order.
        options: with which the programs are called.
        layout: preset in which `train` is told the keypoints are; "" = the input says it.
        trained: the objects that a training takes from it, where they are not `rows`.
    """

    kind: str
    name: str
    write: Callable[[Path], Path]
    rows: Sequence[Row]
    options: tuple[str, ...] = ()
    layout: str = "coco17"
    trained: Sequence[Row] = ()


def _truth(start: int, across: float) -> Truth:
    """Return the truth of a person who begins at a frame of the walk and is moved to the right."""
    joints = {name: X[start:] + [across, 0, 0] for name, X in skeleton(start + FRAMES).items()}
    unknown = np.full((FRAMES, 3), np.nan)
    shapes = np.stack([joints.get(name, unknown) for name in HUMAN17.keypoints], 1)
    pixels = {name: FOCAL * X[:, :2] / X[:, 2:] + np.array(IMAGE) / 2 for name, X in joints.items()}
    return Truth(shapes, FOCAL * shapes[..., :2] / shapes[..., 2:] + np.array(IMAGE) / 2, pixels)


TRUTH = (_truth(0, -0.6), _truth(20, 0.7))
ONE = tuple(Row(i, i / RATE) for i in range(FRAMES))


def person(frame: int, layout: KeypointLayout = COCO17, who: int = 0) -> Floats:
    """Return x, y and confidence (q, 3) of a person; 0 where there is no joint."""
    values = np.zeros((len(layout), 3))
    rng = np.random.default_rng(100 * frame + who)
    for i, name in enumerate(layout.keypoints):
        if name in TRUTH[who].joints:
            values[i] = *TRUTH[who].joints[name][frame] + rng.normal(0, 1, 2), 0.9
    return values.round(3)


def everybody(layout: KeypointLayout = COCO17) -> Floats:
    """Return the first person (f, q, 3) in all frames."""
    return np.stack([person(i, layout) for i in range(FRAMES)])


def _flat(values: Floats) -> list[float]:
    """Return numbers one after the other."""
    return [float(value) for value in np.ravel(values)]


def _json(folder: Path, content: Any, name: str = "a.json") -> Path:
    """Write a JSON document."""
    path = folder / name
    path.write_text(json.dumps(content))
    return path


def _openpose(*people: Floats) -> dict[str, Any]:
    """Return a frame of OpenPose."""
    return {"version": 1.3, "people": [{"pose_keypoints_2d": _flat(p)} for p in people]}


def _folder(folder: Path, files: Iterable[tuple[str, Any]]) -> Path:
    """Write a folder of JSON files."""
    made = folder / "json"
    made.mkdir()
    for name, content in files:
        (made / name).write_text(json.dumps(content))
    return made


def ultralytics_json(folder: Path) -> Path:
    """Write `results.to_json()` of each frame on a line: x, y and visible in lists of their own."""
    lines = []
    for i in range(FRAMES):
        x, y, c = person(i).T.tolist()
        box = {"x1": min(x), "y1": min(y), "x2": max(x), "y2": max(y)}
        keypoints = {"x": x, "y": y, "visible": c}
        entry = {"name": "person", "class": 0, "confidence": 0.91, "box": box}
        lines.append(json.dumps([entry | {"keypoints": keypoints, "track_id": 7}]))
    path = folder / "a.jsonl"
    path.write_text("\n".join(lines))
    return path


def zeros_with_confidence(folder: Path) -> Path:
    """Write keypoints at (0, 0) with a positive confidence."""
    values = everybody()
    values[::2, 9] = 0, 0, 0.37
    values[::3, 14] = 0, 0, 0.44
    return _json(folder, [{"image_id": i, "keypoints": _flat(v)} for i, v in enumerate(values)])


def yolo_labels(folder: Path) -> Path:
    """Write a folder of YOLO labels: class, box, keypoints in fractions of the image."""
    made = folder / "labels"
    made.mkdir()
    for i in range(FRAMES):
        values = person(i) / [*IMAGE, 1]
        numbers = [0, 0.5, 0.5, 0.2, 0.8, *_flat(values)]
        (made / f"video_{i + 1}.txt").write_text(" ".join(f"{n:.6g}" for n in numbers) + "\n")
    return made


def alphapose_results(folder: Path, names: Callable[[int], str], order: Sequence[int]) -> Path:
    """Write results of AlphaPose with a sum of scores and nested identities."""
    entries = [
        {
            "image_id": names(i),
            "category_id": 1,
            "keypoints": _flat(person(i)),
            "score": 2.47,
            "idx": [[3.0], [3.0]],
        }
        for i in order
    ]
    return _json(folder, entries)


def poseflow(folder: Path) -> Path:
    """Write tracked results: image -> list of people."""
    content = {
        f"{i}.jpg": [
            {"keypoints": _flat(person(i, who=who)), "scores": 2.5, "idx": 4 + who}
            for who in (i % 2, 1 - i % 2)
        ]
        for i in range(FRAMES)
    }
    return _json(folder, content)


def by_person_and_frame(folder: Path) -> Path:
    """Write identity -> frame -> keypoints."""
    content = {
        str(1 + who): {
            str(i): {"keypoints": _flat(person(i, who=who)), "scores": None} for i in range(FRAMES)
        }
        for who in (0, 1)
    }
    return _json(folder, content)


def numbered_files(folder: Path, name: Callable[[int], str]) -> Path:
    """Write a folder of OpenPose with names of one's own."""
    return _folder(folder, [(name(i), _openpose(person(i))) for i in range(FRAMES)])


def two_cameras(folder: Path) -> Path:
    """Write the frames of two cameras into one folder."""
    files = [(f"logi_{i:06}.json", _openpose(person(i))) for i in range(FRAMES)]
    files += [(f"osmo_{i:06}.json", _openpose(person(i, who=1))) for i in range(FRAMES)]
    return _folder(folder, files)


def part_candidates(folder: Path) -> Path:
    """Write frames of OpenPose with part candidates, hands and faces."""
    files = []
    for i in range(FRAMES):
        values = person(i, BODY25)
        candidates = [{str(k): _flat(values[k]) for k in range(25)}]
        frame = _openpose(values) | {"part_candidates": candidates}
        frame["people"][0] |= {"hand_left_keypoints_2d": [0.0] * 63, "person_id": [-1]}
        files.append((f"v_{i:012}_keypoints.json", frame))
    return _folder(folder, files)


def one_file_a_person(folder: Path) -> Path:
    """Write no file where nobody is."""
    kept = [i for i in range(FRAMES) if not 10 <= i < 20]
    return _folder(folder, [(f"v_{i:012}_keypoints.json", _openpose(person(i))) for i in kept])


def deeplabcut(folder: Path, individuals: Sequence[str], hidden: bool = False) -> Path:
    """Write a table of multi-animal DeepLabCut."""
    parts = [f"{i},{name}" for i in individuals for name in COCO17.keypoints]
    columns = [(*part.split(","), c) for part in parts for c in ("x", "y", "likelihood")]
    extra = [("single", "corner", c) for c in ("x", "y", "likelihood")]
    columns += extra
    lines = [",".join(["scorer"] + ["DLC"] * len(columns))]
    for level, title in enumerate(("individuals", "bodyparts", "coords")):
        lines.append(",".join([title, *(column[level] for column in columns)]))
    for i in range(FRAMES):
        cells = []
        for who in range(len(individuals)):
            values = person(i, who=who)
            for k, (x, y, c) in enumerate(values):
                lost = hidden and (i + k) % 5 == 0
                cells += ["", "", "1.0"] if lost else [f"{x}", f"{y}", f"{c}"]
        lines.append(",".join([str(i), *cells, "10", "20", "0.99"]))
    path = folder / "videoDLC.csv"
    path.write_text("\n".join(lines))
    return path


def mediapipe_flat(folder: Path, width: int) -> Path:
    """Write MediaPipe landmarks as x, y, z (3) or x, y, z, visibility (4), in pixels."""
    layout, objects = LAYOUTS["mediapipe33"], []
    for i in range(FRAMES):
        values = person(i, layout)
        depth = np.sin(np.arange(33) + 0.1 * i)
        columns = [values[:, 0], values[:, 1], 0.3 * depth, values[:, 2]][:width]
        objects.append({"frame": i, "keypoints": _flat(np.stack(columns, 1))})
    return _json(folder, objects)


def depth_as_confidence(folder: Path) -> Path:
    """Write an array (f, 17, 3) whose third number is a depth in metres."""
    values = everybody()
    values[..., 2] = 4 + 0.2 * np.sin(np.arange(17))
    np.save(folder / "a.npy", values)
    return folder / "a.npy"


def percent(folder: Path) -> Path:
    """Write confidences in percent, with legs that the detector only guesses."""
    values = everybody()
    values[..., 2] = 90
    values[:, 13:, :2] = [[300, 700], [500, 700], [290, 715], [520, 715]]
    values[:, 13:, 2] = 4
    return _json(folder, [{"image_id": i, "keypoints": _flat(v)} for i, v in enumerate(values)])


def relative_to_box(folder: Path) -> Path:
    """Write keypoints in the pixels of the person's crop, which is scaled to 192 x 256."""
    objects = []
    for i in range(FRAMES):
        values = person(i)
        low, high = values[values[:, 2] > 0, :2].min(0), values[values[:, 2] > 0, :2].max(0)
        crop = values.copy()
        crop[:, :2] = (values[:, :2] - low) / (high - low) * [192, 256]
        box = _flat(np.concatenate([low, high - low]))
        objects.append({"image_id": i, "keypoints": _flat(crop), "bbox": box, "score": 0.9})
    return _json(folder, objects)


def utf16(folder: Path) -> Path:
    """Write JSON as PowerShell's `>` does."""
    path = folder / "a.json"
    content = [{"image_id": i, "keypoints": _flat(person(i))} for i in range(FRAMES)]
    path.write_text(json.dumps(content), encoding="utf-16")
    return path


def coordinate_table(
    folder: Path, extra: Callable[[int], str], head: str = "", decimal: str = "."
) -> Path:
    """Write a table with a column for each coordinate."""
    delimiter = ";" if decimal == "," else ","
    columns = [f"{name}_{c}" for name in COCO17.keypoints for c in ("x", "y", "score")]
    lines = [delimiter.join([head, *columns] if head else columns)]
    for i in range(FRAMES):
        cells = [str(value).replace(".", decimal) for value in person(i).ravel().tolist()]
        lines.append(delimiter.join([extra(i), *cells] if head else cells))
    path = folder / "a.csv"
    path.write_text("\n".join(lines))
    return path


def stamped_frames(folder: Path, field: str, unit: float) -> Path:
    """Write frames with a time each, at 10 Hz."""
    content = [
        {field: unit * (1000 + 0.1 * i), "people": _openpose(person(i))["people"]}
        for i in range(FRAMES)
    ]
    return _json(folder, {"frames": content})


def array(folder: Path, order: str) -> Path:
    """Write an array in another order of its dimensions."""
    values = everybody()
    turned = {
        "f, 3q": values.reshape(FRAMES, -1),
        "f, 3, q": values.transpose(0, 2, 1),
        "3, q, f": values.transpose(2, 1, 0),
        "f, q, y x": values[..., [1, 0, 2]] / [IMAGE[1], IMAGE[0], 1],
    }[order]
    np.save(folder / "a.npy", turned)
    return folder / "a.npy"


def twice(folder: Path) -> Path:
    """Write the results of two runs into one file."""
    entries = [
        {"image_id": i, "category_id": 1, "keypoints": _flat(person(i)), "score": 0.9}
        for _ in range(2)
        for i in range(FRAMES)
    ]
    return _json(folder, entries)


def nulls_and_texts(folder: Path) -> Path:
    """Write null for what is missing, and numbers as texts."""
    objects = []
    for i in range(FRAMES):
        points = [[f"{x}", f"{y}", f"{c}"] for x, y, c in person(i)]
        points[9] = [None, None, None]  # type: ignore[list-item]
        objects.append({"image_id": i, "keypoints": points})
    return _json(folder, objects)


def pickled(folder: Path) -> Path:
    """Write a pickle, as VIBE and mmpose 0.x do."""
    (folder / "a.pkl").write_bytes(pickle.dumps({"keypoints": everybody()}))
    return folder / "a.pkl"


def right_before_left(folder: Path) -> Path:
    """Write an array whose right and left keypoints are exchanged, without names."""
    values = everybody()
    values[:, 1:] = values[:, 1:].reshape(FRAMES, 8, 2, 3)[:, :, ::-1].reshape(FRAMES, 16, 3)
    np.savez(folder / "a.npz", points=values[..., :2], confidence=values[..., 2])
    return folder / "a.npz"


def same_identity(folder: Path) -> Path:
    """Write two people of whom the tracker says one identity."""
    entries = [
        {"image_id": i, "keypoints": _flat(person(i, who=who)), "track_id": 1}
        for i in range(FRAMES)
        for who in (0, 1)
    ]
    return _json(folder, entries)


def folders_of_cameras(folder: Path) -> Path:
    """Write a folder of folders, one a camera."""
    for name in ("cam1_json", "cam2_json"):
        (folder / "pose" / name).mkdir(parents=True)
        for i in range(FRAMES):
            path = folder / "pose" / name / f"{i}.json"
            path.write_text(json.dumps(_openpose(person(i))))
    return folder / "pose"


def hand_upwards(folder: Path) -> Path:
    """Write y upwards, as plotting programs do."""
    values = everybody()
    values[..., 1] = np.where(values[..., 2] > 0, IMAGE[1] - values[..., 1], 0)
    np.save(folder / "a.npy", values)
    return folder / "a.npy"


def bag(folder: Path, values: Floats, kind: str = POINT_CLOUD, start: int = 10**18) -> Path:
    """Write a bag of one person (f, q, 3)."""
    written = frames(values[..., :2], values[..., 2], RATE, start=start)
    write_bag(folder / "bag", "/keypoints", written, input_type=kind)
    return folder / "bag"


def bag_without_dimensions(folder: Path) -> Path:
    """Write arrays without a layout."""
    store = get_typestore(Stores.ROS2_JAZZY)
    kind = "std_msgs/msg/Float32MultiArray"
    with Writer(folder / "bag", version=9) as writer:
        connection = writer.add_connection("/keypoints", kind, typestore=store)
        for i in range(FRAMES):
            layout = store.types["std_msgs/msg/MultiArrayLayout"]([], 0)
            message = store.types[kind](layout, person(i).ravel().astype(np.float32))
            raw = store.serialize_cdr(message, kind)
            writer.write(connection, 10**18 + round(i * 1e9 / RATE), raw)
    return folder / "bag"


def _marked(value: float) -> Floats:
    """Return the person with wrists and ankles marked as missing, of full confidence."""
    values = everybody()
    values[:, [9, 10, 15, 16]] = value, value, 1
    return values


GAPS = tuple(Row(i, i / RATE) for i in range(FRAMES) if not 10 <= i < 20)
PAIRS = tuple(
    Row(i, i / RATE, str(4 + who), who) for i in range(FRAMES) for who in (i % 2, 1 - i % 2)
)
TRACKED = tuple(Row(i, i / RATE, str(1 + who), who) for i in range(FRAMES) for who in (0, 1))
ANY_TWO = tuple(Row(i, i / RATE, None, who) for i in range(FRAMES) for who in (0, 1))
SLOW = tuple(Row(i, 0.1 * i) for i in range(FRAMES))
JUMPS = (1, 2, 3, 20, 21, 22)

NAMES, TIMES, VALUES = "names and identities", "times and frames", "values"
FORMATS, ODD, BAGS = "formats", "odd entries", "bags"

CASES = (
    Case(FORMATS, "Ultralytics results.to_json()", ultralytics_json, ONE),
    Case(FORMATS, "YOLO labels (ultralytics 6641)", yolo_labels, ONE, SIZE),
    Case(FORMATS, "PoseFlow, image -> people (google/retiming 3)", poseflow, PAIRS),
    Case(FORMATS, "identity -> frame -> keypoints (PoseLift 4)", by_person_and_frame, TRACKED),
    Case(FORMATS, "pickle of VIBE", pickled, ONE),
    Case(FORMATS, "array of rows (f, 3q)", partial(array, order="f, 3q"), ONE),
    Case(FORMATS, "array (f, 3, q)", partial(array, order="f, 3, q"), ONE),
    Case(FORMATS, "array (3, q, f) of MATLAB", partial(array, order="3, q, f"), ONE),
    Case(FORMATS, "UTF-16 of PowerShell", utf16, ONE),
    Case(
        FORMATS,
        "decimal commas",
        partial(coordinate_table, extra=str, head="frame", decimal=","),
        ONE,
    ),
    Case(
        FORMATS,
        "folder of folders (pose2sim 120)",
        folders_of_cameras,
        ONE,
        trained=ONE * 2,
    ),
    Case(
        FORMATS,
        "x, y, z, visibility in a row (mediapipe 2414)",
        partial(mediapipe_flat, width=4),
        ONE,
        layout="mediapipe33",
    ),
    Case(
        NAMES,
        "nested identities of AlphaPose (AlphaPose 761)",
        partial(alphapose_results, names="{}.jpg".format, order=range(FRAMES)),
        tuple(row._replace(identity="3") for row in ONE),
    ),
    Case(NAMES, "one identity for two people", same_identity, ANY_TWO),
    Case(
        NAMES,
        "individuals and a corner of DeepLabCut (neuroconv 1992)",
        partial(deeplabcut, individuals=("4", "5")),
        tuple(Row(i, i / RATE, str(4 + who), who) for i in range(FRAMES) for who in (0, 1)),
        (),
    ),
    Case(NAMES, "right before left, without names", right_before_left, ONE),
    Case(NAMES, "two runs in one file", twice, ONE),
    Case(
        TIMES,
        "missing images (AlphaPose 1071)",
        partial(alphapose_results, names="{}.jpg".format, order=JUMPS),
        tuple(Row(i, i / RATE) for i in JUMPS),
    ),
    Case(
        TIMES,
        "images in the order of texts (AlphaPose 721)",
        partial(alphapose_results, names="{}.jpg".format, order=sorted(range(FRAMES), key=str)),
        ONE,
    ),
    Case(TIMES, "files N.json (pose2sim 2)", partial(numbered_files, name="{}.json".format), ONE),
    Case(TIMES, "two cameras in a folder (pose2sim 120)", two_cameras, ANY_TWO),
    Case(TIMES, "no file where nobody is (mmskeleton 126)", one_file_a_person, GAPS),
    Case(
        TIMES,
        "a column of times, 10 Hz",
        partial(coordinate_table, extra=lambda i: f"{0.1 * i:.2f}", head="time"),
        SLOW,
    ),
    Case(
        TIMES,
        "timestamps of frames in seconds, 10 Hz",
        partial(stamped_frames, field="timestamp", unit=1.0),
        SLOW,
    ),
    Case(
        TIMES,
        "timestamps of frames in milliseconds, 10 Hz",
        partial(stamped_frames, field="timestamp_ms", unit=1000.0),
        SLOW,
    ),
    Case(VALUES, "(0, 0) of confidence 0.4 (ultralytics 15929)", zeros_with_confidence, ONE),
    Case(
        VALUES,
        "NaN of likelihood 1 (DeepLabCut 1650)",
        partial(deeplabcut, individuals=("4",), hidden=True),
        ONE,
        (),
    ),
    Case(VALUES, "depth in the place of the confidence", depth_as_confidence, ONE),
    Case(
        VALUES,
        "x, y, z in a row (mediapipe 2414)",
        partial(mediapipe_flat, width=3),
        ONE,
        layout="mediapipe33",
    ),
    Case(VALUES, "confidence in percent, guessed legs", percent, ONE),
    Case(VALUES, "pixels of the crop", relative_to_box, ONE),
    Case(VALUES, "y before x, normalised", partial(array, order="f, q, y x"), ONE, SIZE),
    Case(VALUES, "y upwards", hand_upwards, ONE),
    Case(ODD, "part candidates, hands (openpose 1820)", part_candidates, ONE, (), "body25"),
    Case(ODD, "null and numbers as texts", nulls_and_texts, ONE),
    Case(BAGS, "PointCloud2 of coco17", lambda f: bag(f, everybody()), ONE),
    Case(BAGS, "array without dimensions", bag_without_dimensions, ONE),
    Case(BAGS, "array with dimensions", lambda f: bag(f, everybody(), MULTI_ARRAY), ONE),
    Case(BAGS, "keypoints at (-1, -1)", lambda f: bag(f, _marked(-1)), ONE),
    Case(BAGS, "normalised keypoints", lambda f: bag(f, everybody() / [*IMAGE, 1]), ONE),
)
"""All inputs."""
