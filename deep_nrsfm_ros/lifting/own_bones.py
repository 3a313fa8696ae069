# SPDX-License-Identifier: Apache-2.0
"""The bone lengths of one object, learned while it is seen.

A model has the mean lengths of the bones of all objects that it has learned from, and their spread.
One object differs from them, and so do the keypoints of one detector from those of another. The
shapes that the keypoints alone have corrected, the first stage of `lifting.correction`, measure the
lengths: best where a bone lies across the line of sight. They do not depend on the lengths that are
learned, so nothing confirms itself.

A length is remembered as its growth, the logarithm of its ratio to the model's. As the size of an
object is unknown, only differences between growths count. Both sides of the body share one growth.

Symbols: n objects, b bones, L (b,) lengths and T (b,) = (L / spread)^2 precision in the model,
X (n, p, 3) shapes of the first stage in object axes, R (n, 3, 3) from object to camera axes.

Source: ours, not in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.network_smoothing import gain
from deep_nrsfm_ros.nrsfm.bones import Bones
from deep_nrsfm_ros.nrsfm.geometry import Floats

FORESHORTENING_POWER = 4
"""Of the squared share of a bone that lies across the line of sight, in its weight."""
REWEIGHTINGS = 2
"""Of the mean growth, against bones that are measured wrong."""
OUTLIER = 3.0
"""Deviation in spreads of the model, above which a bone counts less."""
MAX_STEP = 0.35
"""Largest difference of a measured growth from the learned one that counts."""
MAX_SECONDS = 0.1
"""Longest time for which one frame counts as evidence."""
MEMORY = 10.0
"""Seconds of sight beyond which older ones are forgotten."""
MAX_VARIANCE_REDUCTION = 0.8
"""Share of a length's variance that learning removes, at most."""
MISFIT_TIME = 0.5
"""Time constant in seconds of the test whether the object is another one."""
MISFIT_RATIO = 1.1
"""Ratio of the misfits of learned and of the model's lengths above which it is another one."""
CHANGE_EVIDENCE = 0.5
"""Seconds of sight that the test needs."""
DOUBTED_EVIDENCE = 0.1
"""Seconds of sight that are left of an object that is another one."""


class Learned(NamedTuple):
    """What is learned of the bones of n objects; fields as in `history.State`."""

    growth: Floats
    evidence: Floats
    misfit: Floats


class Sight(NamedTuple):
    """The bones of n objects as one frame shows them.

    Attributes:
        growth: (n, b) logarithm of the measured length relative to the model's.
        weight: (n, b) in [0, 1]; 0: not visible, or along the line of sight.
    """

    growth: Floats
    weight: Floats


def partner_bones(ends: NDArray[np.int32], partners: Sequence[int]) -> NDArray[np.int32]:
    """Return for each bone the index (b,) of that of the other side; its own if there is none.

    Args:
        ends: (2, b) keypoints.
        partners: for each keypoint that of the other side, or itself.
    """
    bones = [frozenset(pair) for pair in ends.T.tolist()]
    mirrored = [frozenset(partners[i] for i in bone) for bone in bones]
    found = [bones.index(bone) if bone in bones else i for i, bone in enumerate(mirrored)]
    return np.array(found, np.int32)


def own_growth(bones: Bones, learned: Learned, bones_time: float) -> Floats:
    """Return the growth (n, b) of each bone that lifting takes, without their common scale.

    Args:
        bones: of the model.
        learned: of n objects.
        bones_time: seconds of sight with which half of the learned growth counts; 0: none ever
            does.
    """
    growth = _trust(learned.evidence, bones_time) * learned.growth
    precision = (bones.lengths / bones.spread) ** 2
    scale: Floats = growth @ precision / precision.sum()
    return growth - scale[:, None]


def own_bones(bones: Bones, learned: Learned, bones_time: float) -> Bones:
    """Return bones with the lengths (n, b) and the spread (n, b) of each object."""
    lengths = bones.lengths * np.exp(own_growth(bones, learned, bones_time))
    spread = bones.spread * np.sqrt(
        1 - MAX_VARIANCE_REDUCTION * _trust(learned.evidence, bones_time)
    )
    return bones._replace(lengths=lengths, spread=spread)


def in_reference_units(
    lengths: Floats, ends: NDArray[np.int32], reference: tuple[int, int], reference_length: float
) -> Floats:
    """Return lengths (b,) scaled so that the bone of the reference pair has the reference length.

    Where no bone joins the pair they stay.

    Args:
        lengths: (b,) of the bones, in any unit.
        ends: (2, b) keypoints of the bones.
        reference: pair of keypoints.
        reference_length: distance of the pair in the new unit.
    """
    a, b = reference
    joins = ((ends[0] == a) & (ends[1] == b)) | ((ends[0] == b) & (ends[1] == a))
    return lengths * (reference_length / lengths[joins.argmax()]) if joins.any() else lengths


def named_lengths(
    lengths: Floats, ends: NDArray[np.int32], names: Sequence[str], chosen: NDArray[np.bool_]
) -> dict[str, float]:
    """Return the lengths of the chosen bones by the names of their ends: "elbow-wrist".

    Args:
        lengths: (b,) of the bones.
        ends: (2, b) keypoints of the bones.
        names: of all keypoints.
        chosen: (b,) which bones.
    """
    return {
        f"{names[ends[0, i]]}-{names[ends[1, i]]}": float(lengths[i])
        for i in np.flatnonzero(chosen)
    }


def measure(bones: Bones, X: Floats, R: Floats, weight: Floats) -> Sight:
    """Return the bones as the first stage shows them.

    Args:
        bones: of the model.
        X: (n, p, 3) shapes in object axes.
        R: (n, 3, 3) from object to camera axes.
        weight: (n, p) of the keypoints; 0: not visible.
    """
    i, j = bones.ends
    edges = X[:, i] - X[:, j]
    square = np.maximum((edges * edges).sum(2), 1e-18)
    along = (edges @ R[:, 2, :, None])[..., 0]
    across = np.clip(1 - along * along / square, 0, 1)
    sight = across**FORESHORTENING_POWER * np.minimum(weight[:, i], weight[:, j])
    return Sight(np.log(np.sqrt(square) / bones.lengths), sight)


def learn(
    bones: Bones,
    partners: NDArray[np.int32],
    learned: Learned,
    sight: Sight,
    seconds: Floats,
    bones_time: float,
) -> Learned:
    """Return what is learned after one more frame.

    Args:
        bones: of the model.
        partners: (b,) as `partner_bones` returns them.
        learned: of n objects before the frame.
        sight: of the frame.
        seconds: (n,) since the last frame.
        bones_time: as in `own_growth`.
    """
    precision = (bones.lengths / bones.spread) ** 2
    w = sight.weight
    expected = own_growth(bones, learned, bones_time)
    misfit = np.stack([_misfit(sight, g, precision) for g in (expected, 0 * expected)], 1)
    part = gain(seconds, MISFIT_TIME)[:, None] * (w.sum(1) > 0)[:, None]
    misfit = learned.misfit + part * (misfit - learned.misfit)
    evidence = learned.evidence
    another = (evidence.max(1) > CHANGE_EVIDENCE) & (misfit[:, 0] > MISFIT_RATIO * misfit[:, 1])
    evidence = np.where(another[:, None], np.minimum(evidence, DOUBTED_EVIDENCE), evidence)
    # The common scale, which is the unknown size, without bones that are measured wrong.
    r, limit = sight.growth - expected, OUTLIER / np.sqrt(precision)
    scale = _mean(r, w * precision)
    for _ in range(REWEIGHTINGS):
        scale = _mean(r, w * precision / np.maximum(1, np.abs(r - scale) / limit))
    both = w + w[:, partners]
    own = w * (sight.growth - scale)
    growth = (own + own[:, partners]) / np.maximum(both, 1e-12)
    gained = both / 2 * np.minimum(seconds, MAX_SECONDS)[:, None]
    evidence = np.minimum(evidence + gained, MEMORY)
    step = np.minimum(gained / np.maximum(evidence, 1e-12), 1)
    step = step * np.clip(growth - learned.growth, -MAX_STEP, MAX_STEP)
    return Learned(learned.growth + step, evidence, misfit)


def _trust(evidence: Floats, bones_time: float) -> Floats:
    """Return the share in [0, 1) of what is learned that counts."""
    return evidence / (evidence + bones_time) if bones_time else 0 * evidence


def _mean(x: Floats, weight: Floats) -> Floats:
    """Return the weighted mean (n, 1) of x (n, b); 0 without weight."""
    mean: Floats = (weight * x).sum(1) / np.maximum(weight.sum(1), 1e-12)
    return mean[:, None]


def _misfit(sight: Sight, growth: Floats, precision: Floats) -> Floats:
    """Return the mean squared deviation (n,) of a frame from lengths of this growth, in spreads."""
    x, w = sight.growth - growth, sight.weight
    square = precision * (x - _mean(x, w * precision)) ** 2
    misfit: Floats = (w * np.minimum(square, OUTLIER**2)).sum(1) / np.maximum(w.sum(1), 1e-12)
    return misfit
