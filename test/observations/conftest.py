"""Messages of detectors whose packages are on no registry, by their own definitions."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

DEFINITIONS = {
    # yolo_ros 4.6
    "yolo_msgs/msg/Point2D": "float64 x\nfloat64 y",
    "yolo_msgs/msg/Vector2": "float64 x\nfloat64 y",
    "yolo_msgs/msg/Pose2D": "yolo_msgs/Point2D position\nfloat64 theta",
    "yolo_msgs/msg/BoundingBox2D": "yolo_msgs/Pose2D center\nyolo_msgs/Vector2 size",
    "yolo_msgs/msg/BoundingBox3D": (
        "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\nstring frame_id"
    ),
    "yolo_msgs/msg/Mask": "int32 height\nint32 width\nyolo_msgs/Point2D[] data",
    "yolo_msgs/msg/KeyPoint2D": "int32 id\nyolo_msgs/Point2D point\nfloat64 score",
    "yolo_msgs/msg/KeyPoint2DArray": "yolo_msgs/KeyPoint2D[] data",
    "yolo_msgs/msg/KeyPoint3D": "int32 id\ngeometry_msgs/Point point\nfloat64 score",
    "yolo_msgs/msg/KeyPoint3DArray": "yolo_msgs/KeyPoint3D[] data\nstring frame_id",
    "yolo_msgs/msg/Detection": (
        "int32 class_id\nstring class_name\nfloat64 score\nstring id\n"
        "yolo_msgs/BoundingBox2D bbox\nyolo_msgs/BoundingBox3D bbox3d\nyolo_msgs/Mask mask\n"
        "yolo_msgs/KeyPoint2DArray keypoints\n"
        "yolo_msgs/KeyPoint3DArray keypoints3d"
    ),
    "yolo_msgs/msg/DetectionArray": "std_msgs/Header header\nyolo_msgs/Detection[] detections",
    # hri_msgs, REP-155
    "hri_msgs/msg/NormalizedPointOfInterest2D": "float32 x\nfloat32 y\nfloat32 c",
    "hri_msgs/msg/Skeleton2D": (
        "std_msgs/Header header\nuint8 NOSE = 0\nuint8 NECK = 1\nuint8 LEFT_EYE = 14\n"
        "hri_msgs/NormalizedPointOfInterest2D[18] skeleton"
    ),
    # one that is known nowhere
    "my_msgs/msg/Joint": "string label\nmy_msgs/Place place",
    "my_msgs/msg/Place": "float32 u\nfloat32 v",
    "my_msgs/msg/Animal": "uint8 number\nmy_msgs/Joint[] joints",
    "my_msgs/msg/Animals": "my_msgs/Animal[] found",
}


class Detectors:
    """Makes messages of the real definitions, or stand-ins with the same fields."""

    def __init__(self, real: bool) -> None:
        self.store: Typestore = get_typestore(Stores.ROS2_JAZZY)
        for name, text in DEFINITIONS.items():
            self.store.register(get_types_from_msg(text, name))
        self._real = real

    def make(self, kind: str, **fields: Any) -> Any:
        """Return a message with some of its fields set."""
        if not self._real:
            return SimpleNamespace(**fields)
        name = kind.replace("/", "/msg/")
        given = {}
        for field, (node, detail) in self.store.get_msgdef(name).fields:
            given[field] = fields[field] if field in fields else self._empty(node, detail)
        return self.store.types[name](**given)

    def _empty(self, node: Any, detail: Any) -> Any:
        """Return what a message has in a field that nobody has set."""
        if node.name == "BASE":
            kind = detail[0]
            return "" if kind == "string" else 0 if "int" in kind else 0.0
        if node.name == "NAME":
            return Detectors.make(self, detail.replace("/msg/", "/"))
        return []

    def detections(self, people: list[dict[str, Any]]) -> Any:
        """Return a DetectionArray: people as {"id", "points" (q, 3), "seen" (places)}."""
        found = []
        for person in people:
            data = [
                self.make(
                    "yolo_msgs/KeyPoint2D",
                    id=place + 1,
                    point=self.make("yolo_msgs/Point2D", x=float(x), y=float(y)),
                    score=float(score),
                )
                for place, (x, y, score) in enumerate(person["points"])
                if place in person["seen"]
            ]
            keypoints = self.make("yolo_msgs/KeyPoint2DArray", data=data)
            found.append(self.make("yolo_msgs/Detection", id=person["id"], keypoints=keypoints))
        return self.make("yolo_msgs/DetectionArray", detections=found)

    def skeleton(self, points: np.ndarray) -> Any:
        """Return a Skeleton2D of points (18, 3)."""
        kind = "hri_msgs/NormalizedPointOfInterest2D"
        return self.make(
            "hri_msgs/Skeleton2D",
            skeleton=[self.make(kind, x=x, y=y, c=c) for x, y, c in points.tolist()],
        )

    def animals(self, animals: list[tuple[int, dict[str, tuple[float, float]]]]) -> Any:
        """Return an Animals of (number, {label: (u, v)}) each."""
        found = []
        for number, joints in animals:
            made = [
                self.make("my_msgs/Joint", label=label, place=self.make("my_msgs/Place", u=u, v=v))
                for label, (u, v) in joints.items()
            ]
            found.append(self.make("my_msgs/Animal", number=number, joints=made))
        return self.make("my_msgs/Animals", found=found)


@pytest.fixture(params=["definitions", "stand-ins"])
def detectors(request: pytest.FixtureRequest) -> Detectors:
    return Detectors(request.param == "definitions")


@pytest.fixture
def recorded() -> Detectors:
    """Return a maker of messages that a bag can hold."""
    return Detectors(real=True)
