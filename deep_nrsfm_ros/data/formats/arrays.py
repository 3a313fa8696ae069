# SPDX-License-Identifier: Apache-2.0
"""Arrays of NumPy: .npz with named arrays, .npy with the keypoints alone."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.detections import Detections, Frames, index_in_frame
from deep_nrsfm_ros.data.formats.builder import (
    KeypointFileError,
    identities_of,
    wrong_count,
)
from deep_nrsfm_ros.data.formats.frame_numbers import stamps_of
from deep_nrsfm_ros.data.formats.names import contradiction, layout_of_names
from deep_nrsfm_ros.data.read_options import DEFAULT_RATE, ReadOptions
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.observation import to_observation, without_value
from deep_nrsfm_ros.lifting.sanity import confidence_scale, find_origin

_MAX_EMPTY = 1_000_000  # frames without an object: nine hours at 30 Hz
_OPTIONAL = (
    *("confidence", "frame", "stamps", "identities", "scores"),
    *("names", "frame_numbers", "frame_names"),
)
_OF_OTHERS = {
    "positions_2d": "VideoPose3D's data_2d_*.npz",
    "boxes": "detections of Detectron, as VideoPose3D's infer_video.py writes them",
}


def read_npz(path: Path, options: ReadOptions) -> Detections:
    """Return the objects in the arrays of an .npz: see README, "Files instead of topics".

    Only the arrays that are needed are read; what else the file holds does not matter.
    """
    warnings: list[str] = []
    arrays: dict[str, NDArray[Any]] = {}
    with _open(path) as file:
        if "points" not in file.files:
            raise KeypointFileError(_of_others(file, options))
        for name in ("points", *_OPTIONAL):
            if name not in file.files:
                continue
            try:
                arrays[name] = file[name]
            except ValueError as error:
                if "pickle" not in str(error).lower():
                    raise
                text = (
                    f"array `{name}` holds Python objects, which could run code when they are "
                    f"read; save it with a plain type: np.savez(..., {name}={name}.astype("
                    f"{'str' if name in ('identities', 'names', 'frame_names') else 'float'}))"
                )
                if name == "points":
                    raise KeypointFileError(text) from None
                warnings.append(text)
            except (BadZipFile, EOFError, OSError, zlib.error) as error:
                raise KeypointFileError(f"array `{name}` is damaged: {error}") from error
    return _detections(arrays, options, warnings)


def read_npy(path: Path, options: ReadOptions) -> Detections:
    """Return the objects in an array: (frames, q, 2 or 3) or (frames, objects, q, 2 or 3).

    Such an array has as many objects in each frame: one without a keypoint is padding.
    """
    try:
        points = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        reason = f"damaged or no .npy file: {error}"
        if "pickle" in str(error).lower():
            reason = "it holds Python objects, which could run code when they are read; save it "
            reason += "with numbers: np.save(FILE, np.array(points, float))"
        raise KeypointFileError(reason) from None
    if points.ndim == 2 and points.shape[1] in (2, 3):
        points = points[None]
    arrays = {"points": points}
    if points.ndim == 4:
        f, n = points.shape[:2]
        arrays = {
            "points": points.reshape(f * n, *points.shape[2:]),
            "frame": np.repeat(np.arange(f), n),
            "stamps": stamps_of(None, f, options.rate or DEFAULT_RATE),
        }
    return _detections(arrays, options, [], is_npy=True)


def _open(path: Path) -> Any:
    """Return an open .npz; raise KeypointFileError if it is none."""
    try:
        file = np.load(path, allow_pickle=False)
        if not hasattr(file, "files"):
            raise ValueError("it is one array; call it .npy")
        return file
    except Exception as error:  # a damaged file makes zipfile and NumPy raise many types
        raise KeypointFileError(f"damaged or no .npz file: {error}") from error


def _of_others(file: Any, options: ReadOptions) -> str:
    """Return the error text for an .npz without `points`."""
    layout = options.layout or options.fallback
    q = len(layout) if layout else "q"
    origin = next((text for name, text in _OF_OTHERS.items() if name in file.files), "")
    found = ", ".join(f"`{name}`" for name in file.files) or "no array"
    text = f"no array `points` (objects, {q}, 2); there are: {found}"
    if not origin:
        return text
    return (
        f"it is {origin} ({found}), in which keypoints are Python objects: they could run code "
        "when they are read. Load it yourself with np.load(FILE, allow_pickle=True) if you trust "
        f"it, and save np.savez(NEW, points=array (objects, {q}, 2), frame=array (objects,))"
    )


def _detections(
    arrays: Mapping[str, NDArray[Any]],
    options: ReadOptions,
    warnings: list[str],
    is_npy: bool = False,
) -> Detections:
    """Return the objects in arrays as detections, in the order of their frames.

    Args:
        arrays: by their names in an .npz; `points` (m, q, 2 or 3), the others optional.
        options: how they are read.
        warnings: from reading the arrays.
        is_npy: whether they are of an .npy, with as many objects in each frame, and `stamps` made
            by `options.rate`.

    Raises:
        KeypointFileError: an array is not usable, or an option contradicts it.
    """
    points = _numbers(arrays, "points", np.float64)
    layout = _layout(arrays, options)
    _check_shape(points, layout)
    m, q = points.shape[:2]
    if "confidence" in arrays:
        confidence = _numbers(arrays, "confidence", np.float64, (m, q))
        points = np.concatenate([points[..., :2], confidence[..., None]], -1)
    frame = _frame_of_each(arrays, m)
    frames, stamps = _frames_and_stamps(arrays, frame, options, rate_acts=is_npy)
    scores = _scores(arrays, m, options)
    identities, warning = _identities(arrays, frame)
    warnings = [*warnings, warning] if warning else warnings
    given = points[..., 2] if points.shape[2] == 3 else np.ones((m, q))
    findings = confidence_scale(given) + find_origin(points[..., :2], given)
    observation = to_observation(points, options.min_confidence)
    is_padding = _is_padding(points, options) if is_npy else np.zeros(m, bool)
    order = np.argsort(frame, kind="stable")
    kept = order[scores[order] >= options.min_score] if options.min_score else order
    if len(kept) < m:
        low = f"{m - len(kept)} that have a score below --min-score {options.min_score:g}"
        warnings = [*warnings, f"left out: {low}"]
    return Detections(
        observation.points[kept],
        observation.confidence[kept],
        frame[kept],
        identities[kept],
        stamps,
        frames=frames,
        scores=scores[kept],
        layout=layout,
        warnings=tuple(warnings),
        findings=tuple(findings),
        is_padding=is_padding[kept],
    )


def _is_padding(points: NDArray[Any], options: ReadOptions) -> NDArray[np.bool_]:
    """Return which objects (m,) of (m, q, 2 or 3) have no keypoint, whatever its confidence.

    A keypoint below `min_confidence` is one: the object is no padding, but is poorly seen.
    """
    found = without_value(to_observation(points), options.missing_value)
    return np.asarray(~found.confidence.any(1))


def _layout(arrays: Mapping[str, NDArray[Any]], options: ReadOptions) -> KeypointLayout | None:
    """Return the layout of the keypoints: of the options, of `names`, or the fallback.

    Raises:
        KeypointFileError: `names` contradicts the layout of the options, or are not as many as
            the keypoints.
    """
    names = arrays.get("names")
    if names is None or names.dtype.kind != "U" or names.ndim != 1:
        return options.layout or options.fallback
    q = arrays["points"].shape[1] if arrays["points"].ndim == 3 else len(names)
    if len(names) != q:
        raise KeypointFileError(
            f"its `names` are {len(names)}, and `points` has {q} keypoints: save a name for each, "
            "or leave `names` out"
        )
    named = layout_of_names(names.tolist(), options.owners())
    reason = contradiction(options.layout, named) if options.layout else ""
    if options.layout and reason:
        raise KeypointFileError(
            f"its `names` are not those of the keypoint layout {options.layout.name}: "
            f"{reason}; leave out --keypoint-layout to use the names of the file"
        )
    return options.layout or named


def _check_shape(points: NDArray[Any], layout: KeypointLayout | None) -> None:
    """Raise KeypointFileError unless points are (m, q, 2 or 3), with the layout's q keypoints."""
    if points.ndim != 3 or points.shape[2] not in (2, 3):
        q = len(layout) if layout else "q"
        raise KeypointFileError(
            f"`points` is {points.shape}; (objects, {q}, 2), or 3 with the confidence, is "
            f"needed: x, y in the order of the keypoint layout{_remedy(points.shape)}"
        )
    q = points.shape[1]
    if layout and q != len(layout):
        raise KeypointFileError(f"`points` is {points.shape}: {wrong_count(q, layout)}")


def _frame_of_each(arrays: Mapping[str, NDArray[Any]], m: int) -> NDArray[np.int64]:
    """Return the frame (m,) of each object: `frame`, else one frame for each object.

    Raises:
        KeypointFileError: a frame is negative, or there are far more frames than objects.
    """
    if "frame" not in arrays:
        return np.arange(m)
    frame = _numbers(arrays, "frame", np.int64, (m,))
    if m and int(frame.min()) < 0:
        raise KeypointFileError(f"`frame` has {frame.min()}; frames are counted from 0")
    last = int(frame.max(initial=-1))
    if last + 1 > m + _MAX_EMPTY:
        raise KeypointFileError(
            f"`frame` goes to {last} with {m} objects; at most {_MAX_EMPTY} frames may show nobody"
        )
    return frame


def _frames_and_stamps(
    arrays: Mapping[str, NDArray[Any]],
    frame: NDArray[np.int64],
    options: ReadOptions,
    *,
    rate_acts: bool,
) -> tuple[Frames, NDArray[np.int64]]:
    """Return numbers and names of all frames, and their stamps, also of those without objects.

    Raises:
        KeypointFileError: arrays of frames differ in length, or a rate contradicts `stamps`.
    """
    count = int(frame.max(initial=-1)) + 1
    for name in ("stamps", "frame_numbers", "frame_names"):
        if name in arrays and arrays[name].ndim == 1:
            count = max(count, len(arrays[name]))
    numbers = None
    if "frame_numbers" in arrays:
        numbers = _numbers(arrays, "frame_numbers", np.int64, (count,))
    if "stamps" in arrays:
        if options.rate and not rate_acts:
            raise KeypointFileError("it has `stamps` of its own: leave out --rate")
        stamps = _numbers(arrays, "stamps", np.int64, (count,))
    else:
        stamps = stamps_of(numbers, count, options.rate or DEFAULT_RATE)
    names = arrays.get("frame_names", np.full(count, "")).astype(str)
    if names.shape != (count,):
        raise KeypointFileError(f"`frame_names` is {names.shape}; ({count},) is needed")
    return Frames(np.arange(count) if numbers is None else numbers, names), stamps


def _scores(
    arrays: Mapping[str, NDArray[Any]], m: int, options: ReadOptions
) -> NDArray[np.float32]:
    """Return the score (m,) of each object; 1 without `scores`.

    Raises:
        KeypointFileError: there are none, and the options have a least score.
    """
    if "scores" in arrays:
        return _numbers(arrays, "scores", np.float32, (m,))
    if options.min_score:
        raise KeypointFileError("it has no array `scores` (objects,): leave out --min-score")
    return np.ones(m, np.float32)


def _identities(
    arrays: Mapping[str, NDArray[Any]], frame: NDArray[np.int64]
) -> tuple[NDArray[np.str_], str]:
    """Return the identity (m,) of each object and a warning, or ""; see `identities_of`.

    Without `identities` an object has its index in its frame.

    Raises:
        KeypointFileError: `identities` has another shape.
    """
    if "identities" not in arrays:
        return index_in_frame(frame).astype(str), ""
    given = arrays["identities"]
    if given.shape != frame.shape:
        raise KeypointFileError(f"`identities` is {given.shape}; ({len(frame)},) is needed")
    texts = [None if t in ("-1", "") else t for t in given.astype(str).tolist()]
    return identities_of(texts, frame)


def _remedy(shape: tuple[int, ...]) -> str:
    """Return how an array of another order becomes one of objects; "" if that is not clear."""
    if len(shape) == 2 and shape[1] >= 8:
        sizes = [size for size in (3, 2) if shape[1] % size == 0]
        forms = " or ".join(f"({shape[0]}, {shape[1] // n}, {n})" for n in sizes)
        return f"; if a row is an object, save points.reshape{forms}" if sizes else ""
    if len(shape) == 3 and (axes := [i for i in (1, 0) if shape[i] in (2, 3)]):
        first, second = [i for i in range(3) if i != axes[0]]
        if axes[0] == 0 and shape[first] < shape[second]:  # more frames than keypoints
            first, second = second, first
        order = f"{first}, {second}, {axes[0]}"
        return f"; save points.transpose({order}), if that is the order"
    return ""


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
