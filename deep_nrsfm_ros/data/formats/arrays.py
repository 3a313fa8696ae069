# SPDX-License-Identifier: Apache-2.0
"""Arrays of NumPy: .npz with named arrays, .npy with the keypoints alone."""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.detections import Detections, Frames, index_in_frame
from deep_nrsfm_ros.data.formats.array_names import (
    find_roles,
    find_unused_arrays,
    points_under_another_name,
    read_headers,
    taken_for,
    unit_in_name,
)
from deep_nrsfm_ros.data.formats.builder import (
    UNITS,
    KeypointFileError,
    as_identity,
    identities_of,
    plausible_unit,
    wrong_count,
)
from deep_nrsfm_ros.data.formats.frame_numbers import stamps_of
from deep_nrsfm_ros.data.formats.names import contradiction, layout_of_names
from deep_nrsfm_ros.data.formats.overlap import CROWD, SAME_PLACE, overlap_in_turn
from deep_nrsfm_ros.data.read_options import DEFAULT_RATE, ReadOptions
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.observation import to_observation, without_value
from deep_nrsfm_ros.lifting.sanity import Finding, confidence_scale, find_origin

_MAX_EMPTY = 1_000_000  # frames without an object: nine hours at 30 Hz
_TEXTS = ("identities", "names", "frame_names")
_MEDIAPIPE = 33  # landmarks of MediaPipe Pose, of x, y, z, visibility
_LATEST = 2.0**62  # ns
_FRACTION = 2.0  # depths of MediaPipe, in widths of the image, are below it
_SAMPLE = 5000  # objects
_MANY = 0.5  # fraction of objects that makes a suspicion a warning
_OF_OTHERS = {
    "positions_2d": "VideoPose3D's data_2d_*.npz",
    "boxes": "detections of Detectron, as VideoPose3D's infer_video.py writes them",
}


def read_npz(path: Path, options: ReadOptions) -> Detections:
    """Return the objects in the arrays of an .npz: see README, "Files instead of topics".

    Only the arrays that are needed are read. One under another name is known by its shape and the
    words in its name; what is not used is named.
    """
    warnings: list[str] = []
    arrays: dict[str, NDArray[Any]] = {}
    with _open(path) as file:
        if "points" not in file.files:
            raise KeypointFileError(_of_others(file, options))
        headers = read_headers(file)
        roles = find_roles(headers)
        for role, name in roles.items():
            try:
                arrays[role] = file[name]
            except ValueError as error:
                if "pickle" not in str(error).lower():
                    raise
                text = (
                    f"array `{name}` holds Python objects, which could run code when they are "
                    f"read; save it with a plain type: np.savez(..., {name}={name}.astype("
                    f"{'str' if role in _TEXTS else 'float'}))"
                )
                if role == "points":
                    raise KeypointFileError(text) from None
                warnings.append(text)
            except (BadZipFile, EOFError, OSError, zlib.error) as error:
                raise KeypointFileError(f"array `{name}` is damaged: {error}") from error
    rows, findings = _rows(arrays), list[Finding]()
    if "frame" in rows:
        rows["frame"] = _frame_of_each(rows, len(rows["points"]))
    notes = _use_others(rows, roles, findings)
    options = _with_rate(rows, roles, options)
    sentences, unused = find_unused_arrays(headers, roles)
    has_padding = arrays["points"].ndim == 4
    found = _detections(rows, options, warnings, has_padding=has_padding)
    return _said(
        found, [*notes, *sentences], findings + unused + _find_axes(arrays["points"], found)
    )


def read_npy(path: Path, options: ReadOptions) -> Detections:
    """Return the objects in an array: (frames, q, 2 to 4) or (frames, objects, q, 2 to 4).

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
    found = _detections(_rows({"points": points}), options, [], has_padding=True)
    return _said(found, [], _find_axes(points, found))


def _said(found: Detections, notes: list[str], findings: list[Finding]) -> Detections:
    """Return detections with more notes and findings."""
    findings = [*found.findings, *findings]
    return dataclasses.replace(found, notes=(*notes, *found.notes), findings=tuple(findings))


def _rows(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return arrays with a row for each object, where `points` is (frames, objects, q, ...)."""
    points = arrays["points"]
    if points.ndim != 4:
        return dict(arrays)
    f, n = points.shape[:2]
    rows = {
        role: array.reshape(f * n, *array.shape[2:]) if array.shape[:2] == (f, n) else array
        for role, array in arrays.items()
    }
    frame = rows.get("frame", np.arange(f))
    rows["frame"] = np.repeat(frame, n) if frame.shape == (f,) else frame
    return rows


def _use_others(
    rows: dict[str, NDArray[Any]], roles: Mapping[str, str], findings: list[Finding]
) -> list[str]:
    """Turn numbers and times under other names into `frame`, `frame_numbers` and `stamps`.

    What is no number or time of a frame is left out, with a finding.

    Args:
        rows: the arrays by their roles; changed.
        roles: what is read -> name of the array.
        findings: is given what looks wrong.

    Returns:
        Sentences on how the arrays are taken.
    """
    notes, roles = list[str](), dict(roles)
    if "stamps" in rows and _has_fractions(rows["stamps"]):  # in seconds, then
        rows["times"], roles["times"] = rows.pop("stamps"), "stamps"
    numbers, times = rows.pop("numbers", None), rows.pop("times", None)
    taken = dict(roles)
    if numbers is not None and not _use_numbers(rows, numbers):
        del taken["numbers"]
        findings.append(
            Finding(
                "unused",
                f"not used: array {roles['numbers']}, which has no whole number for each object; "
                "save the index of the frame of each as `frame`",
            )
        )
    if times is not None and (unit := _use_times(rows, times, unit_in_name(roles["times"]))):
        notes.append(f"its times (`{roles['times']}`) are taken for {unit}")
    elif times is not None:
        findings.append(
            Finding(
                "unused",
                f"not used: array {roles['times']}, which has no growing time for each frame, 1 ms "
                "to 10 s apart; save the times of the frames in ns as `stamps`",
            )
        )
    return [*taken_for(taken), *notes]


def _has_fractions(array: NDArray[Any]) -> bool:
    """Return whether an array has a number that is no whole one."""
    if array.dtype.kind != "f" or array.ndim != 1:
        return False
    finite = array[np.isfinite(array)]
    return bool((finite != np.round(finite)).any())


def _use_numbers(rows: dict[str, NDArray[Any]], numbers: NDArray[Any]) -> bool:
    """Set the frames by their numbers in the input; return False if they are none."""
    exact = numbers.astype(np.float64)
    if not (np.abs(exact) < 2**62).all() or (exact != np.round(exact)).any():  # NaN compares false
        return False
    frame, m = rows.get("frame"), len(rows["points"])
    numbers = numbers.astype(np.int64).ravel()
    if frame is None:
        rows["frame_numbers"], rows["frame"] = np.unique(numbers, return_inverse=True)
        return True
    f = int(frame.max(initial=-1)) + 1
    if len(numbers) == m != f:  # of each of the objects of a frame
        numbers = numbers.reshape(f, -1)[:, 0]
    rows.setdefault("frame_numbers", numbers)
    return True


def _use_times(rows: dict[str, NDArray[Any]], times: NDArray[Any], unit: str) -> str:
    """Set the stamps by times in a unit; return it, or "" if they are no times of the frames.

    Args:
        rows: the arrays by their roles; changed.
        times: of each object or each frame.
        unit: a key of `UNITS`; "" = the one in which frames are a plausible time apart.
    """
    values, m = times.astype(np.float64), len(rows["points"])
    if not np.isfinite(values).all() or (np.diff(values) < 0).any():
        return ""
    frame = rows.get("frame")
    if frame is None and len(values) == m:
        values, frame = np.unique(values, return_inverse=True)
    if frame is None:
        return ""
    f = max(int(frame.max(initial=-1)) + 1, len(rows.get("frame_numbers", ())))
    if len(values) == m != f:
        shown, first = np.unique(frame, return_index=True)
        values = np.interp(np.arange(f), shown, values[first])
    unit = unit or plausible_unit(values)
    if len(values) != f or not unit or np.abs(values).max(initial=0) >= _LATEST / UNITS[unit]:
        return ""
    # Relative to the first one: a float64 of seconds since 1970 has steps of 0.2 us.
    start = round(float(values[0])) if f else 0
    rows["frame"] = frame
    rows["stamps"] = np.round((values - start) * UNITS[unit]).astype(np.int64) + start * UNITS[unit]
    return unit


def _with_rate(
    rows: dict[str, NDArray[Any]], roles: Mapping[str, str], options: ReadOptions
) -> ReadOptions:
    """Return options with the frames per second that a file says.

    Raises:
        KeypointFileError: the options say another one, or it is none.
    """
    if "rate" not in rows:
        return options
    rate, name = float(rows.pop("rate").ravel()[0]), roles["rate"]
    if not 1e-3 <= rate <= 1e6:
        raise KeypointFileError(f"`{name}` is {rate:g}, no number of frames a second")
    if "stamps" in rows:
        return options
    if options.rate and abs(options.rate - rate) > 1e-3 * rate:
        raise KeypointFileError(f"it has `{name}` {rate:g}: leave out --rate {options.rate:g}")
    return dataclasses.replace(options, rate=rate)


def _find_axes(points: NDArray[Any], found: Detections) -> list[Finding]:
    """Return whether frames were taken for objects: these lie where others lie, as over time.

    Args:
        points: as the file has them.
        found: the objects as they are read.
    """
    if points.ndim == 4 and points.shape[1] >= CROWD:
        in_frame = overlap_in_turn(points)
        if in_frame <= max(SAME_PLACE, overlap_in_turn(points.swapaxes(0, 1))):
            return []
        return [
            Finding(
                "one-frame",
                f"`points` {points.shape} is read as frames, objects, keypoints, but the objects "
                "of a frame lie on each other, as one does over time: save points.transpose(1, 0, "
                "2, 3) if the first axis is the people, or points[0] if it is the cameras",
            )
        ]
    m = len(found)
    if points.ndim != 3 or m < CROWD or found.frame[0] != found.frame[-1]:
        return []
    if overlap_in_turn(found.points[None]) <= SAME_PLACE:
        return []
    return [
        Finding(
            "one-frame",
            f"all {m} objects are of one frame, and lie on each other: if each is of a frame of "
            "its own, leave `frame` out, or give it the number of the frame of each",
        )
    ]


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
        name = points_under_another_name(read_headers(file))
        return text + (f"; save np.savez(NEW, points=np.load(FILE)[{name!r}])" if name else "")
    return (
        f"it is {origin} ({found}), in which keypoints are Python objects: they could run code "
        "when they are read. Load it yourself with np.load(FILE, allow_pickle=True) if you trust "
        f"it, and save np.savez(NEW, points=array (objects, {q}, 2), frame=array (objects,))"
    )


def _detections(
    arrays: Mapping[str, NDArray[Any]],
    options: ReadOptions,
    warnings: list[str],
    *,
    has_padding: bool,
) -> Detections:
    """Return the objects in arrays as detections, in the order of their frames.

    Args:
        arrays: by their names in an .npz; `points` (m, q, 2 or 3), the others optional.
        options: how they are read.
        warnings: from reading the arrays.
        has_padding: whether each frame has as many objects, so that one without a keypoint is
            none.

    Raises:
        KeypointFileError: an array is not usable, or an option contradicts it.
    """
    points = _numbers(arrays, "points", np.float64)
    layout = _layout(arrays, options)
    _check_shape(points, layout)
    if points.shape[2] == 4:
        points = points[..., [0, 1, 3]]
        if points.shape[1] != _MEDIAPIPE:
            warnings = [*warnings, "four numbers of a keypoint are read as x, y, z, confidence"]
    m, q = points.shape[:2]
    solid = list[Finding]()
    if "confidence" in arrays:
        confidence = _confidence(arrays["confidence"], (m, q))
        points = np.concatenate([points[..., :2], confidence[..., None]], -1)
    elif points.shape[2] == 3 and (depths := _count_depths(points)):
        solid = _find_solid(points)
        points[..., 2] = 1
        warnings = warnings if solid else [*warnings, depths]
    frame = _frame_of_each(arrays, m)
    frames, stamps = _frames_and_stamps(arrays, frame, options)
    scores = _scores(arrays, m, options)
    identities, warning = _identities(arrays, frame)
    warnings = [*warnings, warning] if warning else warnings
    given = points[..., 2] if points.shape[2] == 3 else np.ones((m, q))
    findings = solid + confidence_scale(given) + find_origin(points[..., :2], given)
    observation = to_observation(points, options.min_confidence)
    is_padding = _is_padding(points, options) if has_padding else np.zeros(m, bool)
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


def _confidence(given: NDArray[Any], shape: tuple[int, int]) -> NDArray[Any]:
    """Return the confidence (m, q) of each keypoint; whether it is visible does, too."""
    if given.shape == (*shape, 1):
        given = given[..., 0]
    if given.dtype.kind == "b":
        given = given.astype(np.float64)
    return _numbers({"confidence": given}, "confidence", np.float64, shape)


def _count_depths(points: NDArray[Any]) -> str:
    """Return the sentence that the third numbers of (m, q, 3) are depths; "" if they are not."""
    third = points[..., 2]
    count = int(((third < 0) & (third != -1)).any(1).sum())
    shown = int((points[..., :2] != 0).any((1, 2)).sum())
    if count <= _MANY * max(shown, 1):
        return ""
    return (
        f"the third number of a keypoint is negative in {count} of {shown} objects: it is a depth "
        "and no confidence, so all keypoints count as seen"
    )


def _find_solid(points: NDArray[Any]) -> list[Finding]:
    """Return whether (m, q, 3) with depths look like 3D points, whose depths are no fractions."""
    third = points[:: max(1, len(points) // _SAMPLE), :, 2]
    third = np.abs(third[np.isfinite(third) & (third != 0)])
    if not third.size or (third > _FRACTION).mean() <= _MANY:
        return []
    return [
        Finding(
            "depth",
            f"the third number of a keypoint goes to {third.max():.4g} and is negative in many "
            "objects: it is a depth. If the points are 3D, `lift` needs the 2D keypoints that they "
            "come from; if x and y are pixels of the image, save points[..., :2]",
        )
    ]


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
    """Raise KeypointFileError unless points are (m, q, 2 to 4), with the layout's q keypoints."""
    if points.ndim != 3 or points.shape[2] not in (2, 3, 4):
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
        if options.rate:
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
    given = given.astype(str) if given.dtype.kind == "S" else given
    texts = [as_identity(each) for each in given.tolist()]
    return identities_of(texts, frame)


def _remedy(shape: tuple[int, ...]) -> str:
    """Return how an array of another order becomes one of objects; "" if that is not clear."""
    if len(shape) > 4:
        part = ", ".join([":"] * shape.index(1) + ["0"]) if 1 in shape[:-2] else "0"
        return f"; save a part of it, such as points[{part}]"
    if len(shape) == 2 and shape[1] >= 8:
        sizes = [size for size in (3, 2) if shape[1] % size == 0]
        sizes = [4] if shape[1] == 4 * _MEDIAPIPE else sizes
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
    if kind is np.int64 and not (np.abs(array.astype(np.float64)) < 2**63).all():
        raise KeypointFileError(f"`{name}` has a number that is no whole one of 64 bits")
    if kind is np.int64 and _has_fractions(array):
        times = ", and the times in ns `stamps`" if name == "frame" else ""
        raise KeypointFileError(f"`{name}` has fractions; whole numbers are needed{times}")
    return array.astype(kind)
