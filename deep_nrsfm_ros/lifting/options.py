# SPDX-License-Identifier: Apache-2.0
"""Options of the lifter: command line, ROS parameters and Python take them from here."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.body.person_height import trunk_length
from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.layouts.layout import TRUNK, KeypointLayout
from deep_nrsfm_ros.lifting.intrinsics import MAX_FIELD_OF_VIEW, Intrinsics, check_field_of_view


@dataclass(frozen=True)
@described
class LiftingOptions:
    """Lifting."""

    correction: str = option(
        "bones",
        "how the lifted shape is corrected by the keypoints, depth included: bones = by the error "
        "covariance that the model has learned and by the lengths of bones (most accurate); "
        "learned = by the error covariance alone; back_projection = within the image plane; none",
        choices=("bones", "learned", "back_projection", "none"),
    )
    noise: float = option(
        0.02,
        "standard deviation of the keypoints, relative to the size of the object in the image: how "
        "far the corrected shape may stay from them; 0 = meets them exactly and amplifies their "
        "noise, 0.02 typical, 0.1 strong",
        low=0.0,
        high=1.0,
    )
    refill: int = option(
        2,
        "rounds in which missing keypoints are filled with those of the lifted shape and the "
        "object is lifted again; 0 = off, 2 typical; each round takes as long as the first lift, "
        "and messages without missing keypoints need none",
        low=0,
        high=50,
    )
    test_time_rotations: int = option(
        3,
        "in-plane rotations of the input, lifted and averaged by reprojection error (test-time "
        "augmentation); 1 = off, 3 typical; time rises with the number",
        low=1,
        high=64,
    )
    test_time_mirror: bool = option(
        False,
        "whether the mirror image is lifted and averaged as well: slightly more accurate on "
        "average, at twice the time and with an occasional mirrored frame; needs a layout with "
        "handedness and with pairs of left and right keypoints",
    )
    mirrored: bool = option(
        False,
        "whether the objects are mirror images of the model's object: a left hand and a model of "
        "right hands; the keypoints are mirrored, lifted, and mirrored back",
    )
    min_visible: int = option(
        4,
        "fewest detected keypoints with which an object is lifted; a keypoint that follows from "
        "others does not count, as a neck between two visible shoulders, nor does one whose "
        "confidence is far below that of the others; at most as many as the model has, 4 typical",
        low=3,
        high=1000,
    )
    leave_out_wrong: bool = option(
        True,
        "whether a keypoint at a wrong place is taken as missing: one without which the network "
        "fits the others much better, and which is far from where they say that it should be; at "
        "least 8 detected keypoints must be left, and at most 3 of an object are left out",
    )
    reference_length: float = option(
        0.0,
        "length in the output of the layout's reference pair (of people: neck to mid-hip), or of "
        "the RMS radius if the layout has no pair; 0 = that of person_height, or the length in "
        "metres from the model's layout, 0.5 of people (human25), or 1 if it has none",
        low=0.0,
        high=1e6,
    )
    person_height: float = option(
        0.0,
        "height of the people who are lifted, in metres; sets reference_length (neck to mid-hip) "
        "to 2/7 of it, unless that is set; 0 = unknown, 1.75 typical",
        low=0.0,
        high=100.0,
    )

    def length_for(self, layout: KeypointLayout) -> float:
        """Return the length of a layout's reference pair in the output; 1 if nothing says it."""
        if self.reference_length:
            return self.reference_length
        if self.person_height and layout.reference == TRUNK:
            return trunk_length(self.person_height)
        return layout.reference_length or 1.0

    def unused_height(self, layout: KeypointLayout) -> str:
        """Return why `person_height` has no effect with a layout; "" if it has one, or is 0."""
        if not self.person_height:
            return ""
        if self.reference_length:
            return f"reference_length is {self.reference_length:g}"
        if layout.reference != TRUNK:
            return (
                f"the reference of the model's layout {layout.name!r} is not {TRUNK[0]} to "
                f"{TRUNK[1]}: set reference_length"
            )
        return ""


@dataclass(frozen=True)
@described
class FieldOfViewOptions:
    """Field of view."""

    field_of_view: float = option(
        0.0,
        "horizontal angle of view in degrees (of the width of the whole image, upright or not) of "
        "a camera that is not calibrated: with the size of the image (image_width, image_height) "
        "it takes the place of a CameraInfo, so that objects are lifted to their places in the "
        "optical frame; 0 = unknown, else at least 10, 60 to 70 typical of webcams and of phones "
        "held sideways, 40 to 50 of phones held upright, 90 wide; a diagonal of 78 in a data sheet "
        "is 70 here, at 16:9; if it is wrong, distances are off in proportion to the focal length, "
        "rotations by a few degrees",
        low=0.0,
        high=MAX_FIELD_OF_VIEW,
        read_only=True,
    )

    def intrinsics(self, image_size: tuple[int, int] | None) -> Intrinsics | None:
        """Return the camera of an image of that width and height in pixels; None: unknown.

        Raises:
            ValueError: the field of view is known, and the size of the image is not; or nobody
                has such a field of view.
        """
        if not self.field_of_view:
            return None
        check_field_of_view(self.field_of_view)
        if image_size is None:
            raise ValueError(
                f"field_of_view is {self.field_of_view:g} and needs the size of the image: set "
                "image_width and image_height"
            )
        return Intrinsics.from_field_of_view(self.field_of_view, image_size)


@dataclass(frozen=True)
@described
class HistoryOptions:
    """Lifting over time."""

    enabled: bool = option(
        True,
        "whether an object is lifted with what its last frames have shown: the shape and the "
        "rotation that the network finds are smoothed before the keypoints correct them, which has "
        "no lag in the image, and the lengths of its bones are learned. An answer depends on the "
        "object's last seconds; false: on its own message alone",
    )
    shape_time: float = option(
        0.1,
        "time constant in s with which the shape that the network finds is smoothed before the "
        "correction; 0 = off, 0.1 typical, 0.3 strong",
        low=0.0,
        high=10.0,
    )
    hidden_time: float = option(
        1.0,
        "time constant in s with which the remembered place of a missing keypoint, relative to the "
        "object, gives way to the lifted one; 0 = off, 1 typical",
        low=0.0,
        high=10.0,
    )
    rotation_time: float = option(
        0.05,
        "time constant in s with which the rotation that the network finds is smoothed before the "
        "correction; 0 = off, 0.05 typical, 0.2 strong",
        low=0.0,
        high=10.0,
    )
    bones_time: float = option(
        1.0,
        "seconds of sight after which the lengths of an object's bones count as much as those of "
        "the model; 0 = bone lengths are not learned, 1 typical, 3 slow",
        low=0.0,
        high=60.0,
    )
    depth_cutoff: float = option(
        0.5,
        "cutoff frequency in Hz with which the depths of an object at rest are smoothed after the "
        "correction (One-Euro filter; it rises with the object's speed); each point stays where "
        "the image has it, so nothing lags there; 0 = off, 0.5 typical, 2 weak",
        low=0.0,
        high=1000.0,
    )


@dataclass(frozen=True)
@described
class GravityOptions:
    """Gravity."""

    up: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0),
        "direction against gravity in the camera's optical frame, x right, y down, z forward, of "
        "any length: an object whose layout names top and bottom is lifted as upright as the image "
        "allows; 0 -1 0 = a level camera, 0 -0.94 -0.34 = one that looks down by 20 degrees; a "
        "wrong direction is worse than none; 0 0 0 = unknown",
    )

    def __post_init__(self) -> None:
        """Raise ValueError unless `up` is three finite numbers."""
        if len(self.up) != 3 or not all(math.isfinite(x) for x in self.up):
            raise ValueError(
                f"up is {list(self.up)}; it must be three finite numbers, as in 0 -1 0"
            )

    @property
    def direction(self) -> NDArray[np.float64] | None:
        """The unit vector (3,) against gravity; None: unknown."""
        return unit_vector(np.array(self.up)) if any(self.up) else None


def unit_vector(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a direction (3,), finite and not 0, with length 1."""
    scaled = direction / np.abs(direction).max()  # the squares of very long ones are infinite
    return np.asarray(scaled / np.linalg.norm(scaled))
