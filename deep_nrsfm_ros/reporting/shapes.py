# SPDX-License-Identifier: Apache-2.0
"""The mean shape and the principal deformations of an object that a model has lifted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.geometry import align, centre

Floats = NDArray[np.float64]

_ROUNDS = 3  # rounds of alignment to the mean shape


class ShapeSpace(NamedTuple):
    """The mean shape and the principal deformations, in screen axes.

    The axes are x right, y up, z to a viewer in front of the object. The mean has RMS radius 1.

    Attributes:
        mean: (p, 3).
        modes: (m, p, 3) one standard deviation of each principal component.
        shares: (m,) shares of the variance, descending.
    """

    mean: Floats
    modes: Floats
    shares: Floats


def shape_space(model: Model, lifted: Lifted, modes: int = 4) -> ShapeSpace:
    """Return the mean and the principal components of lifted shapes.

    Shapes are centred, scaled to RMS radius 1 and aligned by rotations without reflection.

    Args:
        model: its layout determines the screen axes.
        lifted: n objects.
        modes: number of components at most.
    """
    S = centre(lifted.shapes.astype(np.float64) @ lifted.rotations)  # in the object's axes
    S /= np.maximum(np.sqrt((S * S).sum(2).mean(1)), 1e-9)[:, None, None]
    # Start from a single shape: the mean of a failed network's shapes may be zero.
    mean = S[int(np.argmin(lifted.residual))]
    for _ in range(_ROUNDS):
        S = align(S, np.broadcast_to(mean, S.shape)).aligned
        mean = S.mean(0)
    mean = align(mean, (lifted.shapes @ lifted.rotations).mean(0)).aligned
    S = align(S, np.broadcast_to(mean, S.shape)).aligned @ _to_screen(model, mean)
    mean = S.mean(0)
    _, values, axes = np.linalg.svd((S - mean).reshape(len(S), -1), full_matrices=False)
    variances = values**2 / max(len(S) - 1, 1)
    m = min(modes, len(values))
    deviations = np.sqrt(variances[:m])[:, None] * axes[:m]
    return ShapeSpace(
        mean,
        deviations.reshape(m, *mean.shape),
        variances[:m] / max(float(variances.sum()), 1e-12),
    )


def _to_screen(model: Model, mean: Floats) -> Floats:
    """Return the rotation (3, 3), applied on the right, from object axes to screen axes.

    An object without a handedness is upright along its longest extent.
    """
    if model.layout.handedness:
        return np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # x front, y left, z up
    axes = np.linalg.eigh(mean.T @ mean)[1]  # shortest first
    rotation: Floats = axes[:, [1, 2, 0]]
    rotation[:, 2] *= np.sign(np.linalg.det(rotation))
    return rotation
