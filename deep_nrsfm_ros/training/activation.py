# SPDX-License-Identifier: Apache-2.0
"""Whether a lifter switches by itself to the model that it has trained (`train.activate`)."""

from __future__ import annotations

from deep_nrsfm_ros.messages.options import MODEL_ORDER
from deep_nrsfm_ros.model_files.matching_model import knows
from deep_nrsfm_ros.model_files.model_file import Model


def switch_commands(lifter: str, name: str, *, other_object: bool) -> list[str]:
    """Return the commands that have a running lifter take a model, in order.

    Args:
        lifter: name of the node.
        name: of the model.
        other_object: whether the lifter may have the keypoints of another object, named by its
            keypoint_layout, with which it refuses the model.
    """
    values = ([("keypoint_layout", MODEL_ORDER)] if other_object else []) + [("model", name)]
    return [f"ros2 param set {lifter} {parameter} {value}" for parameter, value in values]


def reason_to_stay(new: Model, present: Model) -> str:
    """Return why a lifter does not switch to a model that is not doubtful; "" if it should.

    Nobody has said that the lifter should lift another object from now on, and no figure without
    labels tells whether depth is mirrored as a whole.

    Args:
        new: the model that was trained.
        present: the one that the lifter has.
    """
    reasons = []
    if not knows(new.layout, present.layout):
        reasons.append(
            f"it is a model of {new.layout.name!r}, and the lifter lifts {present.layout.name!r}"
        )
    if not new.layout.handedness and "from" not in new.provenance:  # a start passes its own on
        reasons.append(
            f"layout {new.layout.name!r} names no handedness, so depth may be mirrored as a whole: "
            "look at the shapes in the report first, and set mirrored where they are mirror images"
        )
    return "; ".join(reasons)
