# SPDX-License-Identifier: Apache-2.0
"""Hands as right hands: left and right told apart by their places, and one side mirrored.

A model of hands learns right hands. Detectors report both, and recordings often do not say which is
which. An orthographic image does not tell either: a left palm and the back of a right hand look
alike. So a mistake here makes no reprojection error; it teaches a mirrored depth.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import preset
from deep_nrsfm_ros.wording import wording

Float32 = NDArray[np.float32]

SIDES = ("right", "left", "palms")
"""What is known of recorded hands: all are right, all are left, or each shows its palm."""
MIXED = 0.3
"""Share of hands that look like the other side from which on both sides are probably mixed.

In hands that are sorted it is up to 0.26 (`signers`), as they turn; in unsorted ones of gestures it
is 0.38 and 0.47.
"""
_SOME = 0.1  # share from which on the question is worth asking
_SAMPLE = 5000  # hands
_PALM = ("wrist", "index_mcp", "pinky_mcp")

_MIRROR = np.array([-1, 1], np.float32)


def mirrored(points: Float32) -> Float32:
    """Return keypoints (..., 2) of the mirrored image: x with the other sign."""
    return points * _MIRROR


def right_hands(points: Float32, *, mirrored_image: bool = False) -> Float32:
    """Return both hands of people who face the camera as right hands, sorted by their places.

    The right hand of a person who faces the camera is on the left of the image. Crossed hands are
    mistaken for each other.

    Args:
        points: (f, 2, 21, 2) both hands of a person in f frames, in any order and unit.
        mirrored_image: whether the image was mirrored before detection, as selfie cameras do.

    Returns:
        (2f, 21, 2): the right hands, then the left ones, mirrored.

    Raises:
        ValueError: the points have another shape.
    """
    single = "; single hands are sorted by palms_as_right_hands, left ones mirrored by mirrored"
    points = _checked(points, 2, 21, 2, hint=single)
    if mirrored_image:
        points = mirrored(points)
    order = points[..., 0].mean(2).argsort(1)
    in_order = np.take_along_axis(points, order[:, :, None, None], 1)
    return np.concatenate((in_order[:, 0], mirrored(in_order[:, 1])))


def palms_as_right_hands(points: Float32) -> Float32:
    """Return single hands (f, 21, 2) as right hands, as if each showed its palm to the camera.

    For gestures shown to a camera, where nothing else tells left from right.

    Raises:
        ValueError: the points have another shape.
    """
    points = _checked(points, 21, 2)
    left = _look_left(points, preset("hand21"))
    return np.where(left[:, None, None], mirrored(points), points)


def _checked(points: Float32, *shape: int, hint: str = "") -> Float32:
    """Return points as an array; raise ValueError unless they are of frames of the shape."""
    given = np.asarray(points)
    if given.shape[1:] != shape or not given.ndim:
        needed = f"(f, {', '.join(map(str, shape))})"
        raise ValueError(f"points are {given.shape}; hands need {needed}{hint}")
    return given


def check_side(option: str, side: str) -> None:
    """Raise ValueError unless `side`, given by `option`, is one of `SIDES` or "", unknown."""
    if side not in ("", *SIDES):
        raise ValueError(f"{option} is {side!r}; it is one of {', '.join(SIDES)}")


def as_right_hands(hands: Dataset, side: str) -> Dataset:
    """Return a dataset of hands as right hands.

    Args:
        hands: in a layout that has the keypoints wrist, index_mcp and pinky_mcp.
        side: what is known of them, one of `SIDES`.

    Raises:
        ValueError: the layout lacks one of these keypoints.
    """
    layout = hands.layout
    if lacking := [name for name in _PALM if name not in layout.keypoints]:
        raise ValueError(
            f"hands are {side!r}, but the object {layout.name!r} has no {', '.join(lacking)}: "
            "leave this out, or name the object hand21 "
            f"({wording('--object, train.object', node='train.object', python='object')})"
        )
    if side == "palms":
        left = _look_left(hands.points, layout)
    else:
        left = np.full(len(hands), side == "left")
    points = np.where(left[:, None, None], mirrored(hands.points), hands.points)
    return dataclasses.replace(hands, points=points, is_one_side=True)


def other_side_share(hands: Dataset) -> float:
    """Return the share, 0 to 0.5, of hands that look like the other side than most.

    A left palm and the back of a right hand look alike, so a hand that turns counts as both. NaN
    where the layout is of no hand, or no hand shows its palm's three corners.
    """
    if not set(_PALM) <= set(hands.layout.keypoints):
        return np.nan
    some = hands[np.unique(np.linspace(0, len(hands) - 1, min(len(hands), _SAMPLE)).astype(int))]
    shown = some.visible[:, [hands.layout.index(name) for name in _PALM]].all(1)
    if not shown.any():
        return np.nan
    share = float(_look_left(some.points[shown], hands.layout).mean())
    return min(share, 1 - share)


def mixed_sides(hands: Dataset, least: float = _SOME) -> str:
    """Return a sentence that left and right hands may be mixed; "" where nothing says so.

    Args:
        hands: of any layout; those that are said to be of one side are believed.
        least: share of hands that look like the other side below which nothing is said.
    """
    share = np.nan if hands.is_one_side else other_side_share(hands)
    if not share >= least:
        return ""
    option = wording("--hands, train.hands", node="train.hands", python="hands")
    return (
        f"{100 * share:.0f} % of the hands look like those of the other side: if left and right "
        "hands are mixed, the model learns a mirrored depth, and no figure shows it. Say what they "
        f"are ({option}): palms (each shows its palm: left ones are mirrored), right or left"
    )


def _look_left(points: Float32, layout: KeypointLayout) -> NDArray[np.bool_]:
    """Return for each hand (f, p, 2) whether it looks like a left palm or the back of a right hand.

    A right palm with its fingers up has the index finger right of the little one: from one to the
    other the turn is anticlockwise, which is negative with y down.
    """
    wrist, index, pinky = (layout.index(name) for name in _PALM)
    a, b = points[:, index] - points[:, wrist], points[:, pinky] - points[:, wrist]
    left: NDArray[Any] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 0
    return left
