# SPDX-License-Identifier: Apache-2.0
"""Options of the input: model, topics, layout and image size of keypoint messages."""

from __future__ import annotations

from dataclasses import dataclass

from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.messages.decoding import INPUT_TYPES
from deep_nrsfm_ros.messages.field_mapping import Size
from deep_nrsfm_ros.model_files.folders import default_bags_dir, default_models_dir

MODEL_ORDER = "model"
"""Value of `keypoint_layout` for keypoints in the order of the model's layout."""
AUTO = "auto"
"""Value of `input_type` for the type of the first publisher, and of `keypoint_layout` for the
layout that the input names or that fits best."""


@dataclass(frozen=True)
@described
class InputOptions:
    """Model and input of the lifter."""

    model: str = option("human", "model to lift with: a name in the model folders, or a path")
    models_dir: str = option(
        str(default_models_dir()),
        "folder of trained models; it is searched before the models of the package",
        read_only=True,
    )
    bags_dir: str = option(
        str(default_bags_dir()),
        "folder that holds all bags that train.bags may name; relative names begin here",
        read_only=True,
    )
    input_type: str = option(
        AUTO,
        f"type of the keypoint messages: one of {', '.join(INPUT_TYPES)}; the path of a field "
        "mapping for any other type; or 'auto' for the type of the first publisher",
        read_only=True,
    )
    topics: tuple[str, ...] = option(
        (),
        "topics with keypoints; '*' stands for one part of a topic name, which becomes the "
        "identity of the objects on it, as in /humans/bodies/*/skeleton2d; empty = keypoints",
        read_only=True,
    )
    image_width: int = option(
        0,
        "width in pixels of the image in which the keypoints were detected, not resized or cut: "
        "normalised keypoints (0 to 1) are multiplied by it, field_of_view needs it, and keypoints "
        "at the border of the image or outside count as missing; 0 = unknown, 640 typical",
        low=0,
        high=1000000,
    )
    image_height: int = option(
        0,
        "height in pixels of the image in which the keypoints were detected, as image_width; 0 = "
        "unknown, 480 typical",
        low=0,
        high=1000000,
    )
    keypoint_layout: str = option(
        AUTO,
        "order of the detector's keypoints: a preset such as coco17, the path of a layout file, "
        "'model' for the order of the model's layout, or 'auto' for the layout that the input "
        "implies, or else the one of that number of keypoints that fits clearly best",
    )
    max_objects: int = option(
        100,
        "largest number of objects in a message; a message with more is rejected, so that it does "
        "not block the lifter for seconds; 100 typical",
        low=1,
        high=100_000,
    )
    min_confidence: float = option(
        0.1,
        "detector confidence below which a keypoint is missing; 0 = every keypoint with a positive "
        "confidence is used, 0.1 typical, 0.5 strict",
        low=0,
        high=1,
    )
    min_score: float = option(
        0.0,
        "score of an object below which it is left out, in the detector's own scale; 0 = keep all, "
        "0.3 typical",
        low=0,
    )

    @property
    def image_size(self) -> Size | None:
        """Width and height of the image in pixels, None if they are unknown."""
        known = self.image_width and self.image_height
        return (self.image_width, self.image_height) if known else None
