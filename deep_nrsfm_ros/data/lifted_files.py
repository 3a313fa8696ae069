"""Lifted recordings as files: .npz, .json or a bag, by the suffix of the name."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.lifted_bags import write_lifted_bag
from deep_nrsfm_ros.data.recording import Recording

_DIGITS = 6  # of numbers in JSON


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
        _replace(path, lambda file: np.savez_compressed(file, allow_pickle=False, **arrays))
    elif path.suffix == ".json":
        text = json.dumps(_document(recording, model), allow_nan=False)
        _replace(path, lambda file: file.write(text.encode()))
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


def _document(recording: Recording, model: str) -> dict[str, Any]:
    """Return the JSON document, frame by frame, without objects that were not lifted."""
    detections, target = recording.detections, recording.target
    frames: list[dict[str, Any]] = [
        {"stamp": stamp, "number": number, "name": name, "objects": []}
        for stamp, number, name in zip(
            detections.stamps.tolist(), *(each.tolist() for each in detections.frames), strict=True
        )
    ]
    for i in np.flatnonzero(recording.is_lifted).tolist():
        fields = {name: _plain(values[i]) for name, values in recording.lifted._asdict().items()}
        frames[detections.frame[i]]["objects"].append(
            {"identity": str(detections.identities[i]), **fields}
        )
    return {
        "model": model,
        "keypoints": list(target.keypoints),
        "edges": target.edge_indices(),
        "frames": frames,
    }


def _plain(values: NDArray[Any]) -> Any:
    """Return rounded numbers as nested lists, None for NaN."""
    rounded = np.round(np.asarray(values, np.float64), _DIGITS)
    return np.where(np.isfinite(rounded), rounded, np.array(None, object)).tolist()
