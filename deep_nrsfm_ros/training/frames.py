"""The frames of a training in memory: all of them once, and copies of a batch at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.nrsfm.losses import Batch


@dataclass(frozen=True)
class FrameStore:
    """The frames to train on, where and as they were given."""

    points: Tensor  # (f, p, 2), anything where not visible
    visible: Tensor  # (f, p) bool
    usable: Tensor  # (u,) which to train on

    @classmethod
    def of(cls, points: NDArray[np.float32], visible: NDArray[np.bool_]) -> FrameStore:
        """Return all of points (f, p, 2) with visibility (f, p); they are not copied."""
        W = torch.from_numpy(np.require(points, np.float32, ["C", "W"]))
        mask = torch.from_numpy(np.require(visible, np.bool_, ["C", "W"]))
        return cls(W, mask, torch.arange(len(points)))

    def __len__(self) -> int:
        """Return how many are usable."""
        return len(self.usable)

    @property
    def device(self) -> torch.device:
        """Return where the frames are."""
        return self.points.device

    def to(self, device: torch.device) -> FrameStore:
        """Return the pool on a device; another one than its own gets copies of what is usable."""
        if device == self.device:
            return self
        points, visible = (tensor[self.usable].to(device) for tensor in (self.points, self.visible))
        return FrameStore(points, visible, torch.arange(len(self), device=device))

    def batch(self, which: Tensor | slice) -> Batch:
        """Return the chosen of the usable frames, 0 where a point is missing."""
        frames = self.usable[which]
        visible = self.visible[frames][..., None]
        return Batch(self.points[frames].where(visible, 0.0), visible.float())

    def blocks(self) -> Iterator[Batch]:
        """Return all usable frames, some at a time."""
        return map(self.batch, slices(len(self)))
