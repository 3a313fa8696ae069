# SPDX-License-Identifier: Apache-2.0
"""Varied images: people of motion capture as detectors see them, some without face or feet.

Motion capture has all keypoints in every frame, and its people favour one hand. A network that has
always seen the face fails where a detector has none, and one that has seen few left-handed throws
lifts them worse. So some of the images lose whole parts, and some become those of the mirrored
person: x is negated, and left and right keypoints change places.

Source: ours, not in the paper (docs/devlog/accuracy.md, "Wider networks, hidden parts").
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from deep_nrsfm_ros.configuration import option
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.virtual_people import FACE_KEYPOINTS, FEET_KEYPOINTS
from deep_nrsfm_ros.layouts.layout import KeypointLayout

_HIDDEN = {"hidden_face": FACE_KEYPOINTS, "hidden_feet": FEET_KEYPOINTS}
_HIDING_SEED, _MIRRORING_SEED = 5, 6  # two, so that each draw is the same without the other


@dataclass(frozen=True)
class ImageVariation:
    """Variation of the images of motion capture."""

    hidden_face: float = option(
        0.0,
        "share of the CMU images in which nose, eyes and ears are missing throughout, as from "
        "detectors without them; 0 = none, 0.25 typical",
        low=0.0,
        high=1.0,
    )
    hidden_feet: float = option(
        0.0,
        "share of the CMU images in which toes and heels are missing throughout, as from "
        "detectors without them; 0 = none, 0.15 typical",
        low=0.0,
        high=1.0,
    )
    mirrored_images: float = option(
        0.0,
        "share of the CMU images that are mirrored, with left and right exchanged, so that the "
        "model does not favour one hand; 0 = none, 0.5 typical",
        low=0.0,
        high=1.0,
    )

    def check(self, layout: KeypointLayout, name_of: Callable[[str], str] = str) -> None:
        """Raise ValueError if `layout` lacks the keypoints that a share needs.

        Args:
            layout: layout of the images.
            name_of: returns the name of an option, for the message.
        """
        missing = [
            (name, "none of its keypoints")
            for name, keypoints in _HIDDEN.items()
            if not set(keypoints) & set(layout.keypoints)
        ]
        if layout.partners() is None:
            missing.append(("mirrored_images", "no left and right keypoints"))
        for name, lack in missing:
            if share := getattr(self, name):
                raise ValueError(
                    f"{name_of(name)} is {share:g}, but layout {layout.name!r} has {lack}; "
                    "leave it out"
                )


def varied(dataset: Dataset, variation: ImageVariation) -> Dataset:
    """Return the dataset with parts of the body hidden in some images, and some images mirrored.

    Which images these are is drawn at random, independently for each part, by fixed seeds.

    Args:
        dataset: images of motion capture, x right.
        variation: the shares of the images.

    Raises:
        ValueError: the layout of the dataset has no such keypoints.
    """
    variation.check(dataset.layout)
    if variation == ImageVariation():
        return dataset
    points, visible = dataset.points.copy(), dataset.visible.copy()
    shapes = None if dataset.shapes is None else dataset.shapes.copy()
    rng = np.random.default_rng(_HIDING_SEED)
    for share, keypoints in _HIDDEN.items():
        images = np.flatnonzero(rng.random(len(dataset)) < getattr(variation, share))
        columns = np.flatnonzero([name in keypoints for name in dataset.layout.keypoints])
        visible[np.ix_(images, columns)] = False
    points[~visible] = 0
    partners = dataset.layout.partners()
    rng = np.random.default_rng(_MIRRORING_SEED)
    images = np.flatnonzero(rng.random(len(dataset)) < variation.mirrored_images)
    if partners is not None and len(images):
        mirror = np.array((-1, 1, 1), np.float32)
        points[images] = points[images][:, partners] * mirror[:2]
        visible[images] = visible[images][:, partners]
        if shapes is not None:
            shapes[images] = shapes[images][:, partners] * mirror
    shares = [f"{name} {share:g}" for name, share in vars(variation).items() if share]
    source = f"{dataset.source}; {', '.join(shares)}"
    return dataclasses.replace(
        dataset, points=points, visible=visible, shapes=shapes, source=source
    )
