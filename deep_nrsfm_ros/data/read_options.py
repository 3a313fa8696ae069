"""How keypoints are found and read in bags and files."""

from __future__ import annotations

from dataclasses import dataclass

from deep_nrsfm_ros.messages.field_mapping import FieldMapping, Size


@dataclass(frozen=True)
class ReadOptions:
    """How keypoints are found and read in bags and files; the defaults suit most of them.

    Attributes:
        topic: topic in a bag, or several by a `*` (see `messages.topics.match`); "" = the only
            topic with keypoints.
        min_confidence: keypoints with a confidence below it are missing; 0 = keep all, 0.3 typical.
        mapping: says how messages of a type are read that the package does not support by itself.
        image_size: width and height in pixels, needed for normalised keypoints.
        rate: frames per second of files without stamps.
        max_frames: more frames than this in the bags are an error; None = no limit.
    """

    topic: str = ""
    min_confidence: float = 0.0
    mapping: FieldMapping | None = None
    image_size: Size | None = None
    rate: float = 30.0
    max_frames: int | None = None


DEFAULT_READ_OPTIONS = ReadOptions()
