# SPDX-License-Identifier: Apache-2.0
"""Messages of every kind are lifted or refused, and what comes after is lifted as before."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from deep_nrsfm_ros.data import bags
from deep_nrsfm_ros.data.bags import frames
from deep_nrsfm_ros.messages.camera_info import read_camera_info
from deep_nrsfm_ros.messages.decoding import (
    MULTI_ARRAY,
    POINT_CLOUD,
    POLYGON,
    InputType,
    read_observation,
)
from deep_nrsfm_ros.messages.field_mapping import SKELETON_2D, YOLO, FieldMapping
from deep_nrsfm_ros.messages.serialised import MessageReader
from test.fuzz.conftest import Bench, Fuzz, Spoiler

KINDS = (POINT_CLOUD, MULTI_ARRAY, POLYGON)
BY_NUMBER = FieldMapping(
    "my_msgs/Thing", keypoints="parts.list", confidence="sure", keypoint_id="which", missing=(-1.0,)
)
BY_NAME = FieldMapping(
    "my_msgs/Zoo",
    objects="found",
    identity="number",
    keypoints="joints",
    x="place.u",
    y="place.v",
    keypoint_id="label",
    names=("l", "r", "u", "f", "t", "e"),
)


def points(p: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(50, 600, (p, 2))


def message(kind: str, p: int) -> Any:
    """Return a valid message of the type `kind`, as rosbags has it or as loose as it gets."""
    if kind in KINDS:
        return bags._ENCODERS[kind](next(frames(points(p)[None], np.ones((1, p)))))
    header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=2), frame_id="camera")
    seen = [*enumerate(points(p).tolist())]

    def keypoint(**fields: Any) -> SimpleNamespace:
        return SimpleNamespace(**fields)

    if kind == YOLO.type:
        data = [
            keypoint(id=i + 1, point=keypoint(x=x, y=y), score=0.5 + i / 20) for i, (x, y) in seen
        ]
        person = SimpleNamespace(id="7", score=0.9, keypoints=SimpleNamespace(data=data))
        nobody = SimpleNamespace(id="", score=0.2, keypoints=SimpleNamespace(data=[]))
        return SimpleNamespace(header=header, detections=[person, nobody])
    if kind == SKELETON_2D.type:
        skeleton = [keypoint(x=x / 640, y=y / 480, c=0.9) for _, (x, y) in seen]
        return SimpleNamespace(header=header, skeleton=skeleton)
    if kind == BY_NUMBER.type:
        parts = [keypoint(which=i, x=x, y=y, sure=0.9) for i, (x, y) in seen]
        return SimpleNamespace(parts=SimpleNamespace(list=parts))
    joints = [
        keypoint(label=name, place=keypoint(u=x, v=y))
        for name, (_, (x, y)) in zip(BY_NAME.names, seen, strict=True)
    ]
    return SimpleNamespace(found=[SimpleNamespace(number=3, joints=joints)])


@pytest.mark.parametrize(
    "input_type",
    [*KINDS, YOLO.type, SKELETON_2D.type, BY_NUMBER, BY_NAME],
    ids=lambda kind: kind if isinstance(kind, str) else f"{kind.type} by a field mapping",
)
def test_a_message_is_lifted_or_refused_and_leaves_no_trace(
    bench: Bench, fuzz: Fuzz, request: pytest.FixtureRequest, input_type: InputType
) -> None:
    kind = input_type if isinstance(input_type, str) else input_type.type
    pipeline, quick = bench.pipeline(), bench.pipeline(quick=True)
    valid = bench.loose(message(kind, len(bench.layout)))
    expected = bench.lift(pipeline, valid, input_type)

    def one(spoiler: Spoiler) -> str:
        spoilt = bench.loose(valid)
        spoiler.spoil(spoilt)
        try:
            lifted = bench.lift(pipeline if spoiler.random() < 0.1 else quick, spoilt, input_type)
        except ValueError as refusal:
            assert str(refusal)
            outcome = "refused"
        else:
            assert len(lifted.shapes) <= 100
            outcome = "lifted"
        if spoiler.random() < 0.02:
            again = bench.lift(pipeline, valid, input_type)
            for old, new in zip(expected, again, strict=True):
                np.testing.assert_array_equal(old, new)
        return outcome

    fuzz(request.node.callspec.id, one)


def test_bytes_on_the_wire_are_read_or_refused_by_the_short_way_as_by_the_long(
    bench: Bench, fuzz: Fuzz
) -> None:
    store, p = get_typestore(Stores.ROS2_JAZZY), len(bench.layout)
    names = {kind: kind.replace("/", "/msg/") for kind in KINDS}
    raws = {k: bytes(store.serialize_cdr(message(k, p), names[k])) for k in KINDS}
    decoders = {k: lambda raw, k=k: store.deserialize_cdr(raw, names[k]) for k in KINDS}
    readers = {k: MessageReader(k, decoders[k]) for k in KINDS}

    def one(spoiler: Spoiler) -> str:
        kind = spoiler.choice(KINDS)
        reader = readers[kind]
        reader(raws[kind], p)  # what comes next may be like it
        raw = spoiler.spoil_bytes(raws[kind])
        outcome = "read, as known" if reader.find_format(raw, p) else "read"
        try:
            came = decoders[kind](raw)
        except Exception:  # what bags.py does with it too
            with pytest.raises(Exception):  # noqa: B017, PT011 - any refusal will do
                reader(raw, p)
            return "undecodable"
        try:
            expected = read_observation(came, kind, p)
        except ValueError as refusal:
            with pytest.raises(ValueError, match=f"^{re.escape(str(refusal))}$"):
                reader(raw, p)
            return "refused"
        for old, new in zip(expected[:2], reader(raw, p)[1], strict=False):
            np.testing.assert_array_equal(old, new)
        return outcome

    fuzz("serialised message", one)


def test_a_camera_info_is_used_or_refused(bench: Bench, fuzz: Fuzz) -> None:
    pipeline = bench.pipeline()
    p, f = len(bench.layout), 500.0
    cameras = [
        SimpleNamespace(
            width=640,
            height=480,
            distortion_model=model,
            d=np.array([0.1, -0.05, 0.001, 0.002, *[0.01] * (n - 4)]),
            k=np.array([f, 0, 320, 0, f, 240, 0, 0, 1]),
            p=np.array([f, 0, 320, 0, 0, f, 240, 0, 0, 0, 1, 0]),
            binning_x=0,
            binning_y=1,
            roi=SimpleNamespace(x_offset=0, y_offset=0),
        )
        for model, n in (("plumb_bob", 5), ("rational_polynomial", 8), ("equidistant", 4))
    ]
    valid = message(POINT_CLOUD, p)
    sound = read_camera_info(cameras[0])
    expected = bench.lift(pipeline, valid, POINT_CLOUD, sound)

    def one(spoiler: Spoiler) -> str:
        spoilt = bench.loose(spoiler.choice(cameras))
        spoiler.spoil(spoilt)
        try:
            intrinsics = read_camera_info(spoilt, rectified=spoiler.random() < 0.3)
        except ValueError as refusal:
            assert str(refusal)
            return "refused"
        try:
            bench.lift(pipeline, valid, POINT_CLOUD, intrinsics)
            outcome = "lifted"
        except ValueError as refusal:
            assert str(refusal)
            outcome = "read, sees nothing"
        if spoiler.random() < 0.02:
            again = bench.lift(pipeline, valid, POINT_CLOUD, sound)
            for old, new in zip(expected, again, strict=True):
                np.testing.assert_array_equal(old, new)
        return outcome

    fuzz("sensor_msgs/CameraInfo", one)
