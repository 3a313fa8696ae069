"""What a detector saw at one time, whichever way it was told."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# No image is this large, and sums of squares stay far below the largest float32.
MAX_COORDINATE = 1e9
_CERTAIN, _MISSING = np.float32(1), np.float32(0)
MIN_POSITIVE = np.nextafter(np.float32(0), np.float32(1))

Identities = tuple[str | None, ...]


class MessageError(ValueError):
    """A message that cannot be read: says what was expected and what came."""


class Observation(NamedTuple):
    """What one message shows: n objects of q keypoints each, in the detector's order.

    points: (n, q, 2) float32, x right and y down; (0, 0) where missing.
    confidence: (n, q) float32, above 0 and at most 1; 0 where missing.
    identities: n, as the detector gives them; None for an object to which it gives none; () where
        it gives none at all.
    """

    points: NDArray[np.float32]
    confidence: NDArray[np.float32]
    identities: Identities = ()


def to_observation(
    values: NDArray[np.floating], min_confidence: float = 0.0, identities: Identities = ()
) -> Observation:
    """Return values (n, q, 2: x, y or 3: x, y, confidence) with missing keypoints marked.

    Values without a confidence are certain; a confidence above 1 counts as 1.
    """
    if values.dtype != np.float32:
        with np.errstate(over="ignore", invalid="ignore"):
            values = values.astype(np.float32)
    planes = values.transpose(2, 0, 1)
    # NaN compares false, so the first test drops it together with infinity.
    seen = np.logical_and.reduce(np.abs(planes) < MAX_COORDINATE)
    seen &= np.logical_or(planes[0], planes[1])
    if len(planes) == 3:
        seen &= planes[2] >= max(np.float32(min_confidence), MIN_POSITIVE)
        confidence = np.where(seen, np.minimum(planes[2], _CERTAIN), _MISSING)
    else:
        confidence = np.where(seen, _CERTAIN, _MISSING)
    points = np.zeros((*seen.shape, 2), np.float32)
    np.copyto(points, values[..., :2], where=seen[..., None])
    return Observation(points, confidence, identities)


def check_keypoints(count: int, keypoints: int, where: str) -> None:
    """Raise MessageError naming both numbers when they differ."""
    if count != keypoints:
        raise MessageError(
            f"message has {count} keypoints ({where}); the keypoint layout has {keypoints}: "
            "name the layout in which the detector gives them"
        )
