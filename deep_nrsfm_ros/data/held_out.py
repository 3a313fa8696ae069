# SPDX-License-Identifier: Apache-2.0
"""Frames of a dataset that a training does not use: they tell how good its model is.

They are later than the frames of the training, with a gap between the two. Frames at random would
each have neighbours in the training that look alike.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.dataset import Dataset

BLOCKS = 4
"""Blocks of consecutive frames that stand for sequences where none are known."""
GAP = 0.5
"""Frames left out before the held-out ones, as a share of these."""
MIN_HELD_OUT = 20
"""Frames below which nothing is held out: the judge then uses the frames of the training."""
MIN_HELD_OUT_ALONE = 50
"""The same where there is no model to compare with: an object without one needs its few frames.

docs/devlog/training.md has the errors with and without them.
"""


class Split(NamedTuple):
    """The frames of a dataset, shared out.

    Attributes:
        training: frames to train on.
        held_out: frames for the judge; those of the training where there are too few.
    """

    training: Dataset
    held_out: Dataset


def split(dataset: Dataset, share: float, fewest: int = MIN_HELD_OUT) -> Split:
    """Return the dataset without the last frames of each of its sequences, and those frames.

    Where the sequences are unknown, or too short to give enough frames, each quarter of the dataset
    stands for one. The frames of the gap are in neither part.

    Args:
        dataset: frames of each sequence in the order of their time.
        share: of the frames to hold out, 0 to 0.5; 0.1 typical.
        fewest: frames below which nothing is held out.
    """
    n = len(dataset)
    if share * n < fewest:
        return Split(dataset, dataset)
    place = _places(dataset.sequence_starts, n)
    if (place >= _begin(share)).sum() < max(MIN_HELD_OUT, share * n / 2):
        place = np.arange(n) * BLOCKS / n % 1
    first = _begin((1 + GAP) * share)
    return Split(
        dataset[np.flatnonzero(place < first)], dataset[np.flatnonzero(place >= _begin(share))]
    )


def _begin(share: float) -> float:
    """Return the place at which the last `share` begins; rounding must not take a frame."""
    return 1 - share - 1e-9


def _places(starts: NDArray[np.int64], n: int) -> NDArray[np.float64]:
    """Return the place (n,) of each frame in its sequence, 0 to 1; 0 where there are none."""
    if not len(starts):
        return np.zeros(n)
    lengths = np.diff(starts, append=n)
    in_sequence = np.arange(n) - np.repeat(starts, lengths)
    places: NDArray[np.float64] = in_sequence / np.repeat(lengths, lengths)
    return places
