"""What a training is told: the recipe, and the presets that go with it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from deep_nrsfm_ros.configuration import option
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.nrsfm.network import PAPER_WIDTHS, Architecture
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser


@dataclass(frozen=True)
class Recipe:
    """Training."""

    steps: int = option(30_000, "gradient steps", low=1, high=10_000_000)
    batch: int = option(64, "frames a step", low=1, high=65536)
    learning_rate: float = option(3e-3, "learning rate of Adam at the start", low=1e-7, high=1.0)
    schedule: str = option(
        "cosine",
        "learning rate: cosine to zero, or the paper's release (x 0.95 every 10000 steps)",
        choices=("cosine", "exponential"),
    )
    cycle: float = option(2.0, "weight of the cycle loss; 0 is the paper's loss", low=0, high=100)
    spectral: float = option(
        0.01, "weight of the camera's spectral norm, for a free camera only", low=0, high=100
    )
    noise: float = option(
        0.0, "highest noise added to the input, relative to its size", low=0.0, high=1.0
    )
    mask: float = option(0.0, "highest share of points hidden in the input", low=0.0, high=0.9)
    paper_initialisation: bool = option(
        False, "start as the paper's release: random biases, convolutions' fans"
    )
    seeds: int = option(
        3, "initialisations tried; the one with the lowest cycle error goes on", low=1, high=1000
    )
    screening: int = option(
        1000, "steps after which they are compared, at most a tenth of all", low=1
    )
    seed: int = option(0, "seed of everything random", low=0, high=2**31)


@dataclass(frozen=True)
class LayoutLossWeights:
    """What the layout knows of the object.

    All is off by default, as in the paper, which knows nothing of bones and fronts.
    """

    bone_length_weight: float = option(
        0.0,
        "weight of bones that keep their lengths, left ones as long as right ones, for an object "
        "whose edges are rigid that was seen from one side only; 3 is much; 0: none",
        low=0.0,
        high=1000.0,
    )
    handedness_weight: float = option(
        0.0,
        "weight of the handedness while training: the keypoints that the layout says are in front "
        "should be; for the same objects, 1 is much; 0: none",
        low=0.0,
        high=1000.0,
    )
    depth_penalty: float = option(
        0.0,
        "weight of depth, so that there is no more of it than the rest asks for, bones that keep "
        "their lengths above all; for the same objects, 0.3 is much; 0: none",
        low=0.0,
        high=1000.0,
    )

    def check(self, layout: KeypointLayout) -> None:
        """Raise ValueError if the layout has nothing of what is asked for."""
        for weight, field in (("bone_length_weight", "edges"), ("handedness_weight", "handedness")):
            asked = getattr(self, weight)
            if asked and not getattr(layout, field):
                raise ValueError(
                    f"{weight} is {asked:g}, but layout {layout.name!r} has no {field}; give it "
                    "some in a layout file, or ask for 0"
                )


class Preset(NamedTuple):
    """Everything that shapes a training but the data."""

    architecture: Architecture
    normaliser: Normaliser
    recipe: Recipe


PRESETS: dict[str, Preset] = {
    "default": Preset(Architecture(), Normaliser(), Recipe()),
    "paper": Preset(
        Architecture(widths=PAPER_WIDTHS, whitening=0.0),
        Normaliser(scale="none"),
        Recipe(
            steps=200_000,
            batch=32,
            learning_rate=1e-3,
            schedule="exponential",
            cycle=0.0,
            paper_initialisation=True,
            seeds=1,
        ),
    ),
}
"""The default, and the paper's network and schedule as its authors released them."""
