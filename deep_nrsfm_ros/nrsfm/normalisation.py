# SPDX-License-Identifier: Apache-2.0
"""Normalisation: from keypoints in an image, at any place and scale, to W and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.nrsfm.geometry import Array, rms_radius, visible_count, visible_mean
from deep_nrsfm_ros.nrsfm.network import Network, complete


class Normalised(NamedTuple):
    """Normalised keypoints, and what is needed to undo the normalisation.

    Attributes:
        W: (n, p, 2) centred on the visible points, in units of `unit`; missing points are 0.
        gain: (n, 1, 1) p / number of visible points. The network's input is W * gain: the encoder
            sums over the points, and the gain makes up for those that are missing.
        unit: (n, 1, 1) length of one unit of W, in the units of the input.
        origin: (n, 1, 2) mean of the visible points, in the units of the input.
    """

    W: Array
    gain: Array
    unit: Array
    origin: Array


@dataclass(frozen=True)
@described
class Normaliser:
    """Normalisation of the input."""

    scale: str = option(
        "rms",
        "unit of the input: rms = twice the RMS radius of the visible keypoints, for pixels and "
        "objects at any distance; none = the unit of the data, for metres, which keeps the size "
        "of the object",
        choices=("rms", "none"),
    )

    def encode(self, points: Array, mask: Array) -> Normalised:
        """Return the normalised keypoints: centred on the visible ones and scaled.

        Args:
            points: (n, p, 2), x right and y down, in any unit.
            mask: (n, p, 1), 1 = visible, 0 = missing.

        Returns:
            Arrays or tensors, as the arguments are. A frame without a visible point has W = 0.
        """
        count, origin = visible_count(mask), visible_mean(points, mask)
        W = (points - origin) * mask
        if self.scale == "none":
            unit = count * 0 + 1
        else:
            # A person has a radius of about 0.5 m. In units of twice the radius W has the size that
            # it has in metres, for which the default learning rate was chosen.
            unit = (rms_radius(W, mask) + 1e-9) * 2
            W = W / unit
        return Normalised(W, points.shape[-2] / count, unit, origin)

    @staticmethod
    def decode(W: Array, normalised: Normalised) -> Array:
        """Return the points (n, p, 2) in the image of W (n, p, 2): the inverse of `encode`."""
        return W * normalised.unit + normalised.origin


def normalise(net: Network, normaliser: Normaliser, points: Array, mask: Array) -> Normalised:
    """Return the keypoints as the input of a network: completed, centred and scaled.

    Args:
        net: its whitening says where missing points are expected; see `complete`.
        normaliser: how points are scaled.
        points: (n, p, 2), x right and y down, in any unit.
        mask: (n, p, 1), 1 = visible, 0 = missing.
    """
    return normaliser.encode(*complete(net, points, mask))
