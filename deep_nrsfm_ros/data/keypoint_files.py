"""Keypoint files of several kinds to detections: bags, npz, COCO JSON, OpenPose JSON."""

from __future__ import annotations

import gzip
import json
import re
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.bag_files import SUFFIXES, open_bag
from deep_nrsfm_ros.data.bag_topics import keypoint_topics
from deep_nrsfm_ros.data.bags import Progress
from deep_nrsfm_ros.data.detections import Detections, gather, stamps_at
from deep_nrsfm_ros.data.openpose import read_people
from deep_nrsfm_ros.data.read_options import DEFAULT_READ_OPTIONS, ReadOptions
from deep_nrsfm_ros.lifting.observation import Observation, to_observation
from deep_nrsfm_ros.messages.serialised import MessageReader, read_header

KINDS = (
    "a bag (folder, .db3, .mcap, or .bag of ROS 1), an .npz with `points`, COCO keypoints (.json), "
    "a folder of OpenPose .json files, or OpenPose frames as .jsonl (.jsonl.gz)"
)

_MAX_EMPTY = 1_000_000  # frames without an object: nine hours at 30 Hz


class KeypointFileError(ValueError):
    """A file of keypoints cannot be read; the message names the file and the remedy."""


def read_keypoints(
    path: Path,
    keypoints: int,
    options: ReadOptions = DEFAULT_READ_OPTIONS,
    on_progress: Progress = lambda done, total: None,
    warn: Callable[[str], None] = lambda message: None,
) -> Detections:
    """Return the detections in a file or folder of any of `KINDS`.

    Args:
        path: the file or folder; its name and content say of which kind it is.
        keypoints: number q of keypoints of the detector's layout, e.g. 17.
        options: topic and mapping for bags, rate for files without stamps, least confidence.
        on_progress: called while reading.
        warn: called with a sentence about each damaged part.

    Raises:
        KeypointFileError: the file is missing, of no known kind, or damaged.
        BagError: a bag cannot be read.
    """
    name = path.name.lower()
    if not path.exists():
        raise KeypointFileError(f"{path} does not exist")
    if is_bag(path):
        return read_bag(path, keypoints, options, on_progress, warn)
    try:
        if path.is_dir():
            files = sorted(path.glob("*.json"), key=_natural)
            if not files:
                raise KeypointFileError(f"it holds neither a bag nor .json files; expected {KINDS}")
            texts = ((file.name, file.read_bytes()) for file in files)
            return _openpose(texts, len(files), keypoints, options, on_progress)
        if name.endswith(".npz"):
            return _npz(path, keypoints, options)
        if name.endswith((".jsonl", ".jsonl.gz")):
            data = path.read_bytes()
            lines = (gzip.decompress(data) if name.endswith(".gz") else data).splitlines()
            numbered = ((f"line {i}", line) for i, line in enumerate(lines, 1) if line.strip())
            return _openpose(numbered, len(lines), keypoints, options, on_progress)
        if name.endswith(".json"):
            content = json.loads(path.read_bytes())
            if isinstance(content, dict) and "people" in content:
                frame = [(path.name, path.read_bytes())]
                return _openpose(frame, 1, keypoints, options, on_progress)
            return _coco(content, keypoints, options)
    except (ValueError, TypeError, ArithmeticError, EOFError, OSError, zlib.error) as error:
        raise KeypointFileError(f"{path}: {error}") from None
    except (MemoryError, RecursionError) as error:
        raise KeypointFileError(f"{path} asks for more than there is: {error!r}") from None
    raise KeypointFileError(f"{path} is of no known kind; expected {KINDS}")


def is_bag(path: Path) -> bool:
    """Return whether an existing path looks like a bag."""
    if path.is_dir():
        return any(f.name == "metadata.yaml" or f.suffix in SUFFIXES for f in path.iterdir())
    return path.suffix in SUFFIXES


def read_bag(
    path: Path,
    keypoints: int,
    options: ReadOptions = DEFAULT_READ_OPTIONS,
    on_progress: Progress = lambda done, total: None,
    warn: Callable[[str], None] = lambda message: None,
) -> Detections:
    """Return the detections on a topic of a bag, in order of time.

    Stamps are those of the headers, or the time of recording for messages without a header.
    Unreadable messages are left out.

    Args:
        path: bag folder, or a single .db3 or .mcap file.
        keypoints: number q of keypoints of the detector's layout.
        options: topic, mapping, image size and least confidence.
        on_progress: called after every 256 messages.
        warn: called with a sentence about each damaged part and about unreadable messages.

    Raises:
        BagError: the bag cannot be read, or has no such topic.
        KeypointFileError: no message is readable.
    """
    observations, stamps, reason, camera, count = [], [], "", "", 0
    with closing(open_bag(path)) as bag:
        topics = keypoint_topics(bag, options.topic, options.mapping, keypoints)
        for topic, input_type, decode in topics:
            reader = MessageReader(input_type, decode)
            for record in bag.records(topic):
                count += 1
                try:
                    header, observation = reader(
                        record.raw, keypoints, options.min_confidence, options.image_size
                    )
                    observations.append(observation)
                    stamps.append((header and header.stamp) or record.time)
                    camera = camera or (header.frame_id if header else "")
                except Exception as error:  # damaged bytes fail in many ways; read the others
                    reason = reason or str(error) or repr(error)
                if count % 256 == 0:
                    on_progress(count, max(count, topic.total))
            if warning := bag.warning(topic):
                warn(warning)
    if not observations:
        raise KeypointFileError(f"no readable message in {path} ({count} found); {reason}")
    if len(observations) < count:
        warn(f"{count - len(observations)} of {count} messages could not be read: {reason}")
    order = np.argsort(stamps, kind="stable")
    ordered = [observations[i] for i in order], [stamps[i] for i in order]
    return gather(*ordered, keypoints, camera)


def stamp_of(message: Any) -> int:
    """Return the stamp in the header of a message in ns; 0 if it has no header."""
    header = read_header(message)
    return header.stamp if header else 0


def _openpose(
    texts: Iterable[tuple[str, bytes]],
    total: int,
    keypoints: int,
    options: ReadOptions,
    on_progress: Progress,
) -> Detections:
    """Return the people in frames of OpenPose JSON, given as pairs (file or line, JSON)."""
    observations: list[Observation] = []
    for done, (name, text) in enumerate(texts, 1):
        try:
            observations.append(read_people(text, keypoints, options.min_confidence))
        except ValueError as error:
            raise KeypointFileError(f"{name}: {error}; is it the right keypoint layout?") from None
        on_progress(done, total)
    if not observations:
        raise KeypointFileError("it is empty")
    return gather(observations, stamps_at(options.rate, len(observations)), keypoints)


def _coco(content: Any, keypoints: int, options: ReadOptions) -> Detections:
    """Return the people in COCO keypoint annotations, or in a list of COCO results."""
    rows = content.get("annotations") if isinstance(content, dict) else content
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise KeypointFileError(
            "neither COCO keypoints (`annotations`, or a list of results) nor OpenPose (`people`)"
        )
    rows = [row for row in rows if "keypoints" in row]
    if not rows:
        raise KeypointFileError("no annotation or result has `keypoints`")
    for row in rows:
        if "image_id" not in row:
            raise KeypointFileError("an annotation or result has no `image_id`")
        if np.shape(row["keypoints"]) != (3 * keypoints,):
            raise KeypointFileError(
                f"image {row['image_id']!r} has {np.size(row['keypoints']) / 3:g} keypoints; the "
                f"keypoint layout has {keypoints}: name the layout in which they were written"
            )
    images = content.get("images") if isinstance(content, dict) else None
    names = [image.get("id") for image in images or () if isinstance(image, dict)]
    if not all(isinstance(name, (int, str)) for name in [*names, *(r["image_id"] for r in rows)]):
        raise KeypointFileError("`id` of an image or `image_id` is neither a number nor a text")
    names = list(dict.fromkeys([*names, *sorted((row["image_id"] for row in rows), key=_natural)]))
    frames = {name: frame for frame, name in enumerate(names)}
    by_frame: list[list[Mapping[str, Any]]] = [[] for _ in names]
    for row in rows:
        by_frame[frames[row["image_id"]]].append(row)
    observations = [_people(people, keypoints, options.min_confidence) for people in by_frame]
    identities = [str(p.get("track_id", i)) for people in by_frame for i, p in enumerate(people)]
    stamps = stamps_at(options.rate, len(observations))
    return gather(observations, stamps, keypoints, identities=identities)


def _people(
    rows: Sequence[Mapping[str, Any]], keypoints: int, min_confidence: float
) -> Observation:
    """Return the annotations of one image as an observation."""
    values = np.reshape([row["keypoints"] for row in rows], (len(rows), keypoints, 3))
    return to_observation(values.astype(np.float64), min_confidence)


def _npz(path: Path, keypoints: int, options: ReadOptions) -> Detections:
    """Return the objects in the arrays of an .npz: see README, "Files instead of topics"."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except Exception as error:  # a damaged file makes zipfile and NumPy raise many types
        raise KeypointFileError(f"damaged or no .npz file: {error!r}") from error
    if "points" not in arrays:
        raise KeypointFileError(
            f"no array `points` (objects, {keypoints}, 2); there are: {', '.join(arrays) or 'none'}"
        )
    points = _numbers(arrays, "points", np.float64)
    if points.ndim != 3 or points.shape[1:] not in ((keypoints, 2), (keypoints, 3)):
        raise KeypointFileError(
            f"`points` is {points.shape}; (objects, {keypoints}, 2), or 3 with the confidence, is "
            "needed: x, y in the order of the keypoint layout"
        )
    m = len(points)
    if "confidence" in arrays:
        confidence = _numbers(arrays, "confidence", np.float64, (m, keypoints))
        points = np.concatenate([points[..., :2], confidence[..., None]], -1)
    frame = _numbers(arrays, "frame", np.int64, (m,)) if "frame" in arrays else np.arange(m)
    count = int(frame.max(initial=-1)) + 1
    if m and int(frame.min()) < 0:
        raise KeypointFileError(f"`frame` has {frame.min()}; frames are counted from 0")
    if count > m + _MAX_EMPTY:
        raise KeypointFileError(
            f"`frame` goes to {count - 1} with {m} objects; at most {_MAX_EMPTY} frames may show "
            "nobody"
        )
    if "stamps" in arrays:
        count = max(count, len(arrays["stamps"]))
        stamps = _numbers(arrays, "stamps", np.int64, (count,))
    else:
        stamps = stamps_at(options.rate, count)
    identities = arrays.get("identities", _index_in_frame(frame)).astype(str)
    if identities.shape != (m,):
        raise KeypointFileError(f"`identities` is {identities.shape}; ({m},) is needed")
    observation = to_observation(points, options.min_confidence)
    order = np.argsort(frame, kind="stable")
    return Detections(
        observation.points[order],
        observation.confidence[order],
        frame[order],
        identities[order],
        stamps,
    )


def _numbers(
    arrays: Mapping[str, NDArray[Any]],
    name: str,
    kind: type,
    shape: tuple[int, ...] | None = None,
) -> NDArray[Any]:
    """Return an array of an .npz as `kind`; raise KeypointFileError unless it has that shape."""
    array = arrays[name]
    if array.dtype.kind not in "fiu" or shape is not None and array.shape != shape:
        wanted = "of numbers" if shape is None else f"of numbers {shape}"
        raise KeypointFileError(f"`{name}` is {array.dtype} {array.shape}; {wanted} is needed")
    if kind is np.int64 and not (np.abs(array) < 2**63).all():
        raise KeypointFileError(f"`{name}` has a number that is no whole one of 64 bits")
    return array.astype(kind)


def _index_in_frame(frame: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index (m,) of each object among the objects of its frame."""
    order = np.argsort(frame, kind="stable")
    ordered = frame[order]
    index = np.empty(len(frame), np.int64)
    index[order] = np.arange(len(frame)) - np.searchsorted(ordered, ordered)
    return index


def _natural(name: Any) -> list[tuple[int, int, str]]:
    """Return a key that sorts numbers in names by value: frame_2 before frame_10."""
    text = name.name if isinstance(name, Path) else str(name)
    parts = re.split(r"(\d+)", text)
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts if p]
