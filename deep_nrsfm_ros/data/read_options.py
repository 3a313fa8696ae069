# SPDX-License-Identifier: Apache-2.0
"""How keypoints are found and read in bags and files."""

from __future__ import annotations

from dataclasses import dataclass

from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.messages.field_mapping import FieldMapping, Size

DEFAULT_RATE = 30.0
"""Frames per second of input without times."""


@dataclass(frozen=True)
@described
class ReadOptions:
    """Reading of keypoints.

    Fields with a description are options of the command line; the others are set by the caller.

    Attributes:
        min_confidence: keypoints with a confidence below it are missing; 0 = keep all, 0.3 typical.
        mapping: says how messages of a type are read that the package does not support by itself.
        image_size: width and height in pixels, needed for normalised keypoints.
        max_frames: more frames than this in the bags are an error; None = no limit.
        layout: layout that the user names; an input that names other keypoints is an error. None
            = the input says it.
        fallback: layout of an input that names none itself, e.g. that of the model; None = such
            an input is read with as many keypoints as it has.
        target: layout to which the keypoints are mapped by name; what an input calls as it does,
            in any spelling, is that keypoint. None = unknown.
    """

    topic: str = option(
        "",
        "topic with keypoints in a bag, or several by a '*'; empty = the only topic with keypoints",
    )
    min_confidence: float = 0.0
    mapping: FieldMapping | None = None
    image_size: Size | None = None
    rate: float | None = option(
        None,
        f"frames per second of input without times; none = {DEFAULT_RATE:g}",
        low=1e-3,
        high=1e6,
    )
    max_frames: int | None = None
    layout: KeypointLayout | None = None
    fallback: KeypointLayout | None = None
    target: KeypointLayout | None = None
    missing_value: float | None = option(
        None,
        "x and y of a missing keypoint, besides NaN and (0, 0); none = no other, -1 typical",
    )
    min_score: float = option(
        0.0,
        "score of an object below which it is left out, in the detector's own scale; 0 = keep all, "
        "0.3 typical",
        low=0,
    )
    category: str = option(
        "",
        "name or number of the category to read from a COCO file; empty = the only category with "
        "keypoints",
    )

    def owners(self) -> list[KeypointLayout]:
        """Return the layouts whose names an input may use, the one that is mapped to first."""
        return [each for each in (self.target, self.layout, self.fallback) if each]


DEFAULT_READ_OPTIONS = ReadOptions()
