# SPDX-License-Identifier: Apache-2.0
"""Keypoint files of several kinds to detections: the table of formats, and what all share."""

from __future__ import annotations

import dataclasses
import gzip
import io
import shutil
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, closing, nullcontext, suppress
from functools import partial
from itertools import chain, count, islice, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, BinaryIO, NamedTuple, cast

import numpy as np

from deep_nrsfm_ros.batched import Progress, evenly_spaced, no_progress
from deep_nrsfm_ros.data.bag_files import SUFFIXES, Topic, open_bag
from deep_nrsfm_ros.data.bag_topics import keypoint_topics
from deep_nrsfm_ros.data.bags import NO_SCORES, check_confidence, keypoint_count
from deep_nrsfm_ros.data.detections import Detections, gather
from deep_nrsfm_ros.data.formats.arrays import read_npy, read_npz
from deep_nrsfm_ros.data.formats.builder import (
    DetectionsBuilder,
    KeypointFileError,
)
from deep_nrsfm_ros.data.formats.frame_numbers import natural
from deep_nrsfm_ros.data.formats.hdf5 import read_h5
from deep_nrsfm_ros.data.formats.json_file import DefaultFrame, JsonReader
from deep_nrsfm_ros.data.formats.json_items import Readable, holds_documents, json_documents
from deep_nrsfm_ros.data.formats.other_kinds import remedy_of
from deep_nrsfm_ros.data.formats.tables import read_csv
from deep_nrsfm_ros.data.formats.trc import read_trc
from deep_nrsfm_ros.data.read_options import DEFAULT_READ_OPTIONS, ReadOptions
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.lifting.observation import (
    Observation,
    left_out_sentences,
    outside_share,
    without_border,
    without_value,
)
from deep_nrsfm_ros.lifting.sanity import OUTSIDE, Finding, Size, to_pixels
from deep_nrsfm_ros.messages.decoding import implied_layout, is_normalised
from deep_nrsfm_ros.messages.serialised import MessageReader, read_header
from deep_nrsfm_ros.messages.stamps import one_clock

__all__ = [
    "KINDS",
    "KeypointFileError",
    "is_bag",
    "read_bag",
    "read_keypoints",
    "recordings",
    "sample_bag",
    "stamp_of",
    "with_topic",
]


class Format(NamedTuple):
    """A format of keypoint files.

    Attributes:
        description: for the help of programs.
        suffixes: ends of the names of its files.
        read: returns the detections in such a file.
        has_categories: its objects may be of several categories.
    """

    description: str
    suffixes: tuple[str, ...]
    read: Callable[[Path, ReadOptions, Progress], Detections]
    has_categories: bool = False


def read_keypoints(
    path: Path,
    options: ReadOptions = DEFAULT_READ_OPTIONS,
    on_progress: Progress = lambda done, total: None,
) -> Detections:
    """Return the detections in a file or folder of any of `KINDS`.

    Their `layout` is the layout that the options name; else the one that the input names; else
    the fallback of the options. Their `warnings` say what was left out and what looks wrong.

    Args:
        path: the file or folder; its name and content say of which kind it is.
        options: layout, topic and mapping for bags, rate for files without stamps, ...
        on_progress: called while reading.

    Raises:
        KeypointFileError: the file is missing, of no known kind, damaged, or nothing is left of
            it; or an option cannot apply to it.
        BagError: a bag cannot be read.
    """
    if not path.exists():
        raise KeypointFileError(f"{path} does not exist")
    try:
        if is_bag(path):
            _refuse(options, ("category", "rate"), "a bag")
            return _finish(read_bag(path, options, on_progress), options)
        _refuse(options, ("topic", "mapping"), "a file that is no bag")
        form = _format_of(path)
        if not form.has_categories:
            _refuse(options, ("category",), "a file that is not COCO")
        return _finish(form.read(path, options, on_progress), options)
    except (ValueError, TypeError, ArithmeticError, EOFError, OSError, zlib.error) as error:
        if is_bag(path):
            raise
        raise KeypointFileError(f"{path}: {error}") from None
    except (MemoryError, RecursionError) as error:
        raise KeypointFileError(f"{path} asks for more than there is: {error!r}") from None


def _format_of(path: Path) -> Format:
    """Return the format of a file or folder by its name."""
    if path.is_dir():
        return _FOLDER
    name = path.name.lower()
    for form in FORMATS:
        if name.endswith(form.suffixes):
            return form
    raise KeypointFileError(remedy_of(name) or f"it is of no known kind; expected {KINDS}")


def _refuse(options: ReadOptions, names: tuple[str, ...], kind: str) -> None:
    """Raise KeypointFileError for an option that has no effect on an input of this kind."""
    for name in names:
        if getattr(options, name) != getattr(DEFAULT_READ_OPTIONS, name):
            flag = "--" + name.replace("_", "-")
            raise KeypointFileError(f"{flag} has no effect on {kind}: leave it out")


def _finish(detections: Detections, options: ReadOptions) -> Detections:
    """Return detections in pixels, without marks of missing keypoints."""
    points, confidence = detections.points, detections.confidence
    detections = _without_copies(detections)
    points, confidence = detections.points, detections.confidence
    present = without_value(Observation(points, confidence), options.missing_value)
    if present.points is not points:
        points, confidence = present.points, present.confidence
        detections = dataclasses.replace(detections, points=points, confidence=confidence)
    size = options.image_size or detections.image_size
    pixels = to_pixels(points, confidence, size)
    if pixels is not points:
        detections = dataclasses.replace(detections, points=pixels, is_normalised=True)
    # No size is that of all images of a source that gives several.
    if size and not detections.sizes_text:
        detections = _without_border(detections, size)
    return detections


def _without_copies(detections: Detections) -> Detections:
    """Return detections without objects that are equal to another one in their frame.

    Objects of which the input gives different identities are kept.
    """
    is_same_frame = np.diff(detections.frame) == 0
    if not is_same_frame.any():
        return detections
    if detections.has_identities():
        return detections
    is_kept = np.asarray(~(detections.confidence > 0).any(1))
    # Blocks that end with a frame, since objects of different frames are not compared.
    targets = np.arange(0, len(detections), _BLOCK)
    starts = np.unique(np.searchsorted(detections.frame, detections.frame[targets])).tolist()
    for start, stop in pairwise([*starts, len(detections)]):
        frame, points = detections.frame[start:stop], detections.points[start:stop]
        columns = (frame, *points.reshape(len(frame), -1).T, *detections.confidence[start:stop].T)
        first = np.unique(np.column_stack(columns), axis=0, return_index=True)[1]
        is_kept[start + first] = True
    if is_kept.all():
        return detections
    warning = (
        f"left out: {(~is_kept).sum()} objects that are equal to another one in their frame: was "
        "the file written twice?"
    )
    kept = detections[is_kept]
    return dataclasses.replace(kept, warnings=(*kept.warnings, warning))


def _without_border(detections: Detections, size: Size) -> Detections:
    """Return detections in which keypoints at the image's border are missing; say how many.

    Where so many pixels are outside that the size is wrong, nothing is left out.
    """
    points, confidence = detections.points, detections.confidence
    if not detections.is_normalised and outside_share(points, confidence, size) > OUTSIDE:
        return detections
    inner = without_border(Observation(points, confidence), size)
    total = int((confidence > 0).sum())
    count = total - int((inner.confidence > 0).sum())
    if not count:
        return detections
    detections = dataclasses.replace(detections, points=inner.points, confidence=inner.confidence)
    sentence = (
        f"{count} of {total} keypoints are at the border of the image of {size[0]} x {size[1]} "
        "pixels or outside, and count as missing"
    )
    if count < _FEW_AT_BORDER * total:
        return dataclasses.replace(detections, notes=(*detections.notes, sentence))
    return dataclasses.replace(detections, warnings=(*detections.warnings, sentence))


def _json(path: Path, options: ReadOptions, on_progress: Progress) -> Detections:
    """Return the objects in a JSON file of any detector."""
    builder = DetectionsBuilder(options)
    reader = JsonReader(builder)
    with path.open("rb") as raw, _unpacked(raw, path) as file:
        try:
            counted = _Counted(file, raw, path, on_progress)
            several = holds_documents(counted.read(_START))
            file.seek(0)
            if several:
                problem = _read_documents(builder, reader, counted)
            else:
                problem = _read_document(reader, counted, DefaultFrame(path.name))
        except (EOFError, OSError, zlib.error) as error:  # of what is compressed
            if not builder.frames:
                raise
            problem = str(error)
    reader.finish()
    if problem and not builder.frames:
        reasons = builder.reasons()
        raise KeypointFileError("; ".join([problem, *reasons]))
    if problem:
        _find_damage(builder, problem)
    return builder.detections("it has no frame")


def _unpacked(raw: BinaryIO, path: Path) -> AbstractContextManager[BinaryIO]:
    """Return the content of an open file, without its compression."""
    if not path.name.lower().endswith(".gz"):
        return nullcontext(raw)
    return cast("AbstractContextManager[BinaryIO]", gzip.open(raw))


def _read_documents(builder: DetectionsBuilder, reader: JsonReader, file: Readable) -> str:
    """Read documents that follow one another, each a frame; return as `_read_document` does."""
    builder.notes.append("it holds several documents, one after the other: each is a frame")
    documents = json_documents(file)
    for number in count():
        frame = DefaultFrame(f"document {number + 1}", number, is_document=True)
        try:
            document = next(documents, _END)
        except RecursionError:
            return _DEEP
        except ValueError as error:
            return str(error)
        if document is _END:
            return ""
        if problem := reader.read_value(document, frame):
            builder.leave_out("cannot be read", f"{frame.name}: {problem}", is_loss=True)
    return ""


def _find_damage(builder: DetectionsBuilder, problem: str) -> None:
    """Add the finding that a file is read up to a damaged place."""
    builder.find(
        Finding(
            "damaged",
            f"it is read up to a damaged place only, and what follows is lost: {problem}; write or "
            "copy the file anew",
        )
    )


def _read_document(reader: JsonReader, file: Readable, frame: DefaultFrame) -> str:
    """Read a document; return what is wrong with it, "" if nothing is."""
    try:
        return reader.read(file, frame)
    except RecursionError:
        return _DEEP
    except ValueError as error:
        return str(error)


class _Counted:
    """A file that reports how much of it is read: of what is compressed, as its size is."""

    def __init__(self, file: IO[bytes], raw: IO[bytes], path: Path, on_progress: Progress) -> None:
        self._raw = raw
        # A damaged archive gives what comes before the damage by `read1` alone.
        self._read = file.read1 if isinstance(file, gzip.GzipFile) else file.read
        self._size, self._on_progress = path.stat().st_size, on_progress

    def read(self, size: int = -1, /) -> bytes:
        """Return at most `size` bytes."""
        data = self._read(size)
        self._on_progress(min(self._raw.tell(), self._size), self._size)
        return data


def _lines(path: Path, options: ReadOptions, on_progress: Progress) -> Detections:
    """Return the objects in a file that has in each line a document, which is a frame."""
    builder = DetectionsBuilder(options)
    size = path.stat().st_size

    empty = 0

    def documents() -> Iterator[tuple[DefaultFrame, bytes]]:
        nonlocal empty
        for read, (place, number, line) in enumerate(_numbered(file)):
            empty = number - read
            yield DefaultFrame(f"line {place}", number, is_document=True), line
            on_progress(min(raw.tell(), size), size)  # of what is compressed, as the size is

    with path.open("rb") as raw, _unpacked(raw, path) as file:
        try:
            names_frames = _read_frames(builder, documents())
            if empty and not names_frames:
                builder.notes.append(f"{empty} empty lines count as frames without objects")
        except (EOFError, OSError, zlib.error) as error:
            if not builder.frames:
                raise
            _find_damage(builder, f"{error}, after {builder.frames} frames")
    return builder.detections("it is empty")


def _numbered(lines: Iterable[bytes]) -> Iterator[tuple[int, int, bytes]]:
    """Yield the lines of a file that are not empty, with their place from 1 and their frame.

    An empty line is a frame without objects, unless there is one after each line.
    """
    remaining = iter(lines)
    first = list(islice(remaining, 2 * _LOOKED_AT))
    full = [i for i, line in enumerate(first) if line.strip()]
    gaps = set(np.diff(full).tolist())
    step = gaps.pop() if len(gaps) == 1 and len(full) > 2 else 1
    start = full[0] if full and step > 1 else 0
    for i, line in enumerate(chain(first, remaining)):
        if line.strip():
            yield i + 1, (i - start) // step, line


def _table(
    read: Callable[[Path, DetectionsBuilder], None],
    path: Path,
    options: ReadOptions,
    on_progress: Progress,
) -> Detections:
    """Return the objects in a table."""
    builder = DetectionsBuilder(options)
    if not path.name.lower().endswith(".gz"):
        read(path, builder)
        return builder.detections("it has no row")
    with TemporaryDirectory() as folder, path.open("rb") as raw, _unpacked(raw, path) as content:
        unpacked = Path(folder, path.stem)
        with unpacked.open("wb") as file:
            shutil.copyfileobj(content, file)
        read(unpacked, builder)
    return builder.detections("it has no row")


def _folder(path: Path, options: ReadOptions, on_progress: Progress) -> Detections:
    """Return the objects in a folder with a document, which is a frame, in each file."""
    builder = DetectionsBuilder(options)
    files = []
    for file in sorted(path.iterdir(), key=natural):
        if file.name.startswith("."):  # ._frame.json: what macOS writes beside each file
            builder.leave_out("are hidden files", file.name)
        elif file.suffix.lower() == ".json" and file.is_file():
            files.append(file)
        elif file.suffix.lower() not in _IMAGES:
            builder.leave_out("are no .json files", file.name)
    if not files and any(file.suffix.lower() == ".txt" for file in path.iterdir()):
        raise KeypointFileError(
            "it holds .txt files: YOLO labels are not read; write JSON (results.to_json() of "
            "Ultralytics), or an .npz with `points`"
        )
    if not files and (inner := [file.name for file in path.iterdir() if file.is_dir()]):
        raise KeypointFileError(
            f"it holds no .json files itself, but folders ({', '.join(sorted(inner)[:4])}): read "
            "them one by one, each is a recording"
        )
    if not files:
        raise KeypointFileError(f"it holds neither a bag nor .json files; expected {KINDS}")

    def documents() -> Iterator[tuple[DefaultFrame, bytes]]:
        for done, file in enumerate(files, 1):
            yield DefaultFrame(file.name, is_document=True), file.read_bytes()
            on_progress(done, len(files))

    _read_frames(builder, documents())
    return builder.detections("no file in it has keypoints")


def _read_frames(
    builder: DetectionsBuilder, documents: Iterator[tuple[DefaultFrame, bytes]]
) -> bool:
    """Read documents, each a frame; return whether they name their frames.

    What is no frame is left out and counted.
    """
    reader = JsonReader(builder)
    for frame, text in documents:
        if problem := _read_document(reader, io.BytesIO(text), frame):
            builder.leave_out("cannot be read", f"{frame.name}: {problem}", is_loss=True)
    reader.finish()
    return reader.names_frames


_START = 1 << 20  # bytes of a file in which a document ends that is one of several
_END = object()
_DEEP = "it is nested too deep for JSON of a detector"
_LOOKED_AT = 8  # lines that tell whether empty ones are frames
_FEW_AT_BORDER = 0.01  # fraction of keypoints below which the border is no cause for doubt
_BLOCK = 4096  # objects that are compared at once
_SAMPLE = 256  # messages of a topic that `sample_bag` reads at least
_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")
"""Images beside the files of their keypoints are no keypoints, and usual."""
_FOLDER = Format("a folder of .json files, one a frame", (), _folder, has_categories=True)
FORMATS = (
    Format("an .npz with `points`", (".npz",), lambda path, options, _: read_npz(path, options)),
    Format("an .npy", (".npy",), lambda path, options, _: read_npy(path, options)),
    Format(
        "JSON of COCO, OpenPose, MMPose, AlphaPose, MediaPipe or PoseNet (.json, .json.gz)",
        (".json", ".json.gz"),
        _json,
        has_categories=True,
    ),
    Format(
        "a table (.csv, .csv.gz) of DeepLabCut, SLEAP, MediaPipe, or with columns such as nose_x",
        (".csv", ".tsv", ".csv.gz", ".tsv.gz"),
        partial(_table, read_csv),
        has_categories=True,
    ),
    Format(
        "a table (.h5) of DeepLabCut or SLEAP",
        (".h5", ".hdf5"),
        partial(_table, read_h5),
        has_categories=True,
    ),
    Format("2D markers (.trc) of Sports2D", (".trc",), partial(_table, read_trc)),
    Format(
        "such JSON of a frame a line (.jsonl, .ndjson, also with .gz)",
        (".jsonl", ".ndjson", ".jsonl.gz", ".ndjson.gz"),
        _lines,
    ),
)
"""The formats of single files."""
KINDS = "; ".join(
    [
        "a bag (folder, .db3, .mcap, or .bag of ROS 1)",
        *(form.description for form in (*FORMATS, _FOLDER)),
    ]
)
"""What `read_keypoints` reads, for the help of programs."""


def is_bag(path: Path) -> bool:
    """Return whether an existing path looks like a bag."""
    if path.is_dir():
        return any(f.name == "metadata.yaml" or f.suffix in SUFFIXES for f in path.iterdir())
    return path.suffix in SUFFIXES


def recordings(path: Path) -> list[Path]:
    """Return the recordings in a folder of recordings, by name; any other path as it is.

    They are the files of `FORMATS`, the bags, and the folders with a frame in each .json file.
    Where a folder has .json files and nothing else of these, each of them may be a frame: it is one
    recording. In a folder in a folder nothing is looked for.
    """
    if not path.is_dir() or is_bag(path):
        return [path]
    files = [file for file in sorted(path.iterdir(), key=natural) if file.name[:1] != "."]
    found = [file for file in files if _is_recording(file)]
    single = [file for file in found if file.suffix.lower() != ".json"]
    return found if single else [path]


def _is_recording(path: Path) -> bool:
    """Return whether a path in a folder is a bag, a keypoint file or a folder of frames."""
    if path.is_dir():
        return is_bag(path) or any(file.suffix.lower() == ".json" for file in path.iterdir())
    return path.suffix in SUFFIXES or any(
        path.name.lower().endswith(form.suffixes) for form in FORMATS
    )


def read_bag(
    path: Path,
    options: ReadOptions = DEFAULT_READ_OPTIONS,
    on_progress: Progress = lambda done, total: None,
) -> Detections:
    """Return the detections on a topic of a bag, in order of time.

    Stamps are those of the headers, on one clock (`one_clock`), or the time of recording for
    messages without a header.
    Unreadable messages are left out.

    Args:
        path: bag folder, or a single .db3 or .mcap file.
        options: layout, topic, mapping, image size and least confidence.
        on_progress: called after every 256 messages.

    Raises:
        BagError: the bag cannot be read, or has no such topic.
        KeypointFileError: no message is readable.
    """
    observations, stamps, times, reason, camera, count = [], [], [], "", "", 0
    warnings: list[str] = []
    left_out: list[str] = []
    has_scores, below, normalised = False, 0, False
    layout = options.layout or options.fallback or _implied_by_type(path, options)
    keypoints = len(layout) if layout else keypoint_count([path], options)
    with closing(open_bag(path)) as bag:
        topics = keypoint_topics(bag, options.topic, options.mapping, keypoints)
        for topic, input_type, decode in topics:
            reader = MessageReader(input_type, decode)
            normalised |= is_normalised(input_type)
            for record in bag.records(topic):
                count += 1
                try:
                    header, observation = reader(
                        record.raw, keypoints, options.min_confidence, options.image_size
                    )
                    left_out += observation.left_out
                    has_scores |= bool(observation.scores)
                    kept = observation.above(options.min_score)
                    below += len(observation.confidence) - len(kept.confidence)
                    observations.append(kept)
                    stamps.append(header.stamp if header else 0)
                    times.append(record.time)
                    camera = camera or (header.frame_id if header else "")
                except Exception as error:  # damaged bytes fail in many ways; read the others
                    reason = reason or str(error) or repr(error)
                if count % 256 == 0:
                    on_progress(count, max(count, topic.total))
            if warning := bag.warning(topic):
                warnings.append(warning)
    if not observations:
        raise KeypointFileError(f"no readable message in {path} ({count} found); {reason}")
    if len(observations) < count:
        warnings.append(
            f"{count - len(observations)} of {count} messages could not be read: {reason}"
        )
    if options.min_score and not has_scores:
        raise KeypointFileError(f"{path} {NO_SCORES}")
    if below:
        warnings.append(
            f"left out: {below} objects with a score below --min-score {options.min_score:g}"
        )
    warnings += left_out_sentences(left_out)
    on_one_clock, clock_warnings = one_clock(stamps, times)
    order = np.argsort(on_one_clock, kind="stable")
    ordered = [observations[i] for i in order]
    detections = gather(ordered, on_one_clock[order], keypoints, camera)
    warnings += clock_warnings
    found = tuple(check_confidence(path, keypoints, options))
    return dataclasses.replace(
        detections,
        layout=layout,
        is_normalised=normalised,
        warnings=tuple(warnings),
        findings=found,
    )


def with_topic(path: Path, options: ReadOptions, keypoints: int) -> ReadOptions:
    """Return the options with the topic to read from a bag.

    Args:
        path: the bag.
        options: their topic and mapping are used.
        keypoints: where several topics may be meant, the only one with so many keypoints is.

    Raises:
        BagError: the bag cannot be read, has no such topic, or several.
    """
    if options.topic:
        return options
    with closing(open_bag(path)) as bag:
        (found,) = keypoint_topics(bag, "", options.mapping, keypoints)
    return dataclasses.replace(options, topic=found.topic.name)


def sample_bag(path: Path, options: ReadOptions, on_progress: Progress = no_progress) -> Detections:
    """Return the detections in evenly spaced messages of a bag, to see what it holds.

    They have no stamps. Their `layout` is that of `read_bag`.

    Args:
        path: bag folder, or a single file.
        options: as of `read_bag`.
        on_progress: called after every 256 messages.

    Raises:
        BagError: as in `read_bag`.
    """
    layout = options.layout or options.fallback or _implied_by_type(path, options)
    keypoints = len(layout) if layout else keypoint_count([path], options)
    observations, normalised = [], False
    with closing(open_bag(path)) as bag:

        def messages(topic: Topic) -> Iterator[bytes]:
            for count, raw in enumerate(bag.sample(topic)):
                if count % 256 == 0:
                    on_progress(0, max(topic.total, 1))
                yield raw

        for topic, input_type, decode in keypoint_topics(
            bag, options.topic, options.mapping, keypoints
        ):
            reader = MessageReader(input_type, decode)
            normalised |= is_normalised(input_type)
            for raw in evenly_spaced(messages(topic), _SAMPLE):
                with suppress(Exception):  # damaged bytes fail in many ways; the others do
                    _, observation = reader(
                        raw, keypoints, options.min_confidence, options.image_size
                    )
                    observations.append(observation.above(options.min_score))
    sample = gather(observations, range(len(observations)), keypoints)
    sample = dataclasses.replace(sample, layout=layout, is_normalised=normalised)
    return _finish(sample, options)


def _implied_by_type(path: Path, options: ReadOptions) -> KeypointLayout | None:
    """Return the layout that the type of a bag's keypoints implies; None if it implies none."""
    with closing(open_bag(path)) as bag:
        topics = keypoint_topics(bag, options.topic, options.mapping)
        names = {implied_layout(input_type) for _, input_type, _ in topics}
    name = names.pop() if len(names) == 1 else ""
    return LAYOUTS[name] if name else None


def stamp_of(message: Any) -> int:
    """Return the stamp in the header of a message in ns; 0 if it has no header."""
    header = read_header(message)
    return header.stamp if header else 0
