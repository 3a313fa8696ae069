# SPDX-License-Identifier: Apache-2.0
"""Errors of reconstructed shapes against ground truth: the paper's and stricter ones."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.geometry import align, centre

Floats = NDArray[Any]


class ShapeErrors(NamedTuple):
    """Mean errors over frames; 0 is perfect. Shape errors are ratios ||S - S*||_F / ||S*||_F.

    Attributes:
        shape: the paper's shape error: each frame is rescaled to the norm of the truth and aligned
            by a rotation or a reflection.
        point: the paper's point error: mean distance of a point after that alignment, in the unit
            of the truth.
        proper: shape error after rescaling and alignment by a rotation, the set as `reflected`
            says.
        mirrored: share of frames, 0 to 0.5, whose best alignment is mirrored against the majority.
        unscaled: like `proper`, without rescaling each frame.
        reflected: 1 if the whole set was reflected before `proper`, `mirrored` and `unscaled`,
            because most of its frames are mirror images; else 0. That is allowed, since no image
            tells an object from its mirror image, but a robot sees its depth the wrong way round.
    """

    shape: float
    point: float
    proper: float
    mirrored: float
    unscaled: float
    reflected: float = 0.0


def shape_errors(S: Floats, truth: Floats) -> ShapeErrors:
    """Return the errors of shapes, each up to rotation and translation.

    Args:
        S: (f, p, 3) reconstructed shapes, in any unit.
        truth: (f, p, 3) ground truth of the same points. Frames with a NaN, in shape or truth, are
            left out.

    Raises:
        ValueError: the arrays have other shapes than (f, p, 3), or no frame is left.

    Source: section "NRSfM on CMU Motion Capture", tab:nrsfm, for `shape` and `point`.
    """
    known = _known(S, truth)
    S, T = centre(S[known]), centre(truth[known])
    size = np.linalg.norm(T, axis=(1, 2))
    ratio = (size / np.maximum(np.linalg.norm(S, axis=(1, 2)), 1e-12))[:, None, None]
    free = align(ratio * S, T, allow_reflection=True)
    mirrored = free.mirrored.mean()
    reflected = bool(mirrored > 0.5)
    if reflected:
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
        float(reflected),
    )


def procrustes_distances(S: Floats, truth: Floats) -> Floats:
    """Return the distances (f, p) of the points after the best similarity transform.

    The transform has a scale, a rotation without reflection, and a translation. Distances are in
    the unit of the truth (PA-MPJPE is their mean).

    Args:
        S: (f, p, 3) reconstructed shapes, in any unit.
        truth: (f, p, 3) ground truth of the same points.

    Returns:
        NaN in all points of a frame with a NaN, in shape or truth: `np.nanmean` leaves them out.

    Raises:
        ValueError: the arrays have other shapes than (f, p, 3), or every frame has a NaN.
    """
    known = _known(S, truth)
    S, T = centre(S[known]), centre(truth[known])
    S = align(S, T).aligned
    scale = (S * T).sum((1, 2)) / np.maximum((S * S).sum((1, 2)), 1e-12)
    found: Floats = np.linalg.norm(scale[:, None, None] * S - T, axis=2)
    if known.all():
        return found
    distances = np.full((len(known), found.shape[1]), np.nan, found.dtype)
    distances[known] = found
    return distances


def _known(S: Floats, truth: Floats) -> NDArray[np.bool_]:
    """Return which frames (f,) have neither in shape nor in truth a NaN.

    Raises:
        ValueError: the arrays have other shapes than (f, p, 3), or there is no such frame.
    """
    if S.ndim != 3 or S.shape != truth.shape or S.shape[-1] != 3:
        raise ValueError(
            f"shapes are {S.shape} and the truth is {truth.shape}; both must be (frames, points, "
            "3), of the same points in the same order"
        )
    known: NDArray[np.bool_] = (np.isfinite(S) & np.isfinite(truth)).all((1, 2))
    if not known.any():
        raise ValueError(
            f"in each of the {len(S)} frames a point of the shape or of the truth is NaN: choose "
            "the points that are known, S[:, points]"
        )
    return known


class CameraErrors(NamedTuple):
    """Errors of lifted shapes in the camera's axes, against ground truth.

    Attributes:
        aligned: mean distance of a point after the best similarity transform, in the unit of the
            truth.
        in_camera: the same after the best scale and translation, without a rotation: the viewing
            direction must be right too.
        rotation: median angle in degrees between the lifted and the true shape.
        mirrored: share of frames, 0 to 1, that a reflection aligns better than a rotation; unlike
            `ShapeErrors.mirrored` it counts all frames of a set that is mirrored as a whole.
    """

    aligned: float
    in_camera: float
    rotation: float
    mirrored: float


def camera_errors(shapes: Floats, truth: Floats) -> CameraErrors:
    """Return the errors of shapes in the camera's axes.

    Args:
        shapes: (f, p, 3) lifted shapes, in any unit.
        truth: (f, p, 3) ground truth of the same points in these axes, x right, y down, z forward.
            Frames with a NaN, in shape or truth, are left out.

    Raises:
        ValueError: the arrays have other shapes than (f, p, 3), or no frame is left.
    """
    known = _known(shapes, truth)
    S, T = centre(shapes[known].astype(float)), centre(truth[known])
    scale = (S * T).sum((1, 2)) / (S * S).sum((1, 2))
    distances = np.linalg.norm(scale[:, None, None] * S - T, axis=2)
    return CameraErrors(
        float(procrustes_distances(S, T).mean()),
        float(distances.mean()),
        float(np.median(rotation_angles(align(S, T).rotation))),
        float(align(S, T, allow_reflection=True).mirrored.mean()),
    )


def rotation_angles(R: Floats) -> Floats:
    """Return the angles (...) in degrees, 0 to 180, of rotation matrices R (..., 3, 3)."""
    cosine = (np.trace(R, axis1=-2, axis2=-1) - 1) / 2
    angles: Floats = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return angles
