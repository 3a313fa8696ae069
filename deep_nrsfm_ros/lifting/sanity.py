# SPDX-License-Identifier: Apache-2.0
"""Findings about values that look wrong: keypoints, stamps and lifted shapes that nobody meant.

`lift`, `train` and the node share `check`. A finding names the number that looks wrong and the
remedy. It is no error: the values are used as they are.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.large_arrays import release
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.observation import outside_share
from deep_nrsfm_ros.wording import wording

Floats = NDArray[np.floating[Any]]
Size = tuple[int, int]
"""Width and height of an image in pixels."""

POOR_RESIDUAL = 0.3
"""Median residual of objects from which on the fit is poor."""
USUAL_RESIDUAL = 0.1
"""Median residual of objects below which the fit is usual."""
LOW_CONFIDENCE = 0.3
"""Median confidence of objects below which something looks wrong."""
OUTSIDE = 0.05
"""Fraction of keypoints outside the image above which its size is wrong."""

_MAX_OBJECTS = 5000  # objects of a sample; more cost time and change no finding
_NORMALISED = 2.0  # largest normalised coordinate; a detector puts some points beyond the border
_SIGNED = 0.05  # fraction of points with a negative coordinate, above which the range is -1 to 1
_TINY = 3.0  # pixels; no detector finds keypoints of smaller objects
_HIGH = 2.0  # COCO's mark of a visible keypoint; OpenPose and MMPose go a little above 1
_MANY_HIGH = 0.05  # fraction of confidences above it that is another scale
_SCALES = (10, 100, 255, 1000)  # largest values of usual scales
_UPRIGHT = 0.7  # cosine between the up axis of a person, in the image, and an axis of the image
_NEARLY_ALL = 0.9  # fraction of people that makes an orientation suspicious
_LYING = 0.6  # |cosine| between the up axis and the image's x, which a standing person is below
_IN_IMAGE = 0.3  # length in the image of an up axis of length 1 from which on its direction counts
_FACE = ("nose", "left_eye", "right_eye")
_SEEN = 0.5  # confidence of a face that is seen
_TURNED = 0.3  # cosine between the front of a person and the camera's axis: less is a profile
_MIN_FACES = 5  # people, which are too few for a verdict on left and right
_MIN_FACE_SHARE = 0.05  # of the people: fewer faces may be wrong keypoints of people from behind
_MIN_FOCAL = 10.0  # pixels; a smaller focal length belongs to normalised coordinates
_MIN_REPEATS = 3  # points on one spot that may be a sentinel
_MARKED = 0.001  # fraction of points on a spot such as (-1, -1) that is more than chance
_REPEATED = 0.01  # fraction of points on any other spot that is more than chance
_STANDS_OUT = 5  # times the points of the next spot: pixels of a coarse grid repeat alike
_FILLED = 0.98  # side of a box of 0 to 1 from which on an object fills it
_MARGIN = 0.5  # of the image's size: points further outside are far outside
_SCALED_TWICE = 20.0  # sizes of the image from its corner to the points
_MAX_PLACE = 1000.0  # metres from the camera
_FAR = 0.01  # fraction of objects at an impossible place that is too many
_MIN_OBJECTS = 20  # that tell how often a keypoint is wrong
_OFTEN_WRONG = 0.5  # fraction of the objects; of sound data it is up to 0.08, in short clips 0.25
_SELDOM_WRONG = 0.01  # fraction of the objects below which a wrong keypoint is not named
_SHOWN = 3  # keypoints named at most
_SECOND = 1_000_000_000  # ns
_SHORTEST, _LONGEST = 100_000, 3600 * _SECOND  # ns between frames: 10 kHz to one an hour
_UNITS = {"microseconds": 1_000, "milliseconds": 1_000_000, "seconds": _SECOND}


EXIT_DOUBTFUL = 3
"""Exit code of a program whose answer rests on data that looks wrong."""


@dataclass(frozen=True)
class Finding:
    """Something that looks wrong in the input or in the answer.

    Attributes:
        code: short name of the kind, e.g. "normalised"; the same for all findings of a kind.
        message: one sentence with the number that looks wrong, and the remedy.
    """

    code: str
    message: str

    def __str__(self) -> str:
        """Return the message."""
        return self.message

    @property
    def symptom(self) -> str:
        """Return the message up to its first colon or semicolon: what looks wrong, no remedy."""
        return re.split("[:;] ", self.message, maxsplit=1)[0]


def check(
    points: Floats,
    confidence: Floats,
    intrinsics: Intrinsics | None = None,
    image_size: Size | None = None,
    stamps: NDArray[np.int64] | None = None,
    lifted: Lifted | None = None,
    *,
    is_normalised: bool = False,
) -> list[Finding]:
    """Return what looks wrong in keypoints, their stamps and the shapes lifted from them.

    Args:
        points: (n, q, 2) keypoints, which should be pixels.
        confidence: (n, q) of the keypoints, as the detector gives it; 0 where missing.
        intrinsics: of the camera, in pixels; None: not used.
        image_size: width and height of the image in pixels; None: unknown.
        stamps: (f,) in ns, one for each frame, in the order of the frames; None: unknown.
        lifted: the objects, lifted; None: not lifted.
        is_normalised: the points were fractions of the image and are multiplied by its size, so
            that those somewhat outside say nothing of it.
    """
    findings = confidence_scale(confidence)
    visible, objects = _sample(confidence) > 0, _sample(points)
    if visible.any():
        if sentinel := find_sentinel(objects, visible):
            spot, times = sentinel
            visible = visible & ~(objects == spot).all(-1)
            findings.append(_sentinel(spot, times, int(_sample(confidence).astype(bool).sum())))
        found = list(_coordinates(objects, visible, intrinsics, image_size))
        if not (found or is_normalised or image_size is None):
            certainty = np.where(visible, _sample(confidence), 0)
            found = _outside(objects, certainty, image_size)
        findings += found
    if stamps is not None:
        findings += _stamps(np.asarray(stamps, np.int64))
    if lifted is not None:
        if intrinsics:
            findings += _places(lifted)
        used = image_size if intrinsics or is_normalised else None
        findings += quality(lifted.residual, lifted.object_confidence, used)
    return findings


def _sample(values: Floats) -> Floats:
    """Return at most `_MAX_OBJECTS` of values (n, ...), evenly spaced, without a copy."""
    return values[:: max(1, -(-len(values) // _MAX_OBJECTS))]


def looks_normalised(points: Floats, visible: NDArray[np.bool_]) -> bool:
    """Return whether keypoints are fractions of the image's size and not pixels.

    No object in an image is 2 pixels large, so small coordinates are no pixels.

    Args:
        points: (n, q, 2).
        visible: (n, q).
    """
    mask = visible[..., None]
    largest = max(
        float(points.max(where=mask, initial=0)), -float(points.min(where=mask, initial=0))
    )
    return 0 < largest <= _NORMALISED and not is_signed(points, visible)


def to_pixels(points: Floats, confidence: Floats, image_size: Size | None) -> Floats:
    """Return keypoints in pixels: normalised ones times the image's size, others as they are.

    Args:
        points: (n, q, 2); 0 where missing.
        confidence: (n, q); 0 where missing.
        image_size: width and height in pixels; None: unknown, the points are returned.
    """
    if image_size is None or not looks_normalised(points, confidence > 0):
        return points
    pixels: Floats = points * np.array(image_size, points.dtype)
    return pixels


def is_signed(points: Floats, visible: NDArray[np.bool_]) -> bool:
    """Return whether many visible keypoints (n, q, 2) have a negative coordinate."""
    negative = (points < 0).any(-1) & visible
    return bool(negative.sum() > _SIGNED * visible.sum())


def find_sentinel(points: Floats, visible: NDArray[np.bool_]) -> tuple[Floats, int] | None:
    """Return the spot (2,) that stands for a missing keypoint, and how often it is there.

    A spot such as (-1, -1) or (9999, 9999) is one when 0.1 % of the visible keypoints lie on it:
    both coordinates are negative or 0, or they are equal. Any other spot, such as the middle of the
    image, is one when 1 % lie on it, of three different keypoints or more. A spot without a
    negative coordinate must have far more of them than any other spot, and is none where one
    keypoint lies on it in nearly every object: it is the origin of the others.

    Args:
        points: (n, q, 2).
        visible: (n, q).

    Returns:
        None if there is no such spot.
    """
    total = int(visible.sum())
    x, y = points[..., 0], points[..., 1]
    is_below = visible & (x <= 0) & (y <= 0)
    spot = _most_frequent(points[is_below])
    if spot and spot[1] >= max(_MIN_REPEATS, _MARKED * total):
        return spot
    for is_candidate, least in ((visible & (x == y), _MARKED), (visible, _REPEATED)):
        spot = _most_frequent(points[is_candidate])
        if not spot or spot[1] < max(_MIN_REPEATS, least * total):
            continue
        is_there = visible & (points == spot[0]).all(-1)
        if _is_origin(is_there, least * total):
            continue
        next_spot = _most_frequent(points[visible & ~is_there])
        stands_out = not next_spot or spot[1] >= _STANDS_OUT * next_spot[1]
        # A keypoint that stands still is on one spot, but not three of them.
        if stands_out and (least == _MARKED or is_there.any(0).sum() >= _MIN_REPEATS):
            return spot
    return None


def _is_origin(is_there: NDArray[np.bool_], least: float) -> bool:
    """Return whether one keypoint makes a spot: it is there in each object, and others hardly are.

    So it is where the points are relative to that keypoint and a constant is added.

    Args:
        is_there: (n, q) whether a keypoint is on the spot.
        least: keypoints on a spot that stands for missing ones.
    """
    times = is_there.sum(0)
    is_always = times >= _NEARLY_ALL * len(is_there)
    others = int(times[~is_always].sum())
    return bool(is_always.sum() == 1) and others < max(_MIN_REPEATS, least)


def _most_frequent(points: Floats) -> tuple[Floats, int] | None:
    """Return the most frequent of points (n, 2), and how often it is there; None without points."""
    if not len(points):
        return None
    first, counts = np.unique(
        points[:, 0] + 1j * points[:, 1], return_index=True, return_counts=True
    )[1:]
    most = int(counts.argmax())
    return points[first[most]], int(counts[most])


def find_origin(points: Floats, confidence: Floats) -> list[Finding]:
    """Return whether a keypoint is the origin of all others, so that it counts as missing.

    Args:
        points: (n, q, 2), as the source gives them.
        confidence: (n, q) likewise; 0 where missing.
    """
    points, given = _sample(points), _sample(confidence) > 0
    at_origin = (points == 0).all(-1) & given
    always = np.flatnonzero(at_origin.sum(0) >= _NEARLY_ALL * max(len(points), 1))
    if len(always) != 1 or not is_signed(points, given & ~at_origin):
        return []
    return [
        Finding(
            "origin",
            f"keypoint {always[0]} (from 0) lies at (0, 0) in nearly all objects, and (0, 0) means "
            "missing: the points are relative to it; add a constant to all coordinates, such as "
            "1000",
        )
    ]


def confidence_scale(confidence: Floats) -> list[Finding]:
    """Return whether confidences are on another scale than 0 to 1.

    What is above 1 counts as 1, so that on a scale of 0 to 100 weak keypoints count fully.

    Args:
        confidence: (n, ...), as the detector gives it; 0, negative or NaN where missing.
    """
    sample = _sample(confidence)
    given = sample[(sample > 0) & (sample < np.inf)]
    if not given.size or (given > _HIGH).mean() <= _MANY_HIGH:
        return []
    largest = float(given.max())
    scale = next((scale for scale in _SCALES if largest <= scale), None)
    remedy = f"divide it by {scale}" if scale else "convert it"
    return [
        Finding(
            "confidence-scale",
            f"confidence up to {largest:.4g}: it must be 0 to 1, and more counts as 1; {remedy}",
        )
    ]


def quality(residual: Floats, confidence: Floats, image_size: Size | None = None) -> list[Finding]:
    """Return whether the lifted objects fit their keypoints poorly or have low confidence.

    Args:
        residual: (n,) as in `Lifted`; NaN where not lifted.
        confidence: (n,) of the objects.
        image_size: with which they were lifted; None: without.
    """
    is_lifted = ~np.isnan(residual)
    if not is_lifted.any():
        return []
    error = float(np.median(residual[is_lifted]))
    certainty = float(np.median(confidence[is_lifted]))
    if error >= POOR_RESIDUAL:
        return [
            Finding(
                "poor-fit",
                f"poor fit: median residual {error:.2f}, below 0.1 is usual: check"
                f"{_size_first(image_size)} the keypoint layout, the model, and that y points down",
            )
        ]
    if certainty < LOW_CONFIDENCE:
        return [
            Finding(
                "low-confidence",
                f"low confidence: median {certainty:.2f}; many keypoints are missing or guessed, "
                "or the model is of another object",
            )
        ]
    return []


def wrong_keypoints(wrong: NDArray[np.bool_], keypoints: Sequence[str]) -> list[Finding]:
    """Return whether a keypoint is left out of many objects because it contradicts the others.

    Args:
        wrong: (n, p) as in `Lifted`, of lifted objects.
        keypoints: names of the p keypoints.
    """
    if len(wrong) < _MIN_OBJECTS:
        return []
    shares = wrong.mean(0)
    worst = int(shares.argmax())
    if shares[worst] < _OFTEN_WRONG:
        return []
    return [
        Finding(
            "wrong-keypoint",
            f"keypoint {keypoints[worst]!r} contradicts the others in {shares[worst]:.0%} of the "
            "objects, where it is left out: check its place in the keypoint layout, and what the "
            "detector reports there",
        )
    ]


def wrong_keypoints_text(wrong: NDArray[np.bool_], keypoints: Sequence[str]) -> str:
    """Return which keypoints are left out, and of how many objects; "" if it is less than 1 %.

    Args:
        wrong: (n, p) as in `Lifted`, of lifted objects.
        keypoints: names of the p keypoints.
    """
    if not len(wrong):
        return ""
    shares = wrong.mean(0)
    order = [i for i in np.argsort(-shares, kind="stable")[:_SHOWN] if shares[i] >= _SELDOM_WRONG]
    return ", ".join(f"{keypoints[i]} {shares[i]:.0%}" for i in order)


def _size_first(image_size: Size | None) -> str:
    """Return what to check before all else where the size of the image was used; "" if not."""
    if image_size is None:
        return ""
    return (
        f" first the size of the image, {image_size[0]} x {image_size[1]} (width before height, of "
        "the image in which the keypoints were detected), then"
    )


def is_person(layout: KeypointLayout) -> bool:
    """Return whether a layout is of people, whose up axis is known."""
    return bool(layout.handedness) and {"left_hip", "left_ankle"} <= set(layout.keypoints)


def orientation(rotations: Floats, image_size: Size | None = None) -> list[Finding]:
    """Return whether nearly all people are upside down, or lie on their side, in the image.

    Args:
        rotations: (n, 3, 3) from object axes (x front, y left, z up) to camera axes (y down); NaN
            where not lifted.
        image_size: with which they were lifted; None: without.
    """
    x, y = _up_in_image(rotations).T
    if not len(x):
        return []
    if (upside_down := (y > 0).mean()) > _NEARLY_ALL and np.median(y) > _UPRIGHT:
        return [
            Finding(
                "orientation",
                f"{upside_down:.0%} of the people are upside down: y must point down; use "
                "height - y if it points up, or turn the image",
            )
        ]
    sideways = (np.abs(x) > _LYING).mean()
    if sideways > _NEARLY_ALL and np.median(np.abs(x)) > _UPRIGHT:
        return [
            Finding(
                "orientation",
                f"{sideways:.0%} of the people lie on their side: check"
                f"{_size_first(image_size)} that x and y are not exchanged and that the image is "
                "not turned",
            )
        ]
    return []


def _up_in_image(rotations: Floats) -> Floats:
    """Return the direction (m, 2) of the up axes in the image, of those that have one there."""
    up = rotations[:, :2, 2]
    length = np.linalg.norm(up, axis=1)
    has_direction = length > _IN_IMAGE  # False where not lifted
    directions: Floats = up[has_direction] / length[has_direction, None]
    return directions


def facing(
    rotations: Floats, confidence: Floats, layout: KeypointLayout, least: float = _SEEN
) -> list[Finding]:
    """Return whether depth comes out mirrored: faces are seen of people who face away.

    A person in a mirrored image is a person with mirrored depth, who fits as well. Only the face
    tells them apart: nobody's nose and eyes are seen from behind. Which mirror it is, the up axis
    of these people shows: y that points up turns them upside down, too, exchanged x and y lay them
    on their side, and with left and right exchanged they are upright.

    Args:
        rotations: (n, 3, 3) as in `orientation`.
        confidence: (n, q) of the keypoints, in `layout`.
        layout: of the keypoints.
        least: confidence of nose and eyes from which on the face is seen.
    """
    face = [layout.index(name) for name in _FACE if name in layout.keypoints]
    if "nose" not in layout.keypoints:
        return []
    front = rotations[:, 2, 0]
    seen = (confidence[:, face] >= least).all(1) & (np.abs(front) > _TURNED)
    enough = max(_MIN_FACES, _MIN_FACE_SHARE * len(rotations))
    if seen.sum() < enough or (away := (front[seen] > 0).mean()) <= _NEARLY_ALL:
        return []
    people = f"{away:.0%} of the {seen.sum()} people whose face is seen"
    up = _up_in_image(rotations[seen])
    x, y = (float(value) for value in np.median(up, axis=0)) if len(up) else (0.0, -1.0)
    if abs(x) > _UPRIGHT:
        return [
            Finding(
                "handedness",
                f"{people} come out facing away and lie on their side: x and y are exchanged; "
                "exchange them",
            )
        ]
    if y > 0:
        return [
            Finding(
                "handedness",
                f"{people} come out facing away and upside down: y points up, and must point down; "
                "use height - y",
            )
        ]
    return [
        Finding(
            "handedness",
            f"{people} come out facing away: left and right look exchanged; check the keypoint "
            "layout, and that images are not mirrored",
        )
    ]


def pose(
    rotations: Floats,
    confidence: Floats,
    layout: KeypointLayout,
    least: float = _SEEN,
    image_size: Size | None = None,
) -> list[Finding]:
    """Return `facing`, which says the cause, or else `orientation`; for the arguments see there."""
    return facing(rotations, confidence, layout, least) or orientation(rotations, image_size)


def _sentinel(spot: Floats, times: int, total: int) -> Finding:
    """Return the finding of a sentinel."""
    x, y = (float(value) for value in spot)
    return Finding(
        "sentinel",
        f"{times} of {total} visible keypoints lie at exactly ({x:g}, {y:g}), as detectors write "
        "it for a missing keypoint: give them confidence 0, NaN or (0, 0)"
        + wording(
            f", or name the value (--missing-value={x or y:g} for files, `missing` in a field "
            "mapping)",
            python="",
        ),
    )


def _coordinates(
    points: Floats,
    visible: NDArray[np.bool_],
    intrinsics: Intrinsics | None,
    image_size: Size | None,
) -> Iterator[Finding]:
    """Yield what is wrong with the unit of the keypoints."""
    if not visible.any():
        return
    shown = points[visible]
    low, high = float(shown.min()), float(shown.max())
    if max(-low, high) <= _NORMALISED:
        if intrinsics and min(intrinsics.focal) < _MIN_FOCAL:
            return
        camera = f", and the focal length is {intrinsics.focal[0]:.0f} pixels" if intrinsics else ""
        if is_signed(points, visible):
            yield Finding(
                "normalised",
                f"keypoints lie between {low:.2f} and {high:.2f}{camera}: these are no pixels; "
                "convert them to pixels with x right and y down",
            )
        elif _fill_their_box(points, visible):
            yield Finding(
                "normalised",
                f"keypoints of each object fill {low:.2f} to {high:.2f}: they are fractions of its "
                "box, not pixels; multiply x by the width of the box and y by its height",
            )
        else:
            yield Finding(
                "normalised",
                f"keypoints lie between {low:.2f} and {high:.2f}{camera}: they are normalised, not "
                "pixels; "
                + wording(
                    "give the size of the image (image_width and image_height), or ", python=""
                )
                + "multiply x by its width and y by its height",
            )
        return
    extent = _extent(points, visible)
    if extent < _TINY and not (intrinsics and min(intrinsics.focal) < _MIN_FOCAL):
        yield Finding(
            "normalised",
            f"the middle object is {extent:.2g} pixels large: these are no pixels; convert the "
            "keypoints to pixels",
        )
        return
    if image_size is None and intrinsics is None:
        return
    principal = intrinsics.principal if intrinsics else (0.0, 0.0)
    width, height = image_size or (2 * principal[0], 2 * principal[1])
    if min(width, height) <= 1:
        return
    size = np.array((width, height))
    relative = shown / size
    source = f"{width:.0f} x {height:.0f}" + ("" if image_size else " (twice the principal point)")
    beyond = np.abs(np.median(relative, 0)).max()
    far = ((relative < -_MARGIN) | (relative > 1 + _MARGIN)).any(-1).mean()
    worst = shown[np.abs(relative - 0.5).max(-1).argmax()]
    if beyond > _SCALED_TWICE:
        yield Finding(
            "pixels-called-normalised",
            f"the middle keypoint lies {beyond:.0f} image sizes away from an image of {source}: "
            "they are pixels that are taken as normalised; say units: pixels in the field mapping",
        )
    elif far > OUTSIDE:
        yield _outside_finding(far, source, worst)


def _outside(points: Floats, confidence: Floats, size: Size) -> list[Finding]:
    """Return whether so many keypoints lie outside the image that its size must be wrong."""
    if min(size) <= 1 or (share := outside_share(points, confidence, size)) <= OUTSIDE:
        return []
    shown = points[confidence > 0]
    worst = shown[np.abs(shown / np.array(size) - 0.5).max(-1).argmax()]
    return [_outside_finding(share, f"{size[0]} x {size[1]}", worst)]


def _outside_finding(share: float, image: str, worst: Floats) -> Finding:
    """Return the finding of keypoints outside the image."""
    return Finding(
        "outside",
        f"{share:.0%} of the keypoints lie outside the image of {image}, one at "
        f"({worst[0]:.0f}, {worst[1]:.0f}): the size is wrong; give that of the image in which the "
        "keypoints were detected, not resized or cut, width before height, and its camera (if "
        "it is right: give guesses outside the image a low confidence)",
    )


def _extent(points: Floats, visible: NDArray[np.bool_]) -> float:
    """Return the median of the larger sides of the objects' bounding boxes."""
    sides = _sides(points, visible)
    return float(np.median(sides.max(-1))) if len(sides) else np.inf


def _fill_their_box(points: Floats, visible: NDArray[np.bool_]) -> bool:
    """Return whether nearly all objects reach from 0 to 1 in x and in y."""
    sides = _sides(points, visible)
    return bool(len(sides)) and (sides.min(-1) > _FILLED).mean() > _NEARLY_ALL


def _sides(points: Floats, visible: NDArray[np.bool_]) -> Floats:
    """Return the sides (m, 2) of the bounding boxes of the objects with several keypoints."""
    mask = visible[..., None]
    high = np.max(points, axis=1, where=mask, initial=-np.inf)
    low = np.min(points, axis=1, where=mask, initial=np.inf)
    sides: Floats = (high - low)[visible.sum(1) > 1]
    return sides


def _stamps(stamps: NDArray[np.int64]) -> Iterator[Finding]:
    """Yield what is wrong with the stamps (f,) in ns."""
    if len(stamps) < 2:
        return
    spacing = np.diff(stamps)
    span = int(stamps.max()) - int(stamps.min())
    if span == 0:
        yield Finding(
            "stamps",
            f"all {len(stamps)} frames have the stamp {int(stamps[0])}: there is no time; let the "
            "detector fill header.stamp, or leave the stamps out and give the rate",
        )
        return
    middle = float(np.median(spacing[spacing > 0])) if (spacing > 0).any() else 0.0
    mean = span / (len(stamps) - 1)
    if mean < _SHORTEST:
        units = [unit for unit, factor in _UNITS.items() if _plausible(mean * factor)]
        guess = f"; they look like {units[0]}" if units else ""
        yield Finding(
            "stamps",
            f"frames are {mean:.3g} ns apart{guess}: stamps are in nanoseconds; convert them",
        )
        return
    if middle > _LONGEST:
        yield Finding(
            "stamps",
            f"frames are {middle / _SECOND:.0f} s apart: stamps are in nanoseconds; convert them",
        )
        return
    if backwards := int((spacing <= 0).sum()):
        first = int((spacing <= 0).argmax())
        yield Finding(
            "stamps",
            f"{backwards} of {len(spacing)} stamps are not above the one before, the first after "
            f"frame {first} ({int(stamps[first])} to {int(stamps[first + 1])} ns): sort the "
            "frames by time, or let one clock stamp them",
        )


def _plausible(spacing: float) -> bool:
    """Return whether frames may be so many ns apart: 1 kHz to one in 10 s."""
    return 0.001 * _SECOND <= spacing <= 10 * _SECOND


def _places(lifted: Lifted) -> Iterator[Finding]:
    """Yield objects behind the camera or kilometres away."""
    is_lifted = ~np.isnan(lifted.residual)
    if not is_lifted.any():
        return
    parts = slices(len(is_lifted))
    places = np.concatenate([lifted.shapes[rows][is_lifted[rows]].mean(1) for rows in parts])
    release(lifted)
    distance = np.linalg.norm(places, axis=1)
    farthest = places[distance.argmax()]
    if (behind := int((places[:, 2] < 0).sum())) > _FAR * len(places):
        yield Finding(
            "place",
            f"{behind} of {len(places)} objects are behind the camera: check the intrinsics and "
            "the unit of the keypoints",
        )
    elif (far := int((distance > _MAX_PLACE).sum())) > _FAR * len(places):
        x, y, z = (float(value) for value in farthest)
        yield Finding(
            "place",
            f"{far} of {len(places)} objects are more than {_MAX_PLACE:g} m away, one at "
            f"({x:.0f}, {y:.0f}, {z:.0f}): check the intrinsics, the unit of the keypoints and "
            "reference_length",
        )
