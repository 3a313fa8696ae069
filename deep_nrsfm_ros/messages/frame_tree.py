"""Transforms between the frames of /tf, without tf2, which PyPI lacks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.geometry import rotation_from_quaternion

_MAX_FRAMES = 1000  # objects have frames of their own, which come and go
_MAX_DEPTH = 100  # of a chain of frames: a loop ends


class FrameTree:
    """The newest transform of each frame to its parent."""

    def __init__(self) -> None:
        """Start without frames."""
        self._parents: dict[str, tuple[str, NDArray[Any], NDArray[Any]]] = {}

    def add(
        self,
        parent: str,
        child: str,
        quaternion: tuple[float, float, float, float],
        translation: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Take a transform.

        Args:
            parent: frame of the header.
            child: frame of the child.
            quaternion: x, y, z, w of the child's axes in those of the parent; one that is not
                finite, or 0, is not taken.
            translation: of the child's origin in the parent's axes; the same holds.
        """
        q, t = np.array(quaternion, np.float64), np.array(translation, np.float64)
        if not (np.isfinite(q).all() and np.isfinite(t).all() and (q * q).sum() > 1e-12):
            return
        child, parent = child.lstrip("/"), parent.lstrip("/")
        if child in self._parents or len(self._parents) < _MAX_FRAMES:
            self._parents[child] = parent, rotation_from_quaternion(q), t

    def rotation(self, target: str, source: str) -> NDArray[Any] | None:
        """Return R (3, 3) with v_target = R v_source; None: the frames are not connected."""
        found = self.transform(target, source)
        return None if found is None else found[0]

    def transform(self, target: str, source: str) -> tuple[NDArray[Any], NDArray[Any]] | None:
        """Return R (3, 3) and t (3,) with p_target = R p_source + t; None: not connected."""
        to_root, roots = [], []
        for frame in (target.lstrip("/"), source.lstrip("/")):
            R, t = np.eye(3), np.zeros(3)
            for _ in range(_MAX_DEPTH):
                if frame not in self._parents:
                    break
                frame, step, shift = self._parents[frame]
                R, t = step @ R, step @ t + shift
            to_root.append((R, t))
            roots.append(frame)
        if roots[0] != roots[1]:
            return None
        (R0, t0), (R1, t1) = to_root
        return R0.T @ R1, R0.T @ (t1 - t0)
