# SPDX-License-Identifier: Apache-2.0
"""The short way and the long way to read a serialised message end alike, to the last bit."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float32MultiArray

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.messages.decoding import MULTI_ARRAY, POINT_CLOUD, read_observation
from deep_nrsfm_ros.messages.serialised import Header, MessageReader, read_header

STORE = get_typestore(Stores.ROS2_JAZZY)
Q = 5
DECODERS: dict[str, Callable[[bytes], Any]] = {
    "live": lambda raw: deserialize_message(raw, PointCloud2),
    "bag": lambda raw: STORE.deserialize_cdr(raw, "sensor_msgs/msg/PointCloud2"),
}
BOTH = pytest.mark.parametrize("origin", DECODERS)


class Decoder:
    """A decoder that fails the test when it is called while it is not allowed."""

    def __init__(self, origin: str) -> None:
        self.decode, self.allowed = DECODERS[origin], True

    def __call__(self, raw: bytes) -> Any:
        assert self.allowed, "decoded"
        return self.decode(raw)


@st.composite
def clouds(draw: st.DrawFn) -> PointCloud2:
    """Return a cloud that can be read, its numbers those of arbitrary bytes."""
    others = draw(st.sampled_from([[], ["confidence"], ["rgb"], ["rgb", "confidence"]]))
    fields, step = [], 0
    for name in draw(st.permutations(["x", "y", *others])):
        kind = draw(st.sampled_from([PointField.FLOAT32, PointField.FLOAT64]))
        offset = step + draw(st.integers(0, 5))
        fields.append(PointField(name=name, offset=offset, datatype=kind, count=1))
        step = offset + (4 if kind == PointField.FLOAT32 else 8)
    step += draw(st.integers(0, 5))
    n = draw(st.integers(0, 20))
    row_step = step * Q + draw(st.integers(0, 9))
    message = PointCloud2(height=n, width=Q, fields=fields, point_step=step, row_step=row_step)
    message.is_bigendian, message.is_dense = draw(st.booleans()), draw(st.booleans())
    size = n * row_step + draw(st.integers(0, 3))
    message.header.frame_id = draw(st.text(st.characters(codec="utf-8"), max_size=6))
    return renewed(message, draw(st.integers(0, 9)), size)


def renewed(message: PointCloud2, seed: int, size: int | None = None) -> PointCloud2:
    """Return the cloud with another stamp and other data."""
    rng = np.random.default_rng(seed)
    data = rng.bytes(len(message.data) if size is None else size)
    if seed % 2:  # numbers as they are in images
        data = rng.uniform(-9, 999, len(data) // 4 + 1).astype("<f4").tobytes()[: len(data)]
    message.data = array("B", data)
    message.header.stamp.sec = int(rng.integers(-(2**31), 2**31))
    message.header.stamp.nanosec = int(rng.integers(2**32))
    return message


def outcome(call: Callable[[], tuple[Header | None, Any]]) -> Any:
    """Return what comes of reading, in a form that compares every bit."""
    try:
        header, seen = call()
    except Exception as error:
        return type(error), str(error)
    arrays = [(a.shape, a.dtype, a.tobytes(), a.flags.c_contiguous) for a in seen[:2]]
    return header, arrays, seen.identities


def long_way(raw: bytes, origin: str, *how: Any) -> Any:
    message = DECODERS[origin](raw)
    return read_header(message), read_observation(message, POINT_CLOUD, *how)


@BOTH
@settings(deadline=None)
@pytest.mark.filterwarnings("error::RuntimeWarning")
@given(message=clouds(), spoilt=st.data(), min_confidence=st.sampled_from([0.0, 0.3]))
def test_short_and_long_way_end_alike(
    origin: str, message: PointCloud2, spoilt: st.DataObject, min_confidence: float
) -> None:
    reader = MessageReader(POINT_CLOUD, DECODERS[origin])
    raws = [serialize_message(renewed(message, seed)) for seed in (1, 2, 3)]
    for _ in range(6):
        changed = bytearray(spoilt.draw(st.sampled_from(raws[:3])))
        places = st.integers(0, len(changed) - 1) | st.integers(0, min(180, len(changed) - 1))
        for at in spoilt.draw(st.lists(places, max_size=3)):
            changed[at] = spoilt.draw(st.sampled_from([0, 1, 2, 4, 5, 127, 255]))
        cut = spoilt.draw(st.just(len(changed)) | st.integers(0, len(changed)))
        raws.append(bytes(changed[:cut]) + spoilt.draw(st.binary(max_size=4)))
    for raw in raws:
        for q in (Q, Q + 1):
            expected = outcome(partial(long_way, raw, origin, q, min_confidence))
            assert outcome(partial(reader, raw, q, min_confidence)) == expected


@BOTH
@settings(deadline=None)
@given(message=clouds(), seeds=st.lists(st.integers(0, 99), min_size=1, max_size=5))
def test_the_second_message_of_a_make_is_not_decoded(
    origin: str, message: PointCloud2, seeds: list[int]
) -> None:
    decoder = Decoder(origin)
    reader = MessageReader(POINT_CLOUD, decoder)
    reader(serialize_message(message), Q)
    decoder.allowed = False
    raws = [serialize_message(renewed(message, seed)) for seed in seeds]
    expected = [long_way(raw, origin, Q)[1] for raw in raws]
    assert [outcome(partial(reader, raw, Q)) for raw in raws] == [
        outcome(partial(long_way, raw, origin, Q)) for raw in raws
    ]
    make = reader.find_format(raws[0], Q)
    assert make
    together = make.read(raws, 0.0)
    for i in range(2):
        np.testing.assert_array_equal(together[i], np.concatenate([seen[i] for seen in expected]))


def plain(n: int = 1, frame_id: str = "camera") -> bytes:
    """Return a cloud of n objects with the fields x and y."""
    message = PointCloud2(height=n, width=Q, point_step=8, row_step=8 * Q)
    message.fields = [PointField(name=f, offset=4 * i, datatype=7) for i, f in enumerate("xy")]
    message.header.frame_id = frame_id
    return bytes(serialize_message(renewed(message, 1, n * Q * 8)))


@BOTH
def test_no_byte_is_overlooked(origin: str) -> None:
    raw = plain(2)
    reader = MessageReader(POINT_CLOUD, DECODERS[origin])
    for at in range(len(raw)):
        for bit in (1, 2, 128):
            reader(raw, Q)
            spoilt = raw[:at] + bytes([raw[at] ^ bit]) + raw[at + 1 :]
            assert outcome(lambda: reader(spoilt, Q)) == outcome(  # noqa: B023
                lambda: long_way(spoilt, origin, Q)  # noqa: B023
            )


def test_bytes_between_numbers_do_not_matter() -> None:
    raw = bytearray(plain(frame_id="a"))  # after it two bytes that senders leave to chance
    decoder = Decoder("live")
    reader = MessageReader(POINT_CLOUD, decoder)
    reader(bytes(raw), Q)
    decoder.allowed = False
    raw[18:20] = b"\xab\xcd"
    assert raw[16:18] == b"a\0" and reader(bytes(raw), Q)[0] == reader(plain(frame_id="a"), Q)[0]


@pytest.mark.skipif(not kernel.AVAILABLE, reason="no C compiler")
@pytest.mark.parametrize(
    ("messages", "steps", "offsets", "room"),
    [
        ((2, 49), (24, 12), (0, 4, 8), 4),  # the second message ends beyond the data
        ((2, 48), (25, 12), (0, 4, 8), 4),
        ((2, 48), (24, 13), (0, 4, 8), 4),
        ((2, 48), (24, 12), (0, 4, 9), 4),
        ((2, 48), (24, 12), (-1, 4, 8), 4),
        ((2, -48), (24, 12), (0, 4, 8), 4),
        ((2, 48), (24, 12), (0, 4, 8), 5),
    ],
)
def test_nothing_is_read_beyond_the_data(
    messages: tuple[int, int], steps: tuple[int, int], offsets: tuple[int, int, int], room: int
) -> None:
    from deep_nrsfm_ros.kernel import _kernel

    points, confidence = np.empty((4, 2, 2), np.float32), np.empty((4, 2), np.float32)
    _kernel.decode_keypoints(
        bytes(96), (2, 48), (2, 2), (24, 12), (0, 4, 8), 1e9, 0.1, points, confidence
    )
    assert not points.any() and not confidence.any()
    confidence = np.empty((room, 2), np.float32)
    with pytest.raises(ValueError, match="do not fit the data"):
        _kernel.decode_keypoints(
            bytes(96), messages, (2, 2), steps, offsets, 1e9, 0.1, points, confidence
        )


def test_makes_that_take_turns_are_all_remembered_but_not_without_end() -> None:
    decoder = Decoder("live")
    reader = MessageReader(POINT_CLOUD, decoder)
    raws = [plain(n, frame_id) for n in range(4) for frame_id in ("", "left", "right")]
    for raw in raws:
        reader(raw, Q)
    decoder.allowed = False
    for raw in raws * 2:
        reader(raw, Q)
    decoder.allowed = True
    many = [plain(1, f"camera {i}") for i in range(300)]
    for raw in many:
        reader(raw, Q)
    kept = [reader.find_format(raw, Q) is not None for raw in many]
    assert kept == [False] * 236 + [True] * 64
    reader(plain(1, "a" * 5000), Q)  # long: not remembered
    assert not reader.find_format(plain(1, "a" * 5000), Q)


def test_another_type_is_read_by_its_decoder() -> None:
    raw = serialize_message(Float32MultiArray(data=array("f", range(1, 2 * Q + 1))))
    reader = MessageReader(MULTI_ARRAY, lambda raw: deserialize_message(raw, Float32MultiArray))
    for _ in range(2):
        header, seen = reader(raw, Q)
        assert header is None and seen.points.ravel().tolist() == list(range(1, 2 * Q + 1))


def test_a_header_tells_its_time_in_nanoseconds() -> None:
    assert Header(3, 4).stamp == 3_000_000_004


def test_a_later_header() -> None:
    assert Header(4, 900_000_000, "optical").later(1_200_000_000) == Header(
        6, 100_000_000, "optical"
    )
