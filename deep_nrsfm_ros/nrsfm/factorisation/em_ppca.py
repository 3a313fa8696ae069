# SPDX-License-Identifier: Apache-2.0
"""EM-PPCA of Torresani, Hertzmann and Bregler: EM-SfM in the paper's Table 1.

Here `basis` (1 + K, 3, p) is the mean shape and the modes, and z (f, 1 + K) their coefficients,
of which the first is one. Y (f, 2, p) are the images, Q (f, 3, 3) the rotations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.factorisation.rigid import rigid_rotations, rigid_shape
from deep_nrsfm_ros.nrsfm.geometry import align, rotation_from_camera, rotation_from_vector

Floats = NDArray[Any]

ANNEALING = 60.0
"""Factor of the noise variance at the start, less one, in the authors' program."""
MIRROR_EVERY = 25
"""Iterations between two mirror tests."""
RESTART_ANGLE = 0.5
"""Standard deviation, in rad, of the rotation vectors that disturb the cameras of a restart."""


@dataclass(frozen=True)
class LinearModel:
    """Cameras and shape distribution.

    Attributes:
        Q: (f, 3, 3) rotations, object to camera.
        basis: (1 + K, 3, p) mean shape and modes.
        variance: of the images' noise.
    """

    Q: Floats
    basis: Floats
    variance: float


class _Posterior(NamedTuple):
    """Distribution of the coefficients, given the images.

    Attributes:
        z: (f, 1 + K) mean.
        zz: (f, 1 + K, 1 + K) second moment.
        log_likelihood: (f,) of the images, up to a constant.
    """

    z: Floats
    zz: Floats
    log_likelihood: Floats


def em_ppca(
    W: Floats, K: int, *, annealed: bool = False, mirror_test: bool = False, iterations: int = 300
) -> Floats:
    """Return the posterior mean of shapes that are a mean shape and K Gaussian modes.

    Torresani, Hertzmann and Bregler, "Nonrigid structure-from-motion: estimating shape and
    motion with hierarchical priors", PAMI 2008: EM-PPCA under orthography, without the linear
    dynamics. Starts from rigid factorisation and the principal modes of its residual.

    Args:
        W: (f, p, 2) images.
        K: number of modes.
        annealed: raise the noise variance in the first half of the iterations, as the authors'
            program does.
        mirror_test: see `_mirror_test`; not in the authors' program.
        iterations: of EM.
    """
    model = fit_from_rigid(W, K, annealed=annealed, mirror_test=mirror_test, iterations=iterations)
    return shapes_of(W, model)


def em_ppca_by_likelihood(
    W: Floats, K: int, *, iterations: int = 300, starts: int = 1, seed: int = 0
) -> Floats:
    """Return the shapes of the run of highest likelihood: annealed or not, with the mirror test.

    Args:
        W: (f, p, 2) images.
        K: number of modes.
        iterations: of EM, in each run.
        starts: rigid factorisation, and starts with its cameras disturbed at random.
        seed: of the disturbances.
    """
    Y, rng = W.astype(np.float64).swapaxes(1, 2), np.random.default_rng(seed)
    best: tuple[float, Floats] | None = None
    for i in range(starts):
        start = _start(Y, K, rng if i else None)
        for annealed in (False, True):
            model = _iterate(Y, start, annealed=annealed, mirror_test=True, iterations=iterations)
            posterior = _posterior(Y, model)
            likelihood = float(posterior.log_likelihood.sum())
            if best is None or likelihood > best[0]:
                best = likelihood, _shapes(model, posterior)
    assert best is not None
    return best[1]


def _iterate(
    Y: Floats,
    model: LinearModel,
    *,
    annealed: bool,
    mirror_test: bool,
    iterations: int,
    before_each: Callable[[], None] = lambda: None,
) -> LinearModel:
    """Return the model after `iterations` of EM; `before_each` is called before each."""
    for i in range(iterations):
        before_each()
        if mirror_test and i % MIRROR_EVERY == MIRROR_EVERY - 1:
            model = _mirror_test(Y, model)
        z, zz, _ = _posterior(Y, model)
        Q = _update_rotations(Y, model, z, zz)
        basis, variance = _fit_basis(Y, Q[:, :2], z, zz)
        if annealed:
            variance *= 1 + ANNEALING * max(1 - 2 * i / iterations, 0)
        model = LinearModel(Q, basis, variance)
    return model


def _start(Y: Floats, K: int, rng: np.random.Generator | None = None) -> LinearModel:
    """Return rigid factorisation with the principal modes of its residual.

    With `rng` the rotations are disturbed at random, see `RESTART_ANGLE`.
    """
    W = Y.swapaxes(1, 2)
    Q = rotation_from_camera(rigid_rotations(W).swapaxes(1, 2))
    if rng is not None:
        Q = rotation_from_vector(RESTART_ANGLE * rng.standard_normal((len(Y), 3))) @ Q
    mean = rigid_shape(W, Q[:, :2])
    residual = Y - Q[:, :2] @ mean.T
    modes, _ = _modes_of(Q[:, :2].swapaxes(1, 2) @ residual, K)
    return LinearModel(Q, np.concatenate((mean.T[None], modes)), float((residual**2).mean()))


def _modes_of(deviations: Floats, K: int) -> tuple[Floats, float]:
    """Return the K principal modes (K, 3, p) of deviations (f, 3, p), and the sum of squares left.

    The length of a mode is the standard deviation of its coefficient.
    """
    f, _, p = deviations.shape
    _, s, Vt = np.linalg.svd(deviations.reshape(f, -1), full_matrices=False)
    modes = s[:K, None] / f**0.5 * Vt[:K]
    return modes.reshape(-1, 3, p), float((s[K:] ** 2).sum())


def fit_from_rigid(
    W: Floats,
    K: int,
    *,
    annealed: bool = False,
    mirror_test: bool = False,
    iterations: int = 300,
    before_each: Callable[[], None] = lambda: None,
) -> LinearModel:
    """Return mean shape, K modes and cameras that EM finds from rigid factorisation.

    Args:
        W: (f, p, 2) images.
        K: number of modes.
        annealed: see `em_ppca`.
        mirror_test: see `em_ppca`.
        iterations: of EM.
        before_each: called before each iteration; an exception ends the work.
    """
    Y = W.astype(np.float64).swapaxes(1, 2)
    return _iterate(
        Y,
        _start(Y, K),
        annealed=annealed,
        mirror_test=mirror_test,
        iterations=iterations,
        before_each=before_each,
    )


def fit_from_shapes(
    W: Floats,
    Q: Floats,
    S: Floats,
    K: int,
    *,
    iterations: int,
    before_each: Callable[[], None] = lambda: None,
) -> LinearModel:
    """Return mean shape, K modes and cameras that EM finds from given shapes and cameras.

    Args:
        W: (f, p, 2) images.
        Q: (f, 3, 3) rotations from object to camera.
        S: (f, p, 3) shapes in object axes.
        K: number of modes.
        iterations: of EM.
        before_each: called before each iteration; an exception ends the work.
    """
    Y = W.astype(np.float64).swapaxes(1, 2)
    mean = S.mean(0)
    modes, left = _modes_of((S - mean).swapaxes(1, 2), K)
    variance = left / S.size + 1e-4 * float((Y**2).mean())
    start = LinearModel(Q, np.concatenate((mean.T[None], modes)), variance)
    return _iterate(
        Y,
        start,
        annealed=False,
        mirror_test=False,
        iterations=iterations,
        before_each=before_each,
    )


def shapes_of(W: Floats, model: LinearModel) -> Floats:
    """Return the posterior mean (f, p, 3) of the shapes of images W (f, p, 2), in object axes."""
    return _shapes(model, _posterior(W.astype(np.float64).swapaxes(1, 2), model))


def _shapes(model: LinearModel, posterior: _Posterior) -> Floats:
    """Return the posterior mean (f, p, 3) in object axes."""
    S: Floats = np.tensordot(posterior.z, model.basis, 1).swapaxes(1, 2)
    return S


def _posterior(Y: Floats, model: LinearModel) -> _Posterior:
    """Return the distribution of the coefficients, given the images Y (f, 2, p)."""
    f, K = len(Y), len(model.basis) - 1
    P = (model.Q[:, None, :2] @ model.basis).reshape(f, K + 1, -1)
    modes, left = P[:, 1:], Y.reshape(f, -1) - P[:, 0]
    precision = np.eye(K) + modes @ modes.swapaxes(1, 2) / model.variance
    covariance = np.linalg.inv(precision)
    projected = (modes @ left[..., None])[..., 0] / model.variance
    z = np.ones((f, K + 1))
    z[:, 1:] = (covariance @ projected[..., None])[..., 0]
    zz = z[:, :, None] * z[:, None, :]
    zz[:, 1:, 1:] += covariance
    distance = (left**2).sum(1) / model.variance - (projected * z[:, 1:]).sum(1)
    size = left.shape[1] * np.log(model.variance) + np.linalg.slogdet(precision)[1]
    return _Posterior(z, zz, -0.5 * (distance + size))


def _mirror_test(Y: Floats, model: LinearModel) -> LinearModel:
    """Return the model with those frames turned whose mirrored depth has a higher likelihood.

    For each frame the shape's depth is negated in the camera's axes, the mean shape is aligned to
    it by a rotation, three steps refine that, and the better rotation is kept.
    """
    posterior = _posterior(Y, model)
    seen = _shapes(model, posterior) @ model.Q.swapaxes(1, 2)
    mean = np.broadcast_to(model.basis[0].T, seen.shape)
    turned = replace(model, Q=align(mean, seen * [1, 1, -1]).rotation.swapaxes(1, 2))
    for _ in range(3):
        z, zz, _ = _posterior(Y, turned)
        turned = replace(turned, Q=_update_rotations(Y, turned, z, zz))
    better = _posterior(Y, turned).log_likelihood > posterior.log_likelihood
    return replace(model, Q=np.where(better[:, None, None], turned.Q, model.Q))


def _update_rotations(Y: Floats, model: LinearModel, z: Floats, zz: Floats) -> Floats:
    """Return rotations Q (f, 3, 3) after one Gauss-Newton step of the expected error.

    Q <- exp([w]) Q, with E|y - (x + w cross x)|^2 over the first two rows of x = Q s.
    """
    Q, basis = model.Q, model.basis
    inner = basis[:, None] @ basis.swapaxes(1, 2)  # (1 + K, 1 + K, 3, 3)
    second = np.tensordot(zz, inner, 2)  # E[S S^T]
    shapes = np.tensordot(z, basis, 1)
    cross_moment = Y @ shapes.swapaxes(1, 2) @ Q.swapaxes(1, 2)  # E[y x^T]
    B = Q @ second @ Q.swapaxes(1, 2)  # E[x x^T]
    E = cross_moment - B[:, :2]  # E[(y - x) x^T]
    # The first row moves by w_y x_z - w_z x_y, the second by w_z x_x - w_x x_z.
    H = np.empty((len(Y), 3, 3))
    H[:, 0, 0] = H[:, 1, 1] = B[:, 2, 2]
    H[:, 2, 2] = B[:, 0, 0] + B[:, 1, 1]
    H[:, 0, 1] = H[:, 1, 0] = 0
    H[:, 0, 2] = H[:, 2, 0] = -B[:, 0, 2]
    H[:, 1, 2] = H[:, 2, 1] = -B[:, 1, 2]
    H += 1e-9 * np.trace(B, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    gradient = np.stack((-E[:, 1, 2], E[:, 0, 2], E[:, 1, 0] - E[:, 0, 1]), 1)
    w = np.linalg.solve(H, gradient[..., None])[..., 0]
    w *= np.minimum(1, 0.3 / np.maximum(np.linalg.norm(w, axis=1), 1e-12))[:, None]
    updated: Floats = rotation_from_vector(w) @ Q
    return updated


def _fit_basis(Y: Floats, R: Floats, z: Floats, zz: Floats) -> tuple[Floats, float]:
    """Return mean and modes (1 + K, 3, p) and the noise variance of highest likelihood."""
    k, p = z.shape[1], Y.shape[2]
    f, Rt = len(Y), R.swapaxes(1, 2)
    normal = zz.reshape(f, -1).T @ (Rt @ R).reshape(f, -1)
    normal = normal.reshape(k, k, 3, 3).swapaxes(1, 2).reshape(3 * k, -1)
    right = (z.T @ (Rt @ Y).reshape(f, -1)).reshape(3 * k, p)
    B = np.linalg.lstsq(normal, right, rcond=None)[0]
    variance = ((Y**2).sum() - (B * right).sum()) / Y.size
    return B.reshape(k, 3, p), max(float(variance), 1e-12)
