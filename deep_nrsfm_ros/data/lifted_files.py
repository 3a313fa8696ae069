# SPDX-License-Identifier: Apache-2.0
"""Lifted recordings as files: .npz, .json or a bag, by the suffix of the name."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.lifted_bags import write_lifted_bag
from deep_nrsfm_ros.data.recording import Recording
from deep_nrsfm_ros.large_arrays import release

_DIGITS = 6  # of numbers in JSON
_RELEASED = 1024  # frames after which results that are in files are taken out of memory


def check_output(path: Path) -> None:
    """Raise ValueError if `write_recording` cannot write to a path: its suffix or its folder."""
    if path.suffix not in (".npz", ".json", ""):
        raise ValueError(
            f"{path} has the suffix {path.suffix!r}; expected .npz, .json, or none for a bag"
        )
    if not path.suffix and path.exists():
        raise ValueError(f"bag {path} exists already; choose another name or remove it")
    if not path.resolve().parent.is_dir():
        raise ValueError(f"folder {path.resolve().parent} of {path.name} does not exist")


def write_recording(path: Path, recording: Recording, model: str) -> None:
    """Write a recording to a file or bag. A file that exists is replaced atomically.

    Args:
        path: .npz, .json, or a name without suffix for a bag.
        recording: detections and lifted shapes.
        model: name of the model that lifted them.

    Raises:
        ValueError: see `check_output`.
        OSError: the file cannot be written.
    """
    check_output(path)
    if path.suffix == ".npz":
        arrays = _arrays(recording, model)
        _replace(path, lambda file: _write_npz(file, arrays))
    elif path.suffix == ".json":
        parts = _document(recording, model)
        _replace(path, lambda file: file.writelines(part.encode() for part in parts))
    else:
        write_lifted_bag(path, recording.detections, recording.lifted)


def _replace(path: Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Write a temporary file next to `path`, and rename it to `path`."""
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with partial.open("wb") as file:
            write(file)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


class _Member:
    """A member of an .npz, which takes an array out of memory as its parts are written."""

    def __init__(self, file: IO[bytes], array: NDArray[Any]) -> None:
        self._file, self._array = file, array

    def write(self, data: bytes) -> int:
        """Write bytes; return their number."""
        count = self._file.write(data)
        release([self._array])
        return count


def _write_npz(file: IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as `np.savez_compressed` does; memory holds 16 MB of a large one."""
    with ZipFile(file, "w", ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                write = np.lib.format.write_array
                write(_Member(member, array), array, allow_pickle=False)  # type: ignore[no-untyped-call]


def _arrays(recording: Recording, model: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of an .npz: those of `Lifted` (m, ...), the detections and the layout."""
    detections, target = recording.detections, recording.target
    return recording.lifted._asdict() | {
        "frame": detections.frame,
        "identities": detections.identities,
        "stamps": detections.stamps,
        "frame_numbers": detections.frames.numbers,
        "frame_names": detections.frames.names,
        "names": np.array(target.keypoints),
        "edges": np.array(target.edge_indices(), np.int64).reshape(-1, 2),
        "model": np.array(model),
    }


def _document(recording: Recording, model: str) -> Iterator[str]:
    """Yield the JSON document, frame by frame, without objects that were not lifted."""
    detections, target = recording.detections, recording.target
    start = {"model": model, "keypoints": list(target.keypoints), "edges": target.edge_indices()}
    yield json.dumps(start)[:-1] + ', "frames": ['
    f, is_lifted = len(detections.stamps), recording.is_lifted
    ends = np.searchsorted(detections.frame, np.arange(f + 1))
    for i in range(f):
        objects = [
            {
                "identity": str(detections.identities[row]),
                **{name: _plain(each[row]) for name, each in recording.lifted._asdict().items()},
            }
            for row in range(*ends[i : i + 2].tolist())
            if is_lifted[row]
        ]
        frame = {
            "stamp": int(detections.stamps[i]),
            "number": int(detections.frames.numbers[i]),
            "name": str(detections.frames.names[i]),
            "objects": objects,
        }
        yield ", " * (i > 0) + json.dumps(frame, allow_nan=False)
        if i % _RELEASED == 0:
            release(recording.lifted)
    yield "]}"


def _plain(values: NDArray[Any]) -> Any:
    """Return rounded numbers, or truth values, as nested lists; None for NaN."""
    if values.dtype == bool:
        return values.tolist()
    rounded = np.round(np.asarray(values, np.float64), _DIGITS)
    return np.where(np.isfinite(rounded), rounded, np.array(None, object)).tolist()
