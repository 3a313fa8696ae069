# SPDX-License-Identifier: Apache-2.0
"""Keypoints that contradict all others, which a lift takes as missing.

A detector puts a keypoint at a wrong place now and then: the wrist of another person, a nose at
the image's border. One such keypoint can turn the whole object. A network fits it by bending all
others, so that the largest residual does not tell which one it is. But without it the others fit
much better, and it is far from where they say that it should be. Both are asked for here.

Only objects that the network fits badly are looked at, so that most cost nothing.

Symbols: n objects, p keypoints.

Source: ours, not in the paper.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.keypoint_map import detected_count
from deep_nrsfm_ros.nrsfm.geometry import Floats, on_one_line

MIN_RESIDUAL = 0.15
"""Residual of the network's fit above which an object is looked at; 0.07 to 0.1 is typical."""
RESIDUAL_RATIO = 0.6
"""The residual without a wrong keypoint is less than this times the one with it."""
MIN_DISTANCE = 0.5
"""Least distance of a wrong keypoint from its place, in RMS radii of the visible keypoints."""
FEWEST = 8
"""Detected keypoints that must be left: fewer do not tell which one is wrong."""
CANDIDATES = 5
"""Keypoints that are tried, those of the largest residuals."""
MOST = 3
"""Keypoints of an object that are left out, at most."""


class Fit(NamedTuple):
    """The network's fit of one object, or of n.

    Attributes:
        residual: relative reprojection error of the visible keypoints; (n,) of n objects.
        distances: (p,) of each keypoint in the image from its projection, in RMS radii; (n, p).
    """

    residual: Floats
    distances: Floats


def without_wrong(
    fit: Callable[[NDArray[np.bool_]], Fit],
    points: Floats,
    visible: NDArray[np.bool_],
    derivations: NDArray[np.int32],
    fewest: int,
) -> NDArray[np.bool_]:
    """Return which keypoints (p,) of an object are visible and not wrong.

    Args:
        fit: returns the network's fit to the visible keypoints (p,).
        points: (p, 2) in the image.
        visible: (p,).
        derivations: (m, 2) keypoints and those that they follow from: a neck is wrong where a
            shoulder is.
        fewest: detected keypoints that must be left, at least `FEWEST`.
    """
    now = fit(visible)
    for _ in range(MOST):
        if not now.residual > MIN_RESIDUAL:
            break
        best, left = now, visible
        shown = np.flatnonzero(visible)
        for candidate in shown[np.argsort(-now.distances[shown], kind="stable")[:CANDIDATES]]:
            others = _without(candidate, visible, derivations)
            enough = detected_count(others[None], derivations)[0] >= max(fewest, FEWEST)
            if not enough or on_one_line(points[None], others[None])[0]:
                continue
            fitted = fit(others)
            far = fitted.distances[candidate] > MIN_DISTANCE
            limit = min(best.residual, RESIDUAL_RATIO * now.residual)
            if far and fitted.residual < limit:
                best, left = fitted, others
        if left is visible:
            break
        now, visible = best, left
    return visible


def _without(
    keypoint: int, visible: NDArray[np.bool_], derivations: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Return the visible keypoints without one, and without those that follow from it."""
    left = visible.copy()
    left[keypoint] = False
    left[derivations[derivations[:, 1] == keypoint, 0]] = False
    return left
