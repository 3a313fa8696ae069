# SPDX-License-Identifier: Apache-2.0
"""Whether the shapes that a trained model lifts have one handedness, by the layout's keypoints."""

from __future__ import annotations

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.lifted_sample import lift_sample
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.handedness import disagreement


def handedness_warning(model: Model, dataset: Dataset) -> str:
    """Return a warning if keypoints of lifted frames disagree on the depth, "" if they agree.

    See `nrsfm.handedness.disagreement`.
    """
    try:
        frames, lifted = lift_sample(model, dataset)
    except ValueError:
        return ""  # no frame is lifted: without a lifted frame there is no depth
    return disagreement(lifted.shapes, model.layout, dataset.visible[frames])
