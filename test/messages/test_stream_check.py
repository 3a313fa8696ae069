# SPDX-License-Identifier: Apache-2.0
"""What looks wrong in the last messages of a stream: keypoints outside the image, confidence."""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point32, Polygon, PolygonStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2, PointField

from benchmarks.data.walking_person import IMAGE, in_layout
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25, BODY25B, COCO17, HUMAN17
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.decoding import (
    POINT_CLOUD,
    POINT_FIELDS,
    POINT_STEP,
    POLYGON,
    InputType,
    is_normalised,
    pack_points,
)
from deep_nrsfm_ros.messages.field_mapping import FieldMapping
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.messages.pipeline import Pipeline
from deep_nrsfm_ros.messages.serialised import MessageReader
from deep_nrsfm_ros.messages.stream_check import Choice, StreamCheck
from deep_nrsfm_ros.model_files.model_file import load_model

FRACTIONS = FieldMapping("other_msgs/Pose", keypoints="points", units="normalised")
PIXELS = FieldMapping("other_msgs/Pose", keypoints="points")


@dataclass
class Reader:
    """Reads the same observation from any bytes."""

    input_type: InputType
    observation: Observation
    unused_confidence: str = ""

    def __call__(self, raw: bytes, *args: Any) -> tuple[None, Observation]:
        return None, self.observation


def test_fractions_are_told_from_pixels() -> None:
    assert is_normalised(FRACTIONS) and not is_normalised(PIXELS) and not is_normalised(POLYGON)


def cloud(points: np.ndarray, confidence: np.ndarray) -> bytes:
    """Return a serialised PointCloud2 of keypoints."""
    n, q = confidence.shape
    fields = [PointField(name=name, offset=o, datatype=7, count=1) for name, o in POINT_FIELDS]
    data = array("B", pack_points(points, confidence))
    step = {"point_step": POINT_STEP, "row_step": q * POINT_STEP}
    raw: bytes = serialize_message(PointCloud2(height=n, width=q, fields=fields, data=data, **step))
    return raw


def polygon(points: np.ndarray, confidence: np.ndarray) -> bytes:
    """Return a serialised PolygonStamped of the first object."""
    rows = np.c_[points[0], confidence[0]].tolist()
    corners = [Point32(x=x, y=y, z=z) for x, y, z in rows]
    raw: bytes = serialize_message(PolygonStamped(polygon=Polygon(points=corners)))
    return raw


@pytest.mark.parametrize(
    ("kind", "message", "write"),
    [(POINT_CLOUD, PointCloud2, cloud), (POLYGON, PolygonStamped, polygon)],
)
@pytest.mark.parametrize(("largest", "expected"), [(1.0, []), (95.0, ["confidence-scale"])])
def test_confidence_in_percent_is_found_in_messages(
    kind: str, message: Any, write: Any, largest: float, expected: list[str]
) -> None:
    points, confidence = in_layout(HUMAN17)
    lifted = Pipeline(
        load_model("human17"), None, InputOptions(), LiftingOptions(), SmoothingOptions()
    )
    stream = StreamCheck(search=False)
    reader = MessageReader(kind, lambda raw: deserialize_message(raw, message))
    for i in range(8):
        raw = write(points[[i]], largest * np.linspace(0.15, 1, 17)[None])
        stream.received("keypoints", reader, raw)
        lifted.read(raw, reader)  # the format is known from here on
    found = stream.look(lifted, None, None, 0.05)
    assert [f.code for f in found if f.code != "stamps"] == expected
    assert not expected or str(found[0]).startswith("confidence up to 95: it must be 0 to 1")


@pytest.mark.parametrize(("mapping", "expected"), [(PIXELS, ["outside"]), (FRACTIONS, [])])
def test_pixels_outside_the_image_and_parts_that_it_cuts_off(
    mapping: FieldMapping, expected: list[str]
) -> None:
    points, confidence = in_layout(HUMAN17)
    points = points[:8] + np.array([0, 250], np.float32)  # legs below the image
    pipeline = Pipeline(
        load_model("human17"), None, InputOptions(), LiftingOptions(), SmoothingOptions()
    )
    stream = StreamCheck(search=False)
    reader: Any = Reader(mapping, Observation(points, confidence[:8]))
    stream.received("keypoints", reader, b"")
    camera = Intrinsics.from_field_of_view(65, IMAGE)
    found = stream.look(pipeline, IMAGE, camera, 0.5)
    assert [finding.code for finding in found if finding.code == "outside"] == expected
    assert not expected or found[0].code == "outside"


def test_a_wrong_layout_is_the_one_cause_that_is_named() -> None:
    """In the wrong order people come out upside down, which says nothing of the image."""
    points, confidence = in_layout(BODY25)
    model = load_model("human")
    codes = []
    for layout, turn in ((BODY25B, 1), (BODY25, 1), (BODY25, -1)):
        seen = points[:16] * np.array([1, turn], np.float32)
        lifted = Lifter(model, layout=layout)(seen, confidence[:16])
        pipeline = Pipeline(model, layout, InputOptions(), LiftingOptions(), SmoothingOptions())
        stream = StreamCheck(search=False)
        reader: Any = Reader(PIXELS, Observation(seen, confidence[:16]))
        stream.received("keypoints", reader, b"")
        stream.lifted(lifted)
        found = stream.look(pipeline, None, None, float(np.nanmedian(lifted.residual)))
        codes.append([finding.code for finding in found])
    assert codes == [["layout"], [], ["orientation"]]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("x", "y", "score"), "no field 'confidence', and their field 'score' is not used"),
        (("x", "y", "c"), "their field 'c' is not used"),
        (("x", "y", "confidence"), ""),
        (("x", "y", "z"), ""),
    ],
)
def test_a_confidence_of_another_name_is_named(names: tuple[str, ...], expected: str) -> None:
    points, confidence = in_layout(HUMAN17)
    values = np.concatenate([points[:2], confidence[:2, :, None]], -1).astype("<f4")
    cloud = SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0), frame_id=""),
        height=2,
        width=17,
        fields=[
            SimpleNamespace(name=name, offset=4 * i, datatype=7) for i, name in enumerate(names)
        ],
        is_bigendian=False,
        point_step=12,
        row_step=12 * 17,
        data=values.tobytes(),
    )
    model = load_model("human17")
    pipeline = Pipeline(model, None, InputOptions(), LiftingOptions(), SmoothingOptions())
    stream = StreamCheck(search=False)
    stream.received("/keypoints", MessageReader(POINT_CLOUD, lambda raw: cloud), b"\0\1\0\0")
    found = [f for f in stream.look(pipeline, None, None, 0.1) if f.code == "confidence-field"]
    assert [expected in str(finding) for finding in found] == [True] * bool(expected)


def test_a_layout_is_named_as_the_parameter_takes_it() -> None:
    assert Choice(COCO17, "").value == "coco17"
    assert Choice(KeypointLayout("mymouse", ("a", "b", "c", "d")), "").value == "model"
