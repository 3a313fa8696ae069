# SPDX-License-Identifier: Apache-2.0
"""Gravity: objects whose layout names top and bottom are upright, more or less.

One image does not show by how much an object leans towards the camera. Where the direction of
gravity is known, the axis v from the bottom of the object to its top is measured as vertical: its
two components across gravity are 0, with a standard deviation that grows fast with the angle by
which the object is seen to lean. A person who bends or lies is not set up.

Source: ours, not in the paper.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from deep_nrsfm_ros.nrsfm.geometry import Floats

LEAN_DEVIATION = np.radians(3.0)
"""Standard deviation of the lean of an object that is seen upright."""
FREE_LEAN = np.radians(25.0)
"""Lean from which on gravity says little."""


class Upright(NamedTuple):
    """What gravity says of n objects.

    Attributes:
        axis: (p,) weights of the keypoints in the axis v: 1 / their number at the top,
            -1 / their number at the bottom.
        up: (n, 3) unit vectors against gravity, in object axes.
    """

    axis: Floats
    up: Floats

    def constraint(self, X: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the constraint G e = r for a correction e of each shape.

        Args:
            X: (n, p, 3) shapes in object axes.

        Returns:
            Jacobian G (n, 2, 3 p) of the components of v across gravity, residual r (n, 2) in the
            unit of X, and covariance (n, 2, 2) of the residual.
        """
        n, p, _ = X.shape
        v = self.axis @ X  # (n, 3)
        length = np.maximum(np.linalg.norm(v, axis=1), 1e-9)
        lean = np.arccos(np.clip((v * self.up).sum(1) / length, -1, 1))
        deviation = LEAN_DEVIATION * length * np.sqrt(1 + (lean / FREE_LEAN) ** 4)
        across = _across(self.up)  # (n, 2, 3)
        G = self.axis[:, None] * across[:, :, None]  # (n, 2, p, 3)
        residual = -(across @ v[..., None])[..., 0]
        return G.reshape(n, 2, 3 * p), residual, deviation[:, None, None] ** 2 * np.eye(2)


def _across(up: Floats) -> Floats:
    """Return two unit vectors (n, 2, 3) across each unit vector (n, 3) and each other."""
    axes = np.eye(3)[np.abs(up).argmin(1)]
    a = np.cross(up, axes)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    return np.stack((a, np.cross(up, a)), 1)
