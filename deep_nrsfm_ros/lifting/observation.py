# SPDX-License-Identifier: Apache-2.0
"""What one message of a detector shows: keypoints, their confidence, and identities."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.model_files.matching_model import model_of_count

MAX_COORDINATE = 1e9
"""Pixels; a keypoint with a larger coordinate is missing.

No image is this large, and sums of squares of such numbers stay far below the largest float32.
"""
MIN_POSITIVE = np.nextafter(np.float32(0), np.float32(1))
"""The smallest positive float32: a keypoint of confidence 0 is missing at any threshold."""
_BORDER = 0.002  # of the image's side
_FAR = 0.05  # fraction of keypoints half an image outside that is too many
_JUST = 0.01  # of the image's side: a keypoint that is less outside is at the border
_SURE = 0.5  # of the median confidence, below which a keypoint is a guess
_HALF_PIXEL = np.float32(0.5)  # the last pixel is at size - 1
_CERTAIN, _MISSING = np.float32(1), np.float32(0)

Identities = tuple[str | None, ...]
"""Identity of each object; None for an object without one, () if no object has one."""

NAME_THE_LAYOUT = (
    "name the layout in which the detector gives them (parameter keypoint_layout, option "
    "--keypoint-layout)"
)
"""The remedy for another number of keypoints than the layout has, for error texts."""


class MessageError(ValueError):
    """A message that cannot be used; the text says what was expected and what was received."""


class Observation(NamedTuple):
    """The n objects of one message, each with q keypoints in the detector's order.

    Attributes:
        points: (n, q, 2) float32, x right and y down, in pixels; (0, 0) where missing.
        confidence: (n, q) float32 in (0, 1]; 0 where missing.
        identities: n, as the detector gives them; None for an object without one, () if the
            detector gives none at all.
        scores: n, of the objects, in the detector's own scale; () if it gives none.
        left_out: a reason for each object or keypoint of the message that is left out.
        places: n, the index in the message of each object; () if the message has no list of them.
    """

    points: NDArray[np.float32]
    confidence: NDArray[np.float32]
    identities: Identities = ()
    scores: tuple[float, ...] = ()
    left_out: tuple[str, ...] = ()
    places: tuple[int, ...] = ()

    def above(self, min_score: float) -> Observation:
        """Return the objects with a score of at least `min_score`; all if none has a score."""
        if not min_score or not self.scores:
            return self
        kept = [i for i, score in enumerate(self.scores) if score >= min_score]
        if len(kept) == len(self.scores):
            return self
        return Observation(
            self.points[kept],
            self.confidence[kept],
            tuple(self.identities[i] for i in kept) if self.identities else (),
            tuple(self.scores[i] for i in kept),
            self.left_out,
            tuple(self.places[i] for i in kept) if self.places else (),
        )


def left_out_sentences(reasons: Iterable[str], most: int = 3) -> list[str]:
    """Return a sentence for each reason why objects or keypoints of messages are left out.

    Args:
        reasons: `left_out` of all observations.
        most: reasons that are told one by one, the frequent ones first.
    """
    counts = Counter(reasons)
    sentences = [f"{reason} ({count} times)" for reason, count in counts.most_common(most)]
    if others := counts.total() - sum(count for _, count in counts.most_common(most)):
        sentences.append(f"{others} more objects or keypoints are left out for other reasons")
    return sentences


def to_observation(
    values: NDArray[np.floating], min_confidence: float = 0.0, identities: Identities = ()
) -> Observation:
    """Return an observation in which unusable keypoints are marked as missing.

    A keypoint is missing if it is at (0, 0), if its confidence is 0 or below `min_confidence`, if
    a coordinate exceeds `MAX_COORDINATE`, or if one of its numbers is NaN or infinite.

    Args:
        values: (n, q, 3) x and y in pixels and confidence, or (n, q, 2) x and y, of confidence 1.
            A confidence above 1 counts as 1.
        min_confidence: in [0, 1], typically 0.1.
        identities: of the n objects, or ().
    """
    if values.dtype != np.float32:
        with np.errstate(over="ignore", invalid="ignore"):
            values = values.astype(np.float32)
    planes = values.transpose(2, 0, 1)
    # NaN compares false, so this test rejects NaN as well as infinity.
    visible = np.logical_and.reduce(np.abs(planes) < MAX_COORDINATE)
    visible &= np.logical_or(planes[0], planes[1])
    if len(planes) == 3:
        visible &= planes[2] >= max(np.float32(min_confidence), MIN_POSITIVE)
        confidence = np.where(visible, np.minimum(planes[2], _CERTAIN), _MISSING)
    else:
        confidence = np.where(visible, _CERTAIN, _MISSING)
    points = np.zeros((*visible.shape, 2), np.float32)
    np.copyto(points, values[..., :2], where=visible[..., None])
    return Observation(points, confidence, identities)


def without_border(observation: Observation, size: tuple[int, int]) -> Observation:
    """Return the observation with keypoints at the image's border, or outside, as missing.

    A detector puts there what it does not see: the legs of a person whom the image cuts off. The
    border is 1 pixel wide, or 0.2 % of the image's side if that is more. Where many keypoints are
    far outside, the size is not that of their image, and nothing is left out.

    Args:
        observation: n objects in pixels.
        size: width and height of the image in pixels.
    """
    points, confidence = observation.points, observation.confidence
    half = np.array(size, np.float32) / 2
    inner = half - np.maximum(np.float32(1), np.float32(2 * _BORDER) * half)
    visible = confidence > 0
    outside, far = np.empty_like(visible), np.empty_like(visible)
    for rows in slices(len(points)):
        outside[rows] = (np.abs(points[rows] - half + _HALF_PIXEL) >= inner).any(-1)
        far[rows] = (np.abs(points[rows] - half) > 2 * half).any(-1)
    if not (outside & visible).any() or (far & visible).sum() > _FAR * visible.sum():
        return observation
    points = np.where(outside[..., None], _MISSING, points)
    confidence = np.where(outside, _MISSING, confidence)
    return observation._replace(points=points, confidence=confidence)


def outside_share(
    points: NDArray[np.floating], confidence: NDArray[np.floating], size: tuple[int, int]
) -> float:
    """Return the fraction of sure keypoints outside an image, and not merely at its border.

    Sure is a confidence of at least half the median: detectors guess outside the image what they do
    not see of a person whom it cuts off.

    Args:
        points: (n, q, 2) in pixels.
        confidence: (n, q); 0 where missing.
        size: width and height of the image in pixels.
    """
    visible = confidence > 0
    if not visible.any():
        return 0.0
    sure = visible & (confidence >= _SURE * np.median(confidence[visible]))
    half = np.array(size, np.float32) / 2
    reach, count = (1 + 2 * _JUST) * half, 0
    for rows in slices(len(points)):
        beyond = (np.abs(points[rows] - half) > reach).any(-1)
        count += int((beyond & sure[rows]).sum())
    return count / int(sure.sum())


def without_value(observation: Observation, value: float | None) -> Observation:
    """Return the observation with keypoints of which x or y is `value` as missing.

    Args:
        observation: n objects.
        value: what the detector writes for a missing coordinate, -1 typical; None: nothing.
    """
    if value is None:
        return observation
    marked = (observation.points == np.float32(value)).any(-1) & (observation.confidence > 0)
    if not marked.any():
        return observation
    points = np.where(marked[..., None], _MISSING, observation.points)
    return observation._replace(
        points=points, confidence=np.where(marked, _MISSING, observation.confidence)
    )


def from_arrays(
    points: ArrayLike, confidence: ArrayLike | None, layout: KeypointLayout
) -> Observation:
    """Return an observation of arrays in any dtype, with missing keypoints as `to_observation`.

    Args:
        points: (n, q, 2), or (q, 2) of one object, x right and y down. What a mask of `numpy.ma`
            hides is missing, in the confidence too.
        confidence: (n, q) or (q,), from 0 to 1, or booleans; None: all are 1.
        layout: of the q keypoints.

    Raises:
        ValueError: the arrays do not fit each other or the layout.
    """
    xy, q = unmasked(points, np.nan), len(layout)
    xy = xy[None] if xy.ndim == 2 else xy
    if xy.ndim != 3 or xy.shape[1:] != (q, 2) or xy.dtype.kind not in "fiu":
        hint = ""
        if xy.ndim == 3 and xy.shape[1:] == (q, 3):
            hint = "; give confidence as the second argument: points[..., :2], points[..., 2]"
        raise ValueError(
            f"points are {np.shape(points)} of {xy.dtype}; keypoint layout {layout.name!r} needs "
            f"numbers of shape (n, {q}, 2) or ({q}, 2){hint}"
        )
    xy = xy.astype(np.float64)
    if confidence is None:
        return to_observation(xy)
    certainty = unmasked(confidence, 0)
    if certainty.shape != np.shape(points)[:-1] or certainty.dtype.kind not in "fiub":
        raise ValueError(
            f"confidence is {certainty.shape} of {certainty.dtype}; points of {np.shape(points)} "
            f"need numbers of shape {np.shape(points)[:-1]}"
        )
    certainty = certainty.reshape(xy.shape[:2]).astype(np.float64)
    return to_observation(np.concatenate((xy, certainty[..., None]), -1))


def unmasked(values: ArrayLike, missing: float) -> NDArray[Any]:
    """Return values as an array, with `missing` where a mask of `numpy.ma` hides them."""
    if not isinstance(values, np.ma.MaskedArray):
        return np.asarray(values)
    is_hidden = np.broadcast_to(np.asarray(values.mask), values.shape)
    plain = np.asarray(values.data)
    if not is_hidden.any() or plain.dtype.kind not in "fiub":
        return plain
    return np.where(is_hidden, missing, plain)


def check_keypoints(count: int, keypoints: int, field: str) -> None:
    """Raise MessageError unless a message has as many keypoints as the layout.

    Args:
        count: keypoints of the message.
        keypoints: keypoints of the layout.
        field: the field of the message that holds the count, for the error text.
    """
    if count != keypoints:
        raise MessageError(
            f"message has {count} keypoints ({field}); the keypoint layout has {keypoints}: "
            + _other_model(count)
            + NAME_THE_LAYOUT
        )


def _other_model(count: int) -> str:
    """Return a hint at the package's model of an object with so many keypoints, or ""."""
    name = model_of_count(count)
    return f"{count} keypoints are those of model {name!r}: -p model:={name}; else " if name else ""
