"""The classic methods that the paper compares with, written from their papers' equations.

Each takes W (f, p, 2), one orthographic image a frame, centred on its points, and returns
S (f, p, 3) in one object frame for all frames. An orthographic image does not determine the
sign of depth, so the result is up to one reflection of all frames. Cameras are rotations without a
scale. No method uses the order of the frames.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines.block_matrix import block_matrix
from benchmarks.baselines.em_ppca import em_ppca
from benchmarks.baselines.rigid import rigid

__all__ = ["BATCH", "Method", "block_matrix", "em_ppca", "in_batches", "rigid"]

Floats = NDArray[Any]
Method = Callable[[Floats], Floats]

BATCH = 500
"""Frames per run, as in the paper; no baseline scales to a whole subject."""


def in_batches(
    method: Method, W: Floats, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.int64]]:
    """Run `method` on shuffled batches of about `BATCH` frames of W (f, p, 2).

    Returns the shapes (f, p, 3) and the frames (f,) that they belong to, both in the order of
    the batches, which are those of `numpy.array_split`. Each batch has an object frame and a
    reflection of its own.
    """
    frames = rng.permutation(len(W))
    batches = np.array_split(frames, max(1, round(len(W) / BATCH)))
    return np.concatenate([method(W[batch]) for batch in batches]), frames
