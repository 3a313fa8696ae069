# SPDX-License-Identifier: Apache-2.0
"""Virtual hands: a kinematic right hand of published proportions, in random postures.

Hands that are shown to a webcam have few postures and few views, and a model of them has bones of
wrong proportions. A virtual hand has bones of lengths drawn about the published means, joints that
bend within their ranges, and keypoints that are drawn near the joints, since detectors define them
in their own ways. Network, error covariance and bones of `hand21` are learned from such hands too.

Source of the lengths: Buryanov and Kotiuk, "Proportions of hand segments", International Journal of
Morphology 28 (2010), radiographs of 66 adults; of DIP joints, which bend two thirds as far as PIP
joints: Rijpkema and Girard, "Computer animation of knowledge-based human grasping", SIGGRAPH 1991.
Ranges of angles are rounded from clinical norms; carpus and directions in the palm are ours.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.presets import preset
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras

Floats = NDArray[Any]

FINGERS = ("index", "middle", "ring", "pinky")
METACARPALS = (68.1, 64.6, 58.0, 53.7)
"""Lengths in mm of the metacarpal bones of the four `FINGERS`."""
PHALANGES = ((39.8, 22.4, 19.6), (44.6, 26.3, 21.4), (41.4, 25.7, 21.3), (32.7, 18.1, 19.7))
"""Lengths in mm of the phalanges of each finger from the knuckle on, its soft tip included."""
THUMB = (46.2, 31.6, 27.4)
"""Lengths in mm of the metacarpal and the phalanges of the thumb, its soft tip included."""
CARPUS = 30.0  # mm from the wrist to the metacarpal bones

LIMIT = 2.5  # of every normal deviate, in spreads
PART_SPREAD = 0.05  # of the length of palm, fingers and thumb, each relative to its mean
BONE_SPREAD = 0.07  # of the length of a phalanx relative to its part
KEYPOINT_SPREAD, WRIST_SPREAD, THUMB_BASE_SPREAD = 2.5, 6.0, 4.0  # mm per axis, of definitions

MCP, PIP = (-20.0, 85.0), (-3.0, 105.0)
"""Degrees from straight to bent, negative to the back."""
DIP_SHARE = 2 / 3  # bend of a DIP joint relative to the PIP joint
THUMB_MCP, THUMB_IP = (-8.0, 47.0), (-12.0, 63.0)
"""Degrees from straight to bent, negative to the back."""
THUMB_FORWARD, THUMB_ASIDE = (-5.0, 55.0), (-5.0, 55.0)
"""Degrees of the thumb's metacarpal out of the palm's plane, and from the fingers within it."""

# Spreads are standard deviations. A common one changes all four fingers of a hand alike.
_REACH_SPREAD = 5.0  # mm, common: from the wrist to the knuckles
_METACARPAL_SPREAD = 0.03  # of that of one finger, relative
_FAN = (-15.0, 0.0, 12.0, 24.0)  # degrees of the metacarpals from the middle one, to the left
_FAN_SPREAD = 0.12  # relative, common
_METACARPAL_TURN = 1.5  # degrees: spread of one metacarpal
_ARCH = (5.0, 2.0, 5.0, 11.0)  # mm of the knuckles before the wrist
_ARCH_SPREAD = 0.5  # relative, common
_KNUCKLE_SPREAD = 3.0  # mm, of one knuckle

# The curl of a finger is 0 where it is straight and 1 where it is bent.
_TOGETHER = 0.55  # share of the hands whose fingers bend together
_TOGETHER_SPREAD = 0.12  # of the curl of one of these fingers
_OPEN_OR_SHUT = 0.6  # share of the other fingers that are open or shut, not in between
_SHUT = 0.5  # share of these that are shut
_OPEN_CURL, _SHUT_CURL = 0.05, 0.9
_MCP_SPREAD, _PIP_SPREAD = 0.25, 0.2  # of the curl of a joint
_DIP_SPREAD = 0.25  # of the bend of a DIP joint, relative
_DIP_TURN = 5.0  # degrees: spread of its bend, beside the relative one
_PARALLEL = 0.6  # share of the fan that fingers keep which are not spread
_ABDUCTION = (-14.0, 0.0, 11.0, 20.0)  # degrees of fingers that are spread
_ABDUCTED = (-0.5, 1.0)  # range of the share of this, common; negative: towards each other
_ABDUCTION_SPREAD = 4.0  # degrees, of one finger
_ROLL = (8.0, 0.0, -8.0, -15.0)  # degrees by which bent fingers converge
_ROLL_SPREAD = 0.3  # relative, common
_ROLL_TURN = 5.0  # degrees: spread of one finger

_THUMB_BASE = (16.0, -24.0, -31.0)  # mm from the wrist: front, left, up
_BASE_SPREAD = 4.0  # mm per axis, of the joint; `THUMB_BASE_SPREAD` is of its definition
_OPPOSITION = 0.35  # degrees less aside for each degree forward, at most
_THUMB_ROLL = 45.0  # degrees from left to front of the direction to which the thumb bends
_ROLL_FORWARD = 1.1  # degrees less for each degree forward
_THUMB_ROLL_SPREAD = 15.0  # degrees
_THUMB_SPREAD = 0.25  # of the curl of a joint


def virtual_hands(count: int, seed: int = 0) -> Dataset:
    """Return virtual right hands as a dataset, each before an orthonormal camera of its own.

    Args:
        count: of hands.
        seed: of all random numbers.
    """
    rng = np.random.default_rng(seed)
    S = centre(hand_shapes(count, rng)).astype(np.float32)
    W = (S @ random_cameras(count, rng)).astype(np.float32)
    source = "virtual hands of published proportions"
    return Dataset(W, np.ones(W.shape[:2], bool), preset("hand21"), source, S)


def hand_shapes(count: int, rng: np.random.Generator) -> Floats:
    """Return n random right hands (n, 21, 3) in mm, in the axes of the layout hand21.

    Args:
        count: n.
        rng: draws proportions, postures and definitions of the keypoints.
    """
    layout, draw = preset("hand21"), _Draw(count, rng)
    shapes = np.zeros((count, len(layout), 3))
    fingers, thumb = _fingers(draw), _thumb(draw)
    for i, finger in enumerate(FINGERS):
        for k, joint in enumerate(("mcp", "pip", "dip", "tip")):
            shapes[:, layout.index(f"{finger}_{joint}")] = fingers[:, i, k]
    for k, joint in enumerate(("cmc", "mcp", "ip", "tip")):
        shapes[:, layout.index(f"thumb_{joint}")] = thumb[:, k]
    spread = np.full((len(layout), 1), KEYPOINT_SPREAD)
    spread[layout.index("wrist")] = WRIST_SPREAD
    spread[layout.index("thumb_cmc")] = THUMB_BASE_SPREAD
    return np.asarray(shapes + spread * draw.normal(len(layout), 3))


class _Draw:
    """Draws random numbers for n hands."""

    def __init__(self, count: int, rng: np.random.Generator) -> None:
        self.count, self.rng = count, rng

    def normal(self, *shape: int) -> Floats:
        """Return standard normal deviates (n, ...) within the limit."""
        deviates = self.rng.standard_normal((self.count, *shape))
        return np.asarray(np.clip(deviates, -LIMIT, LIMIT))

    def uniform(self, low: float, high: float, *shape: int) -> Floats:
        """Return uniform deviates (n, ...)."""
        return np.asarray(self.rng.uniform(low, high, (self.count, *shape)))


def _fingers(draw: _Draw) -> Floats:
    """Return the joints (n, 4, 4, 3) of the four fingers, each from its knuckle to its tip."""
    palm = 1 + PART_SPREAD * draw.normal(1)
    reach = (np.array(METACARPALS) + CARPUS + _REACH_SPREAD * draw.normal(1)) * palm
    reach = reach * (1 + _METACARPAL_SPREAD * draw.normal(4))
    fan = np.radians(_varied(draw, _FAN, _FAN_SPREAD, _METACARPAL_TURN))
    front = _varied(draw, _ARCH, _ARCH_SPREAD, _KNUCKLE_SPREAD)
    knuckles = np.stack((front, reach * np.sin(fan), -reach * np.cos(fan)), -1)

    curl = _curl(draw)
    mcp = _within(MCP, curl + _MCP_SPREAD * draw.normal(4))
    pip = _within(PIP, curl + _PIP_SPREAD * draw.normal(4))
    dip = DIP_SHARE * pip * (1 + _DIP_SPREAD * draw.normal(4))
    dip = dip + np.radians(_DIP_TURN) * draw.normal(4)
    abduction = np.array(_ABDUCTION) * draw.uniform(*_ABDUCTED, 1)
    abduction = abduction + _ABDUCTION_SPREAD * draw.normal(4)
    # Bent fingers cannot be spread.
    aside = _PARALLEL * fan + np.radians(abduction) * np.cos(np.clip(mcp, 0, None))
    ahead = np.stack((np.zeros_like(aside), np.sin(aside), -np.cos(aside)), -1)
    roll = np.radians(_varied(draw, _ROLL, _ROLL_SPREAD, _ROLL_TURN))
    palmar = np.stack((np.cos(roll), np.sin(roll), np.zeros_like(roll)), -1)
    lengths = np.array(PHALANGES) * (1 + PART_SPREAD * draw.normal(1, 1))
    lengths = lengths * (1 + BONE_SPREAD * draw.normal(4, 3))
    return _chain(knuckles, _Bend(ahead, palmar), np.stack((mcp, pip, dip), -1), lengths)


def _varied(draw: _Draw, means: tuple[float, ...], common_spread: float, spread: float) -> Floats:
    """Return numbers (n, 4) of the four fingers.

    Args:
        draw: the random numbers.
        means: of the fingers.
        common_spread: of the size of all four, relative.
        spread: of each of them, in the unit of the means.
    """
    common = 1 + common_spread * draw.normal(1)
    return np.asarray(np.array(means) * common + spread * draw.normal(len(means)))


def _curl(draw: _Draw) -> Floats:
    """Return how far (n, 4) the fingers are bent, from 0 to 1: together, or each for itself."""
    together = draw.uniform(0, 1, 1) + _TOGETHER_SPREAD * draw.normal(4)
    open_or_shut = np.where(draw.uniform(0, 1, 4) < _SHUT, _SHUT_CURL, _OPEN_CURL)
    alone = np.where(draw.uniform(0, 1, 4) < _OPEN_OR_SHUT, open_or_shut, draw.uniform(0, 1, 4))
    return np.clip(np.where(draw.uniform(0, 1, 1) < _TOGETHER, together, alone), 0, 1)


def _thumb(draw: _Draw) -> Floats:
    """Return the joints (n, 4, 3) of the thumb."""
    base = np.array(_THUMB_BASE) * (1 + PART_SPREAD * draw.normal(1))
    base = base + _BASE_SPREAD * draw.normal(3)
    forward = draw.uniform(*THUMB_FORWARD)
    # A thumb that opposes the fingers lies before the palm, not beside it.
    aside = draw.uniform(*THUMB_ASIDE) - _OPPOSITION * forward.clip(0) * draw.uniform(0, 1)
    a, b = np.radians(forward), np.radians(aside)
    ahead = np.stack((np.sin(a), -np.cos(a) * np.sin(b), -np.cos(a) * np.cos(b)), -1)
    roll = np.radians(_THUMB_ROLL - _ROLL_FORWARD * forward + _THUMB_ROLL_SPREAD * draw.normal())
    across = np.stack((np.sin(roll), np.cos(roll), np.zeros_like(roll)), -1)
    lengths = np.array(THUMB) * (1 + PART_SPREAD * draw.normal(1))
    lengths = lengths * (1 + BONE_SPREAD * draw.normal(3))
    curl = draw.uniform(0, 1, 1) + _THUMB_SPREAD * draw.normal(2)
    mcp, ip = _within(THUMB_MCP, curl[:, 0]), _within(THUMB_IP, curl[:, 1])
    bends = np.stack((np.zeros_like(mcp), mcp, ip), -1)
    return _chain(base, _Bend(ahead, across), bends, lengths)


def _within(limits: tuple[float, float], share: Floats) -> Floats:
    """Return the angle in radians at a share of the way between two limits in degrees."""
    low, high = np.radians(limits)
    return np.asarray(low + (high - low) * np.clip(share, 0, 1))


class _Bend:
    """The plane in which a finger bends.

    Attributes:
        ahead: (..., 3) unit vector of the straight finger.
        bent: (..., 3) unit vector to which it bends, at a right angle to `ahead`.
    """

    def __init__(self, ahead: Floats, side: Floats) -> None:
        self.ahead = ahead
        bent = side - (side * ahead).sum(-1, keepdims=True) * ahead
        self.bent = bent / np.linalg.norm(bent, axis=-1, keepdims=True)


def _chain(base: Floats, plane: _Bend, bends: Floats, lengths: Floats) -> Floats:
    """Return the joints (..., 4, 3) of a finger from its base (..., 3), three bones on.

    Args:
        base: (..., 3) mm.
        plane: in which the finger bends.
        bends: (..., 3) radians at the beginning of each bone.
        lengths: (..., 3) mm of the bones.
    """
    angles = np.cumsum(bends, -1)[..., None]
    directions = (
        np.cos(angles) * plane.ahead[..., None, :] + np.sin(angles) * plane.bent[..., None, :]
    )
    ends = base[..., None, :] + np.cumsum(lengths[..., None] * directions, -2)
    return np.concatenate((base[..., None, :], ends), -2)
