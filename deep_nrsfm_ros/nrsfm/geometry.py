"""Cameras, alignment and weak perspective.

Functions that say `Array` use only operations that NumPy and torch share and work on both.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = Any  # numpy.ndarray or torch.Tensor: the same expression serves both
Floats = NDArray[Any]  # float32 or float64, kept as it comes

_TINY = 1e-12


def polar(A: Array) -> Array:
    """Return the orthonormal factor U V^T of A = U Sigma V^T, for A (..., 2, 3) of rank two.

    "Loss function" in the paper: the singular values are set to one. Closed form (A A^T)^-1/2 A
    with the root of a 2 x 2 matrix; its determinant comes from the cross product of the rows,
    because a d - b^2 cancels when they are nearly parallel. A of rank one or less gives a
    result that is finite but not orthonormal.
    """
    G = A @ A.swapaxes(-1, -2)
    trace = (G[..., 0, 0] + G[..., 1, 1])[..., None, None]
    a, b = A[..., 0, :], A[..., 1, :]
    cx = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    cy = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    cz = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    # Relative to the size of A, which in a deep narrow network is small.
    floor = _TINY * (trace * trace)[..., 0, 0] + 1e-36
    s = ((cx * cx + cy * cy + cz * cz + floor) ** 0.5)[..., None, None]
    return ((trace + s) * A - G @ A) / (s * (trace + 2 * s) ** 0.5)


def spectral_norm(A: Array) -> Array:
    """Return the largest singular value (...) of A (..., 2, 3)."""
    G = A @ A.swapaxes(-1, -2)
    difference, off = G[..., 0, 0] - G[..., 1, 1], G[..., 0, 1]
    root = (difference * difference + 4 * off * off + _TINY) ** 0.5
    return ((G[..., 0, 0] + G[..., 1, 1] + root) / 2) ** 0.5


def random_cameras(n: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return n uniformly random cameras M (n, 3, 2) with orthonormal columns."""
    rows = polar(rng.standard_normal((n, 2, 3)))
    return np.ascontiguousarray(rows.swapaxes(1, 2), np.float32)


def rotation_from_camera(M: Floats) -> Floats:
    """Return R (..., 3, 3), object to camera, of which M^T (..., 2, 3) is the first two rows."""
    rows = M.swapaxes(-1, -2)
    third = np.cross(rows[..., 0, :], rows[..., 1, :])
    return np.concatenate((rows, third[..., None, :]), -2)


def centre(X: Floats) -> Floats:
    """Return X (..., p, d) with its mean over the points removed."""
    centred: Floats = X - X.mean(-2, keepdims=True)
    return centred


def back_project(S: Array, M: Array, W: Array, share: float = 1.0) -> Array:
    """Move S (..., p, 3) within the image plane of M so that it projects onto W.

    S + (W - S M) M^T satisfies W = S M exactly (M^T M = I). `share` < 1 goes part of the way.
    """
    return S + share * ((W - S @ M) @ M.swapaxes(-1, -2))


class Alignment(NamedTuple):
    """Result of `align`: the moved shape and what moved it."""

    aligned: Floats  # (..., p, 3)
    rotation: Floats  # (..., 3, 3), applied as X @ rotation
    mirrored: NDArray[np.bool_]  # (...) True where det(rotation) = -1


def align(X: Floats, Y: Floats, *, allow_reflection: bool = False) -> Alignment:
    """Rotate each X (..., p, 3) onto its Y: argmin_Q ||X Q - Y||_F over SO(3), or O(3).

    Orthogonal Procrustes; both are taken as centred and of comparable scale.
    """
    U, _, Vt = np.linalg.svd(X.swapaxes(-1, -2) @ Y)
    sign = np.linalg.det(U @ Vt)
    if not allow_reflection:
        U = U.copy()
        U[..., :, 2] *= np.sign(sign)[..., None]
    Q = U @ Vt
    mirrored = (sign < 0) & allow_reflection
    return Alignment(X @ Q, Q, mirrored)


class WeakPerspective(NamedTuple):
    """Scale and translation of W = scale * P + translation."""

    scale: Floats  # (...)
    translation: Floats  # (..., 2)


def weak_perspective(W: Floats, P: Floats, visible: NDArray[np.bool_]) -> WeakPerspective:
    """Fit W (..., p, 2) = scale * P (..., p, 2) + translation over the visible points.

    Least squares with C = diag(visible)(I - 1 1^T / n): s = <C W, C P> / ||C P||^2 and
    t = mean(W) - s mean(P).
    """
    m = visible[..., None].astype(P.dtype)
    n = np.maximum(m.sum(-2), 1)
    w, q = (W * m).sum(-2) / n, (P * m).sum(-2) / n
    Wc, Pc = (W - w[..., None, :]) * m, (P - q[..., None, :]) * m
    scale = (Wc * Pc).sum((-2, -1)) / ((Pc * Pc).sum((-2, -1)) + _TINY)
    return WeakPerspective(scale, w - scale[..., None] * q)


def reprojection_error(W: Floats, P: Floats, visible: NDArray[np.bool_]) -> Floats:
    """Return ||C (W - s P)||_F / ||C W||_F (...) over the visible points, 0 being perfect.

    The best scale and translation between W (..., p, 2) and P (..., p, 2) are taken first.
    """
    scale, shift = weak_perspective(W, P, visible)
    m = visible[..., None].astype(P.dtype)
    error = (W - scale[..., None, None] * P - shift[..., None, :]) * m
    mean = (W * m).sum(-2, keepdims=True) / np.maximum(m.sum(-2, keepdims=True), 1)
    spread = np.linalg.norm((W - mean) * m, axis=(-2, -1))
    relative: Floats = np.linalg.norm(error, axis=(-2, -1)) / (spread + _TINY)
    return relative


def on_one_line(W: Floats, visible: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell (...) where the visible points of W (..., p, 2) lie on one line, or on one spot.

    Their spread across it is less than a thousandth of that along it: no camera can be told.
    """
    m = visible[..., None].astype(np.float64)
    X = (W - (W * m).sum(-2, keepdims=True) / np.maximum(m.sum(-2, keepdims=True), 1)) * m
    C = X.swapaxes(-1, -2) @ X
    trace = C[..., 0, 0] + C[..., 1, 1]
    determinant = C[..., 0, 0] * C[..., 1, 1] - C[..., 0, 1] ** 2
    flat: NDArray[np.bool_] = determinant <= 1e-6 * trace**2
    return flat


def quaternion(R: Floats) -> Floats:
    """Return the unit quaternion (x, y, z, w), w >= 0, of one rotation matrix R (3, 3)."""
    # The largest of the four squares is the pivot: the others would lose digits near zero.
    diagonal = np.array([R[0, 0], R[1, 1], R[2, 2], R[0, 0] + R[1, 1] + R[2, 2]])
    pivot = int(diagonal.argmax())
    q = np.empty(4)
    if pivot == 3:
        q[:3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
        q[3] = 1 + diagonal[3]
    else:
        i, j, k = pivot, (pivot + 1) % 3, (pivot + 2) % 3
        q[i] = 1 + 2 * R[i, i] - diagonal[3]
        q[j], q[k] = R[j, i] + R[i, j], R[k, i] + R[i, k]
        q[3] = R[k, j] - R[j, k]
    q /= np.linalg.norm(q) * (1 if q[3] >= 0 else -1)
    return q


def rotation_from_quaternion(q: Floats) -> Floats:
    """Return the rotation matrix (3, 3) of a quaternion (x, y, z, w) of any length but 0."""
    x, y, z, w = q / np.linalg.norm(q)
    half = np.array(
        [
            [-y * y - z * z, x * y - w * z, x * z + w * y],
            [x * y + w * z, -x * x - z * z, y * z - w * x],
            [x * z - w * y, y * z + w * x, -x * x - y * y],
        ]
    )
    R: Floats = np.eye(3) + 2 * half
    return R
