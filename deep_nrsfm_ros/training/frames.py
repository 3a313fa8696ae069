# SPDX-License-Identifier: Apache-2.0
"""The frames of a training in memory, and batches of them."""

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
    """The frames to train on; they stay in the caller's arrays.

    Attributes:
        points: (f, p, 2) keypoints, any value where not visible.
        visible: (f, p) bool.
        usable: (u,) indices of the frames to train on.
    """

    points: Tensor
    visible: Tensor
    usable: Tensor

    @classmethod
    def of(cls, points: NDArray[np.float32], visible: NDArray[np.bool_]) -> FrameStore:
        """Return the store of points (f, p, 2) and visibility (f, p), all usable, not copied."""
        W = torch.from_numpy(np.require(points, np.float32, ["C", "W"]))
        mask = torch.from_numpy(np.require(visible, np.bool_, ["C", "W"]))
        return cls(W, mask, torch.arange(len(points)))

    def __len__(self) -> int:
        """Return the number of usable frames."""
        return len(self.usable)

    @property
    def device(self) -> torch.device:
        """Return the device of the frames."""
        return self.points.device

    def to(self, device: torch.device) -> FrameStore:
        """Return the store on a device; on another one it holds copies of the usable frames."""
        if device == self.device:
            return self
        points, visible = (tensor[self.usable].to(device) for tensor in (self.points, self.visible))
        return FrameStore(points, visible, torch.arange(len(self), device=device))

    def batch(self, indices: Tensor | slice) -> Batch:
        """Return the usable frames of these indices, with 0 where a point is missing."""
        frames = self.usable[indices]
        visible = self.visible[frames][..., None]
        return Batch(self.points[frames].where(visible, 0.0), visible.float())

    def batches(self) -> Iterator[Batch]:
        """Return all usable frames in batches of `batched.slices`."""
        return map(self.batch, slices(len(self)))
