# SPDX-License-Identifier: Apache-2.0
"""Geometry: cameras, centring, alignment of shapes, weak perspective and rotations.

Functions with `Array` in their signature use only operations that NumPy and torch share, and take
both. "Visible" is always a mask: True or 1 for a visible point, False or 0 for a missing one.
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
    """Return the orthonormal polar factor U V^T of A = U Sigma V^T.

    Closed form (A A^T)^-1/2 A with the root of a 2 x 2 matrix. Its determinant comes from the
    cross product of the rows, because a d - b^2 cancels when the rows are nearly parallel.

    Args:
        A: (..., 2, 3) of rank two. For a lower rank the result is finite but not orthonormal.

    Source: section "Loss function": the singular values of the camera are set to one.
    """
    trace = (A * A).sum((-2, -1))[..., None, None]
    c = _cross(A[..., 0, :], A[..., 1, :])
    # The floor is relative to the size of A, which is small in a deep narrow network.
    floor = _TINY * (trace * trace) + 1e-36
    s = ((c * c).sum(-1)[..., None, None] + floor) ** 0.5
    return ((trace + s) * A - A @ A.swapaxes(-1, -2) @ A) / (s * (trace + 2 * s) ** 0.5)


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product (..., 3) of two arrays or tensors."""
    if not isinstance(a, np.ndarray):
        from torch.linalg import cross

        return cross(a, b)
    c = np.empty(a.shape, a.dtype)
    # np.cross would take four times as long.
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        c[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return c


def spectral_norm(A: Array) -> Array:
    """Return the largest singular value (...) of A (..., 2, 3).

    Source: section "Loss function": the penalty of a camera that is not orthonormal.
    """
    G = A @ A.swapaxes(-1, -2)
    difference, off = G[..., 0, 0] - G[..., 1, 1], G[..., 0, 1]
    root = (difference * difference + 4 * off * off + _TINY) ** 0.5
    return ((G[..., 0, 0] + G[..., 1, 1] + root) / 2) ** 0.5


def random_cameras(n: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return n uniformly random cameras M (n, 3, 2) with orthonormal columns."""
    rows = polar(rng.standard_normal((n, 2, 3)))
    return np.ascontiguousarray(rows.swapaxes(1, 2), np.float32)


def rotation_from_camera(M: Floats) -> Floats:
    """Return the rotation R (..., 3, 3), object to camera, of an orthonormal M (..., 3, 2).

    M^T is the first two rows of R; the third is their cross product.
    """
    R = np.empty((*M.shape[:-2], 3, 3), M.dtype)
    R[..., :2, :] = M.swapaxes(-1, -2)
    R[..., 2, :] = _cross(R[..., 0, :], R[..., 1, :])
    return R


def centre(X: Floats) -> Floats:
    """Return points X (..., p, d) minus their mean."""
    centred: Floats = X - X.mean(-2, keepdims=True)
    return centred


def visible_count(mask: Array) -> Array:
    """Return the number (..., 1, 1) of visible points of a mask (..., p, 1), but at least 1."""
    return mask.sum(-2, keepdims=True).clip(1)


def visible_mean(X: Array, mask: Array) -> Array:
    """Return the mean (..., 1, d) of the visible points of X (..., p, d), mask (..., p, 1)."""
    return (X * mask).sum(-2, keepdims=True) / visible_count(mask)


def centre_visible(X: Array, mask: Array) -> Array:
    """Return X (..., p, d) minus the mean of its visible points; missing points become 0.

    This is C X with C = diag(mask)(I - 1 mask^T / number of visible points), mask (..., p, 1).
    """
    return (X - visible_mean(X, mask)) * mask


def rms_radius(X: Array, mask: Array) -> Array:
    """Return the RMS distance (..., 1, 1) of visible points from the origin.

    Args:
        X: (..., p, d) centred points, 0 where missing; see `centre_visible`.
        mask: (..., p, 1).
    """
    return ((X * X).sum((-2, -1), keepdims=True) / visible_count(mask)) ** 0.5


def back_project(S: Array, M: Array, W: Array, fraction: float = 1.0) -> Array:
    """Return the shape moved parallel to the image plane so that it projects onto W.

    S + (W - S M) M^T satisfies eq:proj, W = S M, exactly, because M^T M = I.

    Args:
        S: (..., p, 3) shape.
        M: (..., 3, 2) orthonormal camera.
        W: (..., p, 2) keypoints in the units of S.
        fraction: part of the way to go, 0 = none, 1 = all.
    """
    return S + fraction * ((W - S @ M) @ M.swapaxes(-1, -2))


class Alignment(NamedTuple):
    """The result of `align`.

    Attributes:
        aligned: (..., p, 3) the rotated shapes, X @ rotation.
        rotation: (..., 3, 3) orthonormal.
        mirrored: (...) True where det(rotation) = -1.
    """

    aligned: Floats
    rotation: Floats
    mirrored: NDArray[np.bool_]


def align(X: Floats, Y: Floats, *, allow_reflection: bool = False) -> Alignment:
    """Return each shape rotated onto its target: argmin_Q ||X Q - Y||_F, orthogonal Procrustes.

    Args:
        X: (..., p, 3) centred shapes.
        Y: (..., p, 3) centred targets.
        allow_reflection: minimise over rotations and reflections, O(3), not over SO(3).

    Source: Kabsch (1976) for SO(3); Schoenemann (1966) for O(3).
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
    """The camera W = scale * P + translation.

    Attributes:
        scale: (...) units of W per unit of P.
        translation: (..., 2) in units of W.
    """

    scale: Floats
    translation: Floats


def weak_perspective(W: Floats, P: Floats, visible: NDArray[np.bool_]) -> WeakPerspective:
    """Return scale and translation of the least-squares fit W = s P + t over the visible points.

    With C as in `centre_visible`: s = <C W, C P> / ||C P||^2 and t = mean(W) - s mean(P).

    Args:
        W: (..., p, 2) keypoints, e.g. in pixels.
        P: (..., p, 2) x and y of the shape in the camera's axes.
        visible: (..., p) bool.
    """
    mean, moment = _moments((W, P), visible)
    scale = _fitted_scale(moment)
    shift = mean[..., :2] - scale[..., None] * mean[..., 2:]
    return WeakPerspective(scale.astype(P.dtype), shift.astype(P.dtype))


def reprojection_error(W: Floats, P: Floats, visible: NDArray[np.bool_]) -> Floats:
    """Return the relative reprojection error ||C (W - s P)||_F / ||C W||_F of each frame.

    Scale s and translation are those of `weak_perspective`.

    Args:
        W: (..., p, 2) keypoints, e.g. in pixels.
        P: (..., p, 2) x and y of the shape in the camera's axes.
        visible: (..., p) bool.

    Returns:
        (...) in [0, 1]: 0 = perfect, 0.05 typical, 0.2 bad.
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
    """Return whether (...) the visible points lie on one line or coincide.

    That is where their spread across the line is less than a thousandth of the spread along it.
    Such frames do not determine a camera.

    Args:
        W: (..., p, 2) keypoints, in any unit.
        visible: (..., p) bool.
    """
    _, C = _moments((W,), visible)
    trace = C[..., 0, 0] + C[..., 1, 1]
    determinant = C[..., 0, 0] * C[..., 1, 1] - C[..., 0, 1] ** 2
    flat: NDArray[np.bool_] = determinant <= 1e-6 * trace**2
    return flat


def _moments(parts: tuple[Floats, ...], visible: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Return the mean (..., d) and summed central second moments (..., d, d) of visible points.

    `parts` are arrays (..., p, 2), d coordinates together. Matrix products are faster than sums
    over axes. Everything is float64, because points far from the origin cancel.
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
    """Return axis times angle (3,) in radians, of length 0 to pi, of one rotation R (3, 3)."""
    q = quaternion(R)
    sine = float(np.sqrt(q[:3] @ q[:3]))
    vector: Floats = q[:3] * (2 * np.arctan2(sine, q[3]) / sine if sine > _TINY else 2.0)
    return vector


def rotation_from_vector(v: Floats) -> Floats:
    """Return rotations (..., 3, 3) of axis times angle v (..., 3) in radians.

    Source: Rodrigues' formula.
    """
    x, y, z = np.moveaxis(v, -1, 0)
    half = np.maximum(np.sqrt(x * x + y * y + z * z), _TINY) / 2  # floored: a, b, c are exact at 0
    sine = np.sin(half)
    # sin(angle) / angle, (1 - cos(angle)) / angle^2 and cos(angle).
    a, b, c = sine * np.cos(half) / half, (sine / half) ** 2 / 2, 1 - 2 * sine * sine
    R = np.empty((*v.shape[:-1], 3, 3))
    R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = b * x * x + c, b * x * y - a * z, b * x * z + a * y
    R[..., 1, 0], R[..., 1, 1], R[..., 1, 2] = b * x * y + a * z, b * y * y + c, b * y * z - a * x
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = b * x * z - a * y, b * y * z + a * x, b * z * z + c
    return R


def quaternion(R: Floats) -> Floats:
    """Return the unit quaternion (x, y, z, w), w >= 0, of one rotation matrix R (3, 3)."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()  # floats are faster than NumPy for so few numbers
    trace = a + e + i
    # The largest of the four components is computed first: the others would lose digits near 0.
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
    """Return the rotation matrix (3, 3) of a quaternion (x, y, z, w) of any length above 0."""
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


def finite_median(values: Floats) -> Floats:
    """Return the median of the finite values (..., n) over the last axis; NaN where there is none.

    A tenth of the time of `np.nanmedian`, which takes short rows one by one.
    """
    ordered = np.sort(values, -1)  # NaN last
    count = np.isfinite(values).sum(-1, keepdims=True)
    lower = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, -1)
    upper = np.take_along_axis(ordered, np.minimum(count // 2, values.shape[-1] - 1), -1)
    median: Floats = np.where(count > 0, (lower + upper) / 2, np.nan)[..., 0]
    return median
