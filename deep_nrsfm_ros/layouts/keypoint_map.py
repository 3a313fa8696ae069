# SPDX-License-Identifier: Apache-2.0
"""Keypoints of one layout in the order of another, matched by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import preset_keypoints
from deep_nrsfm_ros.layouts.spelling import match_names

_MIN_SHARED = 4  # a shape is unique from four points on
_MOST_MISSING = 1 / 3  # of the keypoints of a target, which a source may leave out
_MANY_OTHERS = 3  # names of a source that the target lacks, which may be those that it misses
_SHOWN = 6  # names of keypoints in an error text


class TooFewSharedError(ValueError):
    """Two layouts share too few keypoints by name for one to be lifted as the other."""


def detected_count(visible: NDArray[np.bool_], derivations: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the number (n,) of visible keypoints, without those that follow from others.

    Args:
        visible: (n, p).
        derivations: (m, 2) as in `KeypointMap`.
    """
    count: NDArray[np.int64] = visible.sum(1)
    for t in np.unique(derivations[:, 0]):
        parts = derivations[derivations[:, 0] == t, 1]
        count -= visible[:, t] & visible[:, parts].all(1)
    return count


def _shown(names: Sequence[str]) -> str:
    """Return the first names of a list, for error texts."""
    return ", ".join(names[:_SHOWN]) + ", ..." * (len(names) > _SHOWN)


class Unnamed(NamedTuple):
    """Keypoints of a target that may have another name in the source, in words.

    Attributes:
        filled: "4 of the 7 keypoints".
        others: "3 other ones (a, b, c)", of the source.
        missing: the first names of those that nothing fills.
    """

    filled: str
    others: str
    missing: str


class KeypointMap:
    """Maps keypoints of a source layout to a target layout by name.

    Attributes:
        source: layout of the input.
        target: layout of the output.
        identical: True if both have the same keypoints in the same order.
        filled: names of the keypoints of the target that the source has, or that follow from them.
        unused: names of the source that the target does not have, and that nothing follows from.
        derivations: pairs (m, 2) of a keypoint of the target and a keypoint that it follows from,
            in the order of the first. A visible keypoint adds no information where all that it
            follows from are visible. The pair (t, t) marks a keypoint that this map computes; it
            never counts as detected.
    """

    def __init__(self, source: KeypointLayout, target: KeypointLayout) -> None:
        """Match the names of the two layouts, equal ones first (`spelling.match_names`).

        A keypoint of the target whose name the source layout lacks is derived, if the target says
        how, or stays missing. A keypoint that is missing in one frame only is not derived.

        Raises:
            TooFewSharedError: fewer than 4 keypoints match; no shape can be lifted from them.
        """
        self.source, self.target = source, target
        self.identical = source.keypoints == target.keypoints
        parts = (part for name in target.keypoints for part in target.derived.get(name, ()))
        sources = match_names(source.keypoints, (*target.keypoints, *parts))
        direct = [(t, sources[name]) for t, name in enumerate(target.keypoints) if name in sources]
        self._to = np.array([t for t, _ in direct], int)
        self._from = np.array([s for _, s in direct], int)
        self._derived = [
            (t, [sources[part] for part in target.derived[name]])
            for t, name in enumerate(target.keypoints)
            if name not in sources
            and name in target.derived
            and all(part in sources for part in target.derived[name])
        ]
        mapped = (*direct, *self._derived)
        used = set(sources.values())
        self.unused = tuple(name for i, name in enumerate(source.keypoints) if i not in used)
        self.filled = tuple(target.keypoints[t] for t, _ in mapped)
        if len(mapped) < _MIN_SHARED:
            raise TooFewSharedError(
                f"layouts {source.name!r} and {target.name!r} share {len(mapped)} keypoints by "
                f"name; at least {_MIN_SHARED} are needed. {source.name!r} has "
                f"{_shown(source.keypoints)}; {target.name!r} has {_shown(target.keypoints)}"
            )
        self.derivations = self._find_derivations()

    def unnamed(self) -> Unnamed | None:
        """Return the keypoints of the target that may have another name; None if few may.

        A detector of people may give a face and fingers that the target lacks: they are no names
        of its keypoints.
        """
        missing = [name for name in self.target.keypoints if name not in self.filled]
        others = self.unused
        if len(missing) <= _MOST_MISSING * len(self.target) or len(others) < _MANY_OTHERS:
            return None
        if {"left_hip", "left_ankle"} <= set(self.target.keypoints):
            others = tuple(name for name in others if name not in preset_keypoints())
            if len(others) < _MANY_OTHERS:
                return None
        counts = f"{len(self.filled)} of the {len(self.target)} keypoints"
        return Unnamed(counts, f"{len(others)} other ones ({_shown(others)})", _shown(missing))

    def _find_derivations(self) -> NDArray[np.int32]:
        """Return the attribute `derivations`."""
        target, mapped = self.target, {t for t, _ in self._derived}
        pairs: list[tuple[int, int]] = []
        for t, name in enumerate(target.keypoints):
            parts = target.derived.get(name, ())
            if t in mapped:
                pairs.append((t, t))
            elif all(part in target.keypoints for part in parts):
                pairs += [(t, target.index(part)) for part in parts]
        return np.array(pairs, np.int32).reshape(-1, 2)

    def detected_count(self, visible: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return the number (n,) of visible keypoints, without those that follow from others.

        Args:
            visible: (n, p) in the target layout.
        """
        return detected_count(visible, self.derivations)

    def __call__(
        self, points: NDArray[np.float32], confidence: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return points and confidence in the target layout.

        Args:
            points: (n, q, 2) in the source layout.
            confidence: (n, q) in [0, 1]; 0 marks a missing keypoint.

        Returns:
            Points (n, p, 2) and confidence (n, p). A derived keypoint is the mean of its parts,
            with the least of their confidences. A missing keypoint is (0, 0) with confidence 0.
        """
        if self.identical:
            return points, confidence
        shape = (len(points), len(self.target))
        mapped, mapped_confidence = np.zeros((*shape, 2), np.float32), np.zeros(shape, np.float32)
        mapped[:, self._to] = points[:, self._from]
        mapped_confidence[:, self._to] = confidence[:, self._from]
        for t, parts in self._derived:
            mapped[:, t] = points[:, parts].mean(1)
            mapped_confidence[:, t] = confidence[:, parts].min(1)
        mapped[mapped_confidence == 0] = 0
        return mapped, mapped_confidence
