"""Errors of reconstructed shapes against ground truth, the flattering and the plain ones."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.geometry import align, centre

Floats = NDArray[Any]


class ShapeErrors(NamedTuple):
    """Means over frames; shape errors are ratios ||S - S*||_F / ||S*||_F."""

    shape: float  # the paper's: rescaled to the norm of the truth, aligned in O(3) frame by frame
    point: float  # mean point distance of the same alignment, in units of the truth
    proper: float  # rescaled, proper rotations only, one global reflection for the whole set
    mirrored: float  # share of frames whose O(3) alignment disagrees with that reflection
    unscaled: float  # as `proper`, without rescaling each frame


def shape_errors(S: Floats, truth: Floats) -> ShapeErrors:
    """Compare shapes S (f, p, 3) with truth (f, p, 3), both up to rotation and translation."""
    S, T = centre(S), centre(truth)
    size = np.linalg.norm(T, axis=(1, 2))
    ratio = (size / np.maximum(np.linalg.norm(S, axis=(1, 2)), 1e-12))[:, None, None]
    free = align(ratio * S, T, allow_reflection=True)
    mirrored = free.mirrored.mean()
    if mirrored > 0.5:
        S, mirrored = S * np.array([1, 1, -1], S.dtype), 1 - mirrored
    proper = align(S, T).rotation

    def error(X: Floats) -> float:
        return float((np.linalg.norm(X - T, axis=(1, 2)) / size).mean())

    return ShapeErrors(
        error(free.aligned),
        float(np.linalg.norm(free.aligned - T, axis=2).mean()),
        error(ratio * S @ proper),
        float(mirrored),
        error(S @ proper),
    )


def procrustes_distances(S: Floats, truth: Floats) -> Floats:
    """Return point distances (f, p) after similarity alignment by a proper rotation."""
    S, T = centre(S), centre(truth)
    S = align(S, T).aligned
    scale = (S * T).sum((1, 2)) / np.maximum((S * S).sum((1, 2)), 1e-12)
    distances: Floats = np.linalg.norm(scale[:, None, None] * S - T, axis=2)
    return distances


class CameraErrors(NamedTuple):
    """Errors of lifted shapes, means over frames and points but for the rotation."""

    aligned: float  # mm after the best similarity with a proper rotation
    in_camera: float  # mm after the best scale and translation: the camera's view must fit too
    rotation: float  # degrees between the two, median
    mirrored: float  # share of frames that a reflection fits better


def camera_errors(shapes: Floats, truth: Floats) -> CameraErrors:
    """Compare shapes (f, p, 3) with truth (f, p, 3) in mm, both in the camera's frame.

    Frames of which the truth is not wholly known are left out.
    """
    known = np.isfinite(truth).all((1, 2))
    S, T = centre(shapes[known].astype(float)), centre(truth[known])
    scale = (S * T).sum((1, 2)) / (S * S).sum((1, 2))
    apart = np.linalg.norm(scale[:, None, None] * S - T, axis=2)
    return CameraErrors(
        float(procrustes_distances(S, T).mean()),
        float(apart.mean()),
        float(np.median(rotation_angles(align(S, T).rotation))),
        float(align(S, T, allow_reflection=True).mirrored.mean()),
    )


def rotation_angles(turns: Floats) -> Floats:
    """Return the angles (...) of rotations (..., 3, 3)."""
    cosine = (np.trace(turns, axis1=-2, axis2=-1) - 1) / 2
    angles: Floats = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return angles
