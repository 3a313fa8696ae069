# SPDX-License-Identifier: Apache-2.0
"""Frames of a dataset that a training does not use: they tell how good its model is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from deep_nrsfm_ros.data.dataset import Dataset

BLOCKS = 4
"""Blocks of consecutive frames whose ends are held out, so that several views have a say."""
MIN_HELD_OUT = 20
"""Frames below which nothing is held out: the judge then uses the frames of the training."""


class Split(NamedTuple):
    """The frames of a dataset, shared out.

    Attributes:
        training: frames to train on.
        held_out: frames for the judge; those of the training where there are too few.
    """

    training: Dataset
    held_out: Dataset


def split(dataset: Dataset, share: float) -> Split:
    """Return the dataset without the last frames of each of its blocks, and those frames.

    Args:
        dataset: frames in the order of their time.
        share: of the frames to hold out, 0 to 0.5; 0.1 typical.
    """
    n = len(dataset)
    if share * n < MIN_HELD_OUT:
        return Split(dataset, dataset)
    place = np.arange(n) * BLOCKS / n % 1
    last = place >= 1 - share - 1e-9  # rounding must not take a frame
    return Split(dataset[np.flatnonzero(~last)], dataset[np.flatnonzero(last)])
