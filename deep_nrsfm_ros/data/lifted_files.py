"""Lifted recordings as files, of a kind that their names tell: npz, JSON, or a bag."""

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
    """Raise ValueError unless `write_recording` would know what to write, and where."""
    if path.suffix not in (".npz", ".json", ""):
        raise ValueError(
            f"{path} has the suffix {path.suffix!r}; expected .npz, .json, or none for a bag"
        )
    if not path.suffix and path.exists():
        raise ValueError(f"bag {path} exists already; choose another name or remove it")
    if not path.resolve().parent.is_dir():
        raise ValueError(f"folder {path.resolve().parent} of {path.name} does not exist")


def write_recording(path: Path, recording: Recording, model: str) -> None:
    """Write what was lifted with `model`; a file is replaced by a whole one or not at all.

    Raises ValueError as `check_output` does, and OSError.
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
    """Write a file beside `path`, then put it in its place."""
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with partial.open("wb") as file:
            write(file)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _arrays(recording: Recording, model: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of an npz: those of `Lifted` (m, ...) and what they are of."""
    seen, target = recording.detections, recording.target
    return recording.lifted._asdict() | {
        "frame": seen.frame,
        "identities": seen.identities,
        "stamps": seen.stamps,
        "names": np.array(target.keypoints),
        "edges": np.array(target.edge_indices(), np.int64).reshape(-1, 2),
        "model": np.array(model),
    }


def _document(recording: Recording, model: str) -> dict[str, Any]:
    """Return the same, frame by frame, for JSON; objects that were not lifted are left out."""
    seen, target, sound = recording.detections, recording.target, recording.is_lifted
    frames: list[dict[str, Any]] = [
        {"stamp": stamp, "objects": []} for stamp in seen.stamps.tolist()
    ]
    for i in np.flatnonzero(sound).tolist():
        one = {name: _plain(values[i]) for name, values in recording.lifted._asdict().items()}
        frames[seen.frame[i]]["objects"].append({"identity": str(seen.identities[i]), **one})
    return {
        "model": model,
        "keypoints": list(target.keypoints),
        "edges": target.edge_indices(),
        "frames": frames,
    }


def _plain(values: NDArray[Any]) -> Any:
    """Return numbers as JSON has them, None for NaN."""
    rounded = np.round(np.asarray(values, np.float64), _DIGITS)
    return np.where(np.isfinite(rounded), rounded, np.array(None, object)).tolist()
