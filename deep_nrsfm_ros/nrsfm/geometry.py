"""Cameras, alignment and weak perspective.

Functions that say `Array` use only operations that NumPy and torch share and work on both.
"""

from __future__ import annotations

from math import hypot
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
    trace = (A * A).sum((-2, -1))[..., None, None]
    c = _cross(A[..., 0, :], A[..., 1, :])
    # Relative to the size of A, which in a deep narrow network is small.
    floor = _TINY * (trace * trace) + 1e-36
    s = ((c * c).sum(-1)[..., None, None] + floor) ** 0.5
    return ((trace + s) * A - A @ A.swapaxes(-1, -2) @ A) / (s * (trace + 2 * s) ** 0.5)


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product (..., 3) of two arrays, each library by its fastest way."""
    if not isinstance(a, np.ndarray):
        from torch.linalg import cross

        return cross(a, b)
    c = np.empty(a.shape, a.dtype)
    # np.cross takes four times as long.
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        c[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return c


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
    R = np.empty((*M.shape[:-2], 3, 3), M.dtype)
    R[..., :2, :] = M.swapaxes(-1, -2)
    R[..., 2, :] = _cross(R[..., 0, :], R[..., 1, :])
    return R


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
    mean, moment = _moments((W, P), visible)
    scale = _fitted_scale(moment)
    shift = mean[..., :2] - scale[..., None] * mean[..., 2:]
    return WeakPerspective(scale.astype(P.dtype), shift.astype(P.dtype))


def reprojection_error(W: Floats, P: Floats, visible: NDArray[np.bool_]) -> Floats:
    """Return ||C (W - s P)||_F / ||C W||_F (...) over the visible points, 0 being perfect.

    The best scale and translation between W (..., p, 2) and P (..., p, 2) are taken first.
    """
    _, moment = _moments((W, P), visible)
    spread = moment[..., 0, 0] + moment[..., 1, 1]
    fitted = _fitted_scale(moment) * (moment[..., 0, 2] + moment[..., 1, 3])
    relative: Floats = np.sqrt(np.maximum(1 - fitted / np.maximum(spread, _TINY), 0))
    return relative.astype(P.dtype)


def _fitted_scale(moment: Floats) -> Floats:
    """Return <C W, C P> / ||C P||^2 (...) from the second moments of W and P."""
    size = np.maximum(moment[..., 2, 2] + moment[..., 3, 3], _TINY)
    scale: Floats = (moment[..., 0, 2] + moment[..., 1, 3]) / size
    return scale


def on_one_line(W: Floats, visible: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell (...) where the visible points of W (..., p, 2) lie on one line, or on one spot.

    Their spread across it is less than a thousandth of that along it: no camera can be told.
    """
    _, C = _moments((W,), visible)
    trace = C[..., 0, 0] + C[..., 1, 1]
    determinant = C[..., 0, 0] * C[..., 1, 1] - C[..., 0, 1] ** 2
    flat: NDArray[np.bool_] = determinant <= 1e-6 * trace**2
    return flat


def _moments(parts: tuple[Floats, ...], visible: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Return mean (..., d) and second central moments (..., d, d), as sums, of visible points.

    parts: arrays (..., p, 2) side by side, d coordinates in all. Matrix products sum faster than
    sums over axes do; float64, since points far from the origin cancel.
    """
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    X = np.empty((*shape, 2 * len(parts)))
    for i, part in enumerate(parts):
        X[..., 2 * i : 2 * i + 2] = part
    m = np.broadcast_to(visible, shape)[..., None, :].astype(X.dtype)
    mean = m @ X / np.maximum(m.sum(-1, keepdims=True), 1)
    X -= mean
    return mean[..., 0, :], (X.swapaxes(-1, -2) * m) @ X


def rotation_vector(R: Floats) -> Floats:
    """Return axis times angle (3,), at most pi long, of one rotation matrix R (3, 3)."""
    q = quaternion(R)
    sine = float(np.sqrt(q[:3] @ q[:3]))
    vector: Floats = q[:3] * (2 * np.arctan2(sine, q[3]) / sine if sine > _TINY else 2.0)
    return vector


def rotation_from_vector(v: Floats) -> Floats:
    """Return the rotation matrix (3, 3) of axis times angle v (3,): the way back."""
    angle = float(np.sqrt(v @ v))
    x, y, z = v
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # sin(a) / a and (1 - cos(a)) / a^2, by sinc also where a is 0.
    a, b = np.sinc(angle / np.pi), np.sinc(angle / (2 * np.pi)) ** 2 / 2
    R: Floats = np.eye(3) + a * K + b * (K @ K)
    return R


def quaternion(R: Floats) -> Floats:
    """Return the unit quaternion (x, y, z, w), w >= 0, of one rotation matrix R (3, 3)."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()  # so few numbers cost less without NumPy
    trace = a + e + i
    # The largest of the four squares is the pivot: the others would lose digits near zero.
    if trace >= max(a, e, i):
        q = h - f, c - g, d - b, 1 + trace
    elif a >= max(e, i):
        q = 1 + 2 * a - trace, b + d, g + c, h - f
    elif e >= i:
        q = b + d, 1 + 2 * e - trace, f + h, c - g
    else:
        q = g + c, f + h, 1 + 2 * i - trace, d - b
    return np.array(q) / (hypot(*q) if q[3] >= 0 else -hypot(*q))


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
