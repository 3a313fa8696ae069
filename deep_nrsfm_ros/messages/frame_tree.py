# SPDX-License-Identifier: Apache-2.0
"""Transforms between the frames of /tf at a time, without tf2, which PyPI lacks."""

from __future__ import annotations

import math
from bisect import bisect_left
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.geometry import rotation_from_quaternion

Quaternion = tuple[float, float, float, float]
Translation = tuple[float, float, float]

_MAX_FRAMES = 1000  # objects have frames of their own, which come and go
_MAX_DEPTH = 100  # of a chain of frames: a loop ends
_MAX_KEPT = 200  # transforms of a frame
_KEPT_TIME = 5_000_000_000  # ns for which a transform is kept
_SHORTEST = 1e-12  # squared length of a quaternion that is a rotation
_ALIGNED = 1 - 1e-9  # cosine of half the angle between rotations from which on a mean is exact


class Transform(NamedTuple):
    """p_target = R p_source + t at a time.

    Attributes:
        rotation: R (3, 3).
        translation: t (3,).
        gap: seconds between the time and the nearest kept transform, where no two enclose it; 0 if
            it is exact.
    """

    rotation: NDArray[Any]
    translation: NDArray[Any]
    gap: float = 0.0


class _Frame:
    """The last transforms of one frame to its parent, by time."""

    def __init__(self, parent: str) -> None:
        """Start without transforms."""
        self.parent = parent
        self._stamps: list[int] = []
        self._moves: list[tuple[Quaternion, Translation]] = []

    def add(self, stamp: int, quaternion: Quaternion, translation: Translation) -> None:
        """Keep a transform; one that is far older than the others replaces them: a new clock."""
        stamps = self._stamps
        if stamps and stamp < stamps[-1] - _KEPT_TIME:
            stamps.clear()
            self._moves.clear()
        at = bisect_left(stamps, stamp)
        if at < len(stamps) and stamps[at] == stamp:
            self._moves[at] = quaternion, translation
            return
        stamps.insert(at, stamp)
        self._moves.insert(at, (quaternion, translation))
        old = max(bisect_left(stamps, stamps[-1] - _KEPT_TIME), len(stamps) - _MAX_KEPT)
        del stamps[:old], self._moves[:old]

    def at(self, stamp: int) -> Transform:
        """Return the transform at a time in ns, between two kept ones; 0: the newest."""
        stamps = self._stamps
        if not stamp or not stamps[-1]:  # a static transform has the stamp 0 here
            return _to_transform(*self._moves[-1])
        later = bisect_left(stamps, stamp)
        if later == len(stamps):
            return _to_transform(*self._moves[-1], gap=1e-9 * (stamp - stamps[-1]))
        if later == 0:
            return _to_transform(*self._moves[0], gap=1e-9 * (stamps[0] - stamp))
        share = (stamp - stamps[later - 1]) / (stamps[later] - stamps[later - 1])
        (q0, t0), (q1, t1) = self._moves[later - 1 : later + 1]
        t = tuple(a + share * (b - a) for a, b in zip(t0, t1, strict=True))
        return Transform(rotation_from_quaternion(_between(q0, q1, share)), np.array(t))


class FrameTree:
    """The last transforms of each frame to its parent."""

    def __init__(self) -> None:
        """Start without frames."""
        self._frames: dict[str, _Frame] = {}

    def add(
        self,
        parent: str,
        child: str,
        quaternion: Quaternion,
        translation: Translation = (0.0, 0.0, 0.0),
        stamp: int = 0,
    ) -> None:
        """Take a transform.

        Args:
            parent: frame of the header.
            child: frame of the child.
            quaternion: x, y, z, w of the child's axes in those of the parent; one that is not
                finite, or 0, is not taken.
            translation: of the child's origin in the parent's axes; the same holds.
            stamp: in ns; 0: it holds at any time, as those of /tf_static.
        """
        finite = all(map(math.isfinite, (*quaternion, *translation)))
        if not finite or _dot(quaternion, quaternion) <= _SHORTEST:
            return
        child, parent = child.lstrip("/"), parent.lstrip("/")
        frame = self._frames.get(child)
        if frame is None and len(self._frames) >= _MAX_FRAMES:
            return
        if frame is None or frame.parent != parent:
            frame = self._frames[child] = _Frame(parent)
        frame.add(stamp, quaternion, translation)

    def rotation(self, target: str, source: str, stamp: int = 0) -> NDArray[Any] | None:
        """Return R (3, 3) with v_target = R v_source; None: the frames are not connected."""
        found = self.transform(target, source, stamp)
        return None if found is None else found.rotation

    def transform(self, target: str, source: str, stamp: int = 0) -> Transform | None:
        """Return the transform between two frames; None: not connected.

        Args:
            target: frame to transform to.
            source: frame to transform from.
            stamp: time in ns; outside the kept 5 s the nearest transforms are taken; 0: the newest.
        """
        to_root, roots, gap = [], [], 0.0
        for name in (target.lstrip("/"), source.lstrip("/")):
            R, t = np.eye(3), np.zeros(3)
            for _ in range(_MAX_DEPTH):
                frame = self._frames.get(name)
                if frame is None:
                    break
                step = frame.at(stamp)
                R, t = step.rotation @ R, step.rotation @ t + step.translation
                name, gap = frame.parent, max(gap, step.gap)
            to_root.append((R, t))
            roots.append(name)
        if roots[0] != roots[1]:
            return None
        (R0, t0), (R1, t1) = to_root
        return Transform(R0.T @ R1, R0.T @ (t1 - t0), gap)


def _to_transform(quaternion: Quaternion, translation: Translation, gap: float = 0.0) -> Transform:
    """Return a kept transform as matrix and vector."""
    return Transform(_rotation(quaternion), np.array(translation), gap)


@lru_cache(256)
def _rotation(quaternion: Quaternion) -> NDArray[Any]:
    """Return the rotation (3, 3) of a quaternion, read-only: static ones are asked for often."""
    R = rotation_from_quaternion(np.array(quaternion, np.float64))
    R.flags.writeable = False
    return R


def _between(q0: Quaternion, q1: Quaternion, share: float) -> NDArray[Any]:
    """Return the quaternion (4,) at a share of the shorter way from one to another: slerp."""
    a, b = (np.array(q) / math.sqrt(_dot(q, q)) for q in (q0, q1))
    cosine = float(a @ b)
    b, cosine = (-b, -cosine) if cosine < 0 else (b, cosine)
    if cosine > _ALIGNED:
        return np.asarray(a + share * (b - a))
    angle = math.acos(cosine)
    return np.asarray(math.sin((1 - share) * angle) * a + math.sin(share * angle) * b)


def _dot(a: Quaternion, b: Quaternion) -> float:
    """Return the inner product of two quaternions."""
    return sum(x * y for x, y in zip(a, b, strict=True))
