# SPDX-License-Identifier: Apache-2.0
"""Varied images: people of motion capture as detectors and lenses show them.

Motion capture has all keypoints in every frame, its people favour one hand, and the cameras of the
method are orthographic. A network that has always seen the face fails where a detector has none;
one that has seen few left-handed throws lifts them worse; and one that has never seen perspective
mirrors people close to the camera. So some of the images lose whole parts, some become those of the
mirrored person (x is negated, left and right keypoints change places), and some are seen by a lens
a few metres away.

Source: ours, not in the paper (docs/devlog/accuracy.md, "Wider networks, hidden parts").
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.virtual_people import FACE_KEYPOINTS, FEET_KEYPOINTS
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.nrsfm.geometry import Floats, centre

_HIDDEN = {"hidden_face": FACE_KEYPOINTS, "hidden_feet": FEET_KEYPOINTS}
NEAREST, FARTHEST = 2.0, 8.0
"""Metres between a lens and the centre of a person; the inverse distance is uniform."""
# One for each kind of draw, so that it is the same without the others.
_HIDING_SEED, _MIRRORING_SEED, _PERSPECTIVE_SEED = 5, 6, 7


@dataclass(frozen=True)
@described
class ImageVariation:
    """Variation of the images of motion capture."""

    hidden_face: float = option(
        0.0,
        "share of the CMU images in which nose, eyes and ears are all missing, as from detectors "
        "without them; the images are drawn once, before the training; --mask hides more keypoints "
        "at each step, in these images too; 0 = none, 0.25 typical",
        low=0.0,
        high=1.0,
    )
    hidden_feet: float = option(
        0.0,
        "share of the CMU images in which toes and heels are all missing, as from detectors "
        "without them; the images are drawn once, before the training; --mask hides more keypoints "
        "at each step, in these images too; 0 = none, 0.15 typical",
        low=0.0,
        high=1.0,
    )
    mirrored_images: float = option(
        0.0,
        "share of the CMU images that are mirrored, with left and right exchanged, so that the "
        "model does not favour one hand; the images are drawn once, before the training; 0 = none, "
        "0.5 typical",
        low=0.0,
        high=1.0,
    )
    perspective_images: float = option(
        0.0,
        "share of the CMU images that a lens 2 to 8 m away has taken, instead of an orthographic "
        "camera; the images are drawn once, before the training; people come out mirrored less "
        "often, above all without intrinsics; from random weights errors grow by up to 8 mm; 0 = "
        "none, 0.3 typical with --from, from a model that has learned without perspective",
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
    """Return the dataset with some images in perspective, some without parts, and some mirrored.

    Which images these are is drawn at random, independently for each kind, by fixed seeds.

    Args:
        dataset: images of motion capture, x right and y down, with shapes and cameras, in metres.
        variation: the shares of the images.

    Raises:
        ValueError: the layout of the dataset has no such keypoints, or it has no ground truth.
    """
    variation.check(dataset.layout)
    if variation == ImageVariation():
        return dataset
    if dataset.shapes is None or dataset.cameras is None:
        raise ValueError("images without shapes and cameras cannot be varied")
    points, visible, shapes = dataset.points.copy(), dataset.visible.copy(), dataset.shapes.copy()
    rng = np.random.default_rng(_PERSPECTIVE_SEED)
    distances = 1 / rng.uniform(1 / FARTHEST, 1 / NEAREST, len(dataset))
    images = np.flatnonzero(rng.random(len(dataset)) < variation.perspective_images)
    M = dataset.cameras[images]
    depths = (shapes[images] * np.cross(M[..., 0], M[..., 1])[:, None]).sum(-1)
    points[images] = in_perspective(points[images], depths, distances[images])
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
        shapes[images] = shapes[images][:, partners] * mirror
    shares = [f"{name} {share:g}" for name, share in vars(variation).items() if share]
    source = f"{dataset.source}; {', '.join(shares)}"
    return dataclasses.replace(
        dataset, points=points, visible=visible, shapes=shapes, cameras=None, source=source
    )


def in_perspective(points: Floats, depths: Floats, distances: Floats) -> Floats:
    """Return the images (n, p, 2) that a lens takes of people whose orthographic images are given.

    The images are centred, and people keep their size at the distance of their centre.

    Args:
        points: (n, p, 2) orthographic images in metres, x right and y down, centred.
        depths: (n, p) metres behind the centre of the person.
        distances: (n,) metres from the lens to the centre of the person.
    """
    seen: Floats = points / (1 + depths / distances[:, None])[..., None]
    return centre(seen.astype(points.dtype))
