"""Which way round shapes are: no 2D image tells an object from its mirror image; keypoints vote."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.layout import KeypointLayout, Tetrahedron
from deep_nrsfm_ros.nrsfm.geometry import centre

Floats = NDArray[Any]

SEEN_ENOUGH = 0.1
"""Share of the shapes of which all four keypoints must have been seen for their vote to count."""


def votes(S: Floats, layout: KeypointLayout) -> Floats:
    """Return how far (f, v) each shape's front keypoints are before the plane of the other three.

    One column for each of `KeypointLayout.handedness`, in RMS radii of the shape: positive on the
    real object, negative where depth is is_mirrored. A distance, and not the tetrahedron's volume,
    in which four keypoints far from each other would outvote all others.
    Raises ValueError if the layout has no handedness.
    """
    if not layout.handedness:
        raise ValueError(f"layout {layout.name!r} has no handedness; name its four keypoints")
    left, right, up, front = (S[:, at] for at in _places(layout).T)
    normal = np.cross(left - right, up - right)
    heights = ((front - right) * normal).sum(-1) / _norm(normal)
    radius = np.sqrt((centre(S) ** 2).sum(2).mean(1, keepdims=True))
    found: Floats = heights / np.maximum(radius, 1e-12)
    return found


def is_mirrored(S: Floats, layout: KeypointLayout, seen: NDArray[np.bool_] | None = None) -> bool:
    """Return whether the shapes (f, p, 3) are is_mirrored on the whole.

    Each vote counts by its median over the shapes, so that a few that are wrong, a keypoint close
    to its plane and one that is as often behind it as before it say little. Where `seen` (f, p)
    tells, only shapes of which all four were seen count: what no detector shows may lie anywhere.
    """
    return bool(sum(np.median(vote) for _, vote in _heard(S, layout, seen)) < 0)


def disagreement(S: Floats, layout: KeypointLayout, seen: NDArray[np.bool_] | None = None) -> str:
    """Return what somebody who uses a model that lifts shapes (f, p, 3) should know, or "".

    On a sound one no vote is against most of the shapes. Where one is, depth is wrong in part, and
    no mirroring of the whole mends it. `seen` as in `is_mirrored`.
    """
    heard = _heard(S, layout, seen) if layout.handedness else []
    shares = [(front, (vote > 0).mean()) for (*_, front), vote in heard]
    if all(share >= 0.5 for _, share in shares):
        return ""
    told = ", ".join(f"{front} in {100 * share:.0f} %" for front, share in shares)
    return (
        f"the keypoints disagree on where the front is, so that depth is wrong in part ({told} of "
        "the frames where it belongs); record the object from more sides, start from a model that "
        "knows it (--from, train.from), or let the layout help (bones, front)"
    )


def object_frame(
    S: Floats, layout: KeypointLayout, seen: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """Return the orthonormal A (3, 3) that takes reconstructed axes to the object's: S A.

    Reflects (det -1) where the shapes S (f, p, 3) are is_mirrored on the whole, and turns the mean
    shape so that x points to the front, y to the left and z up (REP-103), by the first of the
    layout's handedness. Layouts without one keep the network's axes.
    """
    A = np.eye(3)
    if not layout.handedness:
        return A.astype(np.float32)
    if is_mirrored(S, layout, seen):
        A[2, 2] = -1
    left, right, up, _ = (S @ A).mean(0)[_places(layout)[0]]
    y = (left - right) / _norm(left - right)
    z = up - (left + right) / 2
    z -= (z @ y) * y
    axes = np.stack((np.cross(y, z / _norm(z)), y, z / _norm(z)), 1)
    return np.asarray(A @ axes, np.float32)


def _heard(
    S: Floats, layout: KeypointLayout, seen: NDArray[np.bool_] | None
) -> list[tuple[Tetrahedron, Floats]]:
    """Return the votes that count, each of the shapes that it counts for."""
    found = votes(S, layout)
    counts = np.full(found.shape, True)
    chosen = list(range(len(layout.handedness)))
    if seen is not None:
        all_four = np.asarray(seen[:, _places(layout)].all(2), bool)
        enough = np.flatnonzero(all_four.mean(0) >= SEEN_ENOUGH).tolist()
        if enough:
            counts, chosen = all_four, enough
    return [(layout.handedness[i], found[counts[:, i], i]) for i in chosen]


def _places(layout: KeypointLayout) -> NDArray[np.int_]:
    """Return where (v, 4) the keypoints of each handedness are."""
    return np.array([[layout.index(name) for name in four] for four in layout.handedness])


def _norm(vectors: Floats) -> Floats:
    lengths: Floats = np.maximum(np.linalg.norm(vectors, axis=-1), 1e-12)
    return lengths
