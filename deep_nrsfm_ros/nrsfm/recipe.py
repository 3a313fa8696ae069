# SPDX-License-Identifier: Apache-2.0
"""The options of a training besides its data: recipe, layout losses, and presets of both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.nrsfm.network import PAPER_WIDTHS, Architecture
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser

AUTOMATIC = -1
"""Value of `steps` or `limb_exchange` for which the training chooses by its start and frames."""


@dataclass(frozen=True)
@described
class Recipe:
    """Training."""

    steps: int = option(
        AUTOMATIC,
        "gradient steps of the training; -1 = 30000 from random weights; where it starts from a "
        "model of the same keypoints a third of the number of frames, at least 100, of other "
        "keypoints ten times as many, at most 30000; 0 = keep the network of the model to start "
        "from and learn only its error covariance and bones anew",
        low=AUTOMATIC,
        high=10_000_000,
    )
    batch: int = option(64, "frames of each gradient step", low=1, high=65536)
    optimiser: str = option(
        "adam",
        "how the weights follow the gradient: adam as in the paper; soap = Adam in the axes in "
        "which the gradient's second moment is diagonal, which needs a third of the steps (set "
        "steps, whose default is that of adam); measured on people seen from all sides",
        choices=("adam", "soap"),
    )
    learning_rate: float = option(
        3e-3,
        "learning rate of Adam at the first step, soap takes twice as much; 0.001 to 0.003 typical",
        low=1e-7,
        high=1.0,
    )
    schedule: str = option(
        "cosine",
        "course of the learning rate: cosine falls to zero at the last step; exponential is that "
        "of the paper's code, multiplied by 0.95 every 10000 steps",
        choices=("cosine", "exponential"),
    )
    cycle: float = option(
        2.0,
        "weight of the cycle loss: a shape seen from another camera gives the same shape again; "
        "0 = off as in the paper, 2 typical",
        low=0,
        high=100,
    )
    spectral: float = option(
        0.01,
        "weight of a loss that keeps the network's camera from growing; without effect unless the "
        "network has a free camera (`train --camera free`), which no model of the package has; 0 = "
        "off, 0.01 typical",
        low=0,
        high=100,
    )
    added_noise: float = option(
        0.0,
        "largest random noise added to the input while training, as a share of the object's size; "
        "0 = off, 0.05 typical",
        low=0.0,
        high=1.0,
    )
    mask: float = option(
        0.0,
        "largest share of keypoints hidden at random in the input while training; 0 = off, 0.3 "
        "typical",
        low=0.0,
        high=0.9,
    )
    mirror_repair: str = option(
        "if_found",
        "when frames whose depth is mirrored are repaired while training: if_found = while a test "
        "finds such frames, always = in any case, from a fifth of the steps on, off = never. They "
        "are repaired by shapes made of similar frames, which the cycle loss takes in place of the "
        "network's own. Without effect where cycle is 0, where factorisations teach the network "
        "(few_frames), or where frames show one side only",
        choices=("if_found", "always", "off"),
    )
    error_scale: float = option(
        1.0,
        "how much more the network is taken to be wrong, in variance, than it is on the frames of "
        "its training, so that lifting corrects it more; 1 = as much as there. 4 lifts motions "
        "that the training lacks a tenth better from clean and complete keypoints, those with gaps "
        "worse, and makes the confidence too low. Without effect where the training starts from a "
        "model, or with virtual people (`train --virtual-people`)",
        low=0.01,
        high=100.0,
    )
    limb_exchange: float = option(
        float(AUTOMATIC),
        "whether the training also shows poses that the recording lacks, by limbs exchanged "
        "between frames: 0 = no, 1 = yes, -1 = yes where it starts from a model of a layout with "
        "limbs, no from random weights. People and motions that the frames do not show are then "
        "lifted better, those of the frames a little worse. The number is the share of the cycle "
        "loss's shapes that get limbs of other frames at the first step; it falls to 0 by the "
        "last. A limb is what one edge of the layout joins to the rest. Without effect where cycle "
        "is 0",
        low=float(AUTOMATIC),
        high=1.0,
    )
    few_frames: int = option(
        2000,
        "largest number of frames for which classic factorisations of all frames teach the "
        "network, which alone finds worse shapes with so few; 0 = never; without effect in "
        "trainings of fewer than 2000 steps, that start from a model, or of several processes, and "
        "where more than a fifth of the keypoints is missing or the factorisations disagree",
        low=0,
        high=10_000,
    )
    start_share: float = option(
        0.6,
        "weight of the model that a training starts from in the result, of whose network weights "
        "each is share * start + (1 - share) * trained; only with the same keypoints; 0 = trained "
        "alone, fits frames like those of the training more closely; 0.6 typical",
        low=0.0,
        high=1.0,
    )
    paper_initialisation: bool = option(
        False,
        "draw the random weights of a training as the paper's code does; without effect where the "
        "training starts from a model",
    )
    seeds: int = option(
        3,
        "random initialisations that are compared at the start, at most; one that mirrors no frame "
        "is trained to the end at once, else the one with the lowest sum of cycle error and share "
        "of mirrored frames",
        low=1,
        high=1000,
    )
    screening: int = option(
        1000,
        "steps after which the initialisations are compared; a tenth of all steps at most",
        low=1,
    )
    seed: int = option(
        0, "seed of all random numbers; the same seed gives the same model", low=0, high=2**31
    )


@dataclass(frozen=True)
@described
class LayoutLossWeights:
    """Losses of the keypoint layout.

    All are off by default, as in the paper, whose method uses neither bones nor handedness.
    """

    bone_length_weight: float = option(
        0.0,
        "weight of the bone-length loss: bones keep their lengths, and left and right bones are "
        "equally long; for objects seen from one side only; 0 = off, 1 typical, 3 strong",
        low=0.0,
        high=1000.0,
    )
    handedness_weight: float = option(
        0.0,
        "weight of the handedness loss: the keypoints that the layout names as the front are in "
        "front; for objects seen from one side only; 0 = off, 0.3 typical, 1 strong",
        low=0.0,
        high=1000.0,
    )
    depth_penalty: float = option(
        0.0,
        "weight of the depth loss: the object is no deeper than the other losses need, the "
        "bone-length loss above all; for objects seen from one side only; 0 = off, 0.1 typical, "
        "0.3 strong",
        low=0.0,
        high=1000.0,
    )

    def check(self, layout: KeypointLayout, name_of: Callable[[str], str] = str) -> None:
        """Raise ValueError if `layout` lacks the edges or the handedness that a weight needs.

        Args:
            layout: layout of the model.
            name_of: returns the name of an option, for the message.
        """
        for name, field in (("bone_length_weight", "edges"), ("handedness_weight", "handedness")):
            weight = getattr(self, name)
            if weight and not getattr(layout, field):
                raise ValueError(
                    f"{name_of(name)} is {weight:g}, but layout {layout.name!r} has no {field}; "
                    "add some in a layout file, or set the weight to 0"
                )


class Preset(NamedTuple):
    """Network, normaliser and recipe of a training."""

    architecture: Architecture
    normaliser: Normaliser
    recipe: Recipe


PRESETS: dict[str, Preset] = {
    "default": Preset(Architecture(), Normaliser(), Recipe()),
    "fast": Preset(
        Architecture(),
        Normaliser(),
        Recipe(steps=10_000, optimiser="soap", mirror_repair="always"),
    ),
    "paper": Preset(
        Architecture(widths=PAPER_WIDTHS, whitening=0.0),
        Normaliser(scale="none"),
        Recipe(
            steps=200_000,
            batch=32,
            learning_rate=1e-3,
            schedule="exponential",
            cycle=0.0,
            few_frames=0,
            paper_initialisation=True,
            seeds=1,
        ),
    ),
}
"""Presets by name: the default; `fast`, which reaches the default's errors on the training frames
in about half of the time, for objects that are seen from all sides; `paper`, the network and
schedule as its authors released them."""
