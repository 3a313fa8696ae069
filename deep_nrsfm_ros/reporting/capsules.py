# SPDX-License-Identifier: Apache-2.0
"""Lifted people as capsules: their URDF with their own bone lengths, posed by their angles."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.body.kinematic_tree import KinematicTree
from deep_nrsfm_ros.body.urdf import UrdfDrawing, urdf
from deep_nrsfm_ros.layouts.layout import KeypointLayout

Floats = NDArray[Any]


class Capsules(NamedTuple):
    """The capsules of one object in f frames.

    Attributes:
        ends: (f, c, 2, 3) of their axes, in the axes and unit of the points; NaN where nothing was
            lifted.
        radius: of all, in the same unit; 0 where there is none.
    """

    ends: Floats
    radius: float


def body_capsules(layout: KeypointLayout, shapes: Floats) -> Capsules:
    """Return the capsules of an object, none if its layout names no joints.

    Args:
        layout: of the points.
        shapes: (f, p, 3) of one object, in right-handed axes; NaN where nothing was lifted.
    """
    known = np.isfinite(shapes).all((1, 2))
    if not layout.joints or not known.any():
        return Capsules(np.empty((len(shapes), 0, 2, 3)), 0.0)
    tree = KinematicTree(layout)
    pose = tree(shapes[known])
    drawing = UrdfDrawing(urdf(tree, np.median(tree.offsets(pose), 0)))
    posed, radius = [], 0.0
    for origin, rotation, angles in zip(
        pose.origins[:, 0], pose.rotations[:, 0], pose.angles, strict=True
    ):
        values = dict(zip(tree.angle_names, angles.tolist(), strict=True))
        capsules = drawing.capsules(values)
        ends = np.array([(capsule.start, capsule.end) for capsule in capsules])
        is_long = (ends[:, 0] != ends[:, 1]).any(-1)  # a sphere is the round end of a capsule
        posed.append(ends[is_long] @ rotation.T + origin)
        radius = capsules[0].radius
    found = np.full((len(shapes), *posed[0].shape), np.nan)
    found[known] = posed
    return Capsules(found, radius)
