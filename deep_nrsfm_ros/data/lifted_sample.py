# SPDX-License-Identifier: Apache-2.0
"""A sample of the frames of a dataset, lifted by a model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter, lift_all
from deep_nrsfm_ros.model_files.model_file import Model

_SAMPLE = 500  # frames that are lifted


class LiftedFrames(NamedTuple):
    """The n frames of a sample that a model lifts.

    Attributes:
        frames: (n,) indices into the dataset.
        lifted: n objects.
    """

    frames: NDArray[np.int64]
    lifted: Lifted


def lift_sample(model: Model, dataset: Dataset, most: int = _SAMPLE) -> LiftedFrames:
    """Return up to `most` evenly spread frames of a dataset, lifted.

    Raises:
        ValueError: the model lifts none of them.
    """
    frames = np.unique(np.linspace(0, len(dataset) - 1, min(most, len(dataset))).astype(int))
    chosen = dataset[frames]
    lifted = lift_all(Lifter(model).lift, chosen.points, chosen.visible.astype(np.float32))
    sound = np.isfinite(lifted.shapes).all((1, 2)) & np.isfinite(lifted.residual)
    if not sound.any():
        raise ValueError(f"model {model.name!r} lifts none of the {len(frames)} frames looked at")
    return LiftedFrames(frames[sound], lifted.at(sound))
