# SPDX-License-Identifier: Apache-2.0
"""Whether the shapes that a trained model lifts have one handedness, by the layout's keypoints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.lifted_sample import lift_sample
from deep_nrsfm_ros.data.sufficiency import how_to_learn_depth
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.geometry import Floats
from deep_nrsfm_ros.nrsfm.handedness import front_shares


def handedness_warning(model: Model, dataset: Dataset) -> str:
    """Return a warning if keypoints of lifted frames disagree on the depth, "" if they agree."""
    try:
        frames, lifted = lift_sample(model, dataset)
    except ValueError:
        return ""  # no frame is lifted: without a lifted frame there is no depth
    return disagreement(lifted.shapes, model.layout, dataset.visible[frames])


def disagreement(
    S: Floats, layout: KeypointLayout, visible: NDArray[np.bool_] | None = None
) -> str:
    """Return a warning if the fronts of the layout are behind in most of the shapes, else "".

    Args:
        S: (f, p, 3) shapes as a model lifts them, in any unit.
        layout: the layout of the shapes; without a handedness there is no warning.
        visible: (f, p) visible keypoints; None: all.
    """
    shares = front_shares(S, layout, visible)
    if all(share >= 0.5 for _, share in shares):
        return ""
    listing = ", ".join(f"{front} in {100 * share:.0f} %" for front, share in shares)
    return (
        f"the keypoints disagree on where the front is, so that depth is wrong in part ({listing} "
        f"of the frames where it belongs); {how_to_learn_depth()}"
    )
