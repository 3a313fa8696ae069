"""From keypoints at any place and scale to the network's W, and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from deep_nrsfm_ros.configuration import option
from deep_nrsfm_ros.nrsfm.geometry import Array
from deep_nrsfm_ros.nrsfm.network import Network, complete


class Normalised(NamedTuple):
    """Keypoints as the network takes them, and what leads back to the image."""

    W: Array  # (n, p, 2) centred on the visible points, in units of `unit`; missing points are 0
    gain: Array  # (n, 1, 1) p / visible points: the encoder sums over points, so it undoes gaps
    unit: Array  # (n, 1, 1) length of one unit of W in the units of the input
    origin: Array  # (n, 1, 2) where W's zero is in the input


@dataclass(frozen=True)
class Normaliser:
    """Normalisation of the input."""

    scale: str = option(
        "rms",
        "unit of the input: its own visible RMS radius (pixels, any distance), or the unit of the "
        "data (metres; keeps the size of the object)",
        choices=("rms", "none"),
    )

    def encode(self, points: Array, mask: Array) -> Normalised:
        """Normalise points (n, p, 2) by their visible ones; mask (n, p, 1) is 1 or 0.

        With C = diag(mask)(I - 1 1^T / visible) it returns W = C points / unit, which no
        translation changes. Works on NumPy arrays and on tensors. A frame without a visible
        point comes out as zeros.
        """
        p = points.shape[-2]
        visible = mask.sum(-2)[..., None, :].clip(1)
        origin = (points * mask).sum(-2)[..., None, :] / visible
        W = (points - origin) * mask
        if self.scale == "none":
            unit = visible * 0 + 1
        else:
            unit = ((W * W).sum((-2, -1))[..., None, None] / visible) ** 0.5 + 1e-9
            # Half a unit of RMS radius: the size in metres of a person, for which the default
            # learning rate was chosen.
            unit = unit * 2
            W = W / unit
        return Normalised(W, p / visible, unit, origin)

    @staticmethod
    def decode(W: Array, normalised: Normalised) -> Array:
        """Return the points (n, p, 2) of the image from W: the inverse of `encode`."""
        return W * normalised.unit + normalised.origin


def normalise(net: Network, normaliser: Normaliser, points: Array, mask: Array) -> Normalised:
    """Return points (n, p, 2) of mask (n, p, 1) as the network shall see them.

    What is missing is filled as the network expects it, see `complete`; then all is normalised.
    """
    return normaliser.encode(*complete(net, points, mask))
