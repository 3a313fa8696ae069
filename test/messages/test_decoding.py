# SPDX-License-Identifier: Apache-2.0
"""Any message of a known type becomes an observation or a MessageError, live or from a bag."""

from array import array
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point32, PolygonStamped
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float32MultiArray, MultiArrayDimension

from deep_nrsfm_ros.lifting.observation import MessageError, check_keypoints, to_observation
from deep_nrsfm_ros.messages.decoding import (
    INPUT_TYPES,
    MULTI_ARRAY,
    POINT_CLOUD,
    POINT_FIELDS,
    POINT_STEP,
    POLYGON,
    count_keypoints,
    pack_points,
    read_observation,
    resolve_input_type,
)

STORE = get_typestore(Stores.ROS2_JAZZY)
FORMATS = {PointField.FLOAT32: "f4", PointField.FLOAT64: "f8"}
BOTH = pytest.mark.parametrize("origin", ["live", "bag"])


def received(message: Any, input_type: str, origin: str) -> Any:
    """Return the message as a subscription gives it, or as rosbags reads it from a bag."""
    if origin == "live":
        return message
    return STORE.deserialize_cdr(serialize_message(message), input_type.replace("/", "/msg/"))


def keypoints(n: int, q: int, seed: int = 0) -> np.ndarray:
    """Return (n, q, 3) pixels with confidence in (0.1, 1), none missing."""
    random = np.random.default_rng(seed)
    points = random.uniform(1, 2000, (n, q, 2))
    return np.concatenate([points, random.uniform(0.1, 1, (n, q, 1))], -1).astype(np.float32)


def cloud(
    values: np.ndarray,
    *,
    names: tuple[str, ...] = ("x", "y", "confidence"),
    datatypes: tuple[int, ...] = (PointField.FLOAT32,) * 3,
    gap: int = 0,
    row_gap: int = 0,
    bigendian: bool = False,
) -> PointCloud2:
    """Return a PointCloud2 of values (n, q, 3) with its fields in the order of `names`."""
    order = ">" if bigendian else "<"
    formats = [order + FORMATS[datatype] for datatype in datatypes]
    widths = [gap + np.dtype(f).itemsize for f in formats]
    offsets = [gap + sum(widths[:i]) for i in range(len(names))]
    step = sum(widths) + gap
    dtype = np.dtype(
        {"names": list(names), "formats": formats, "offsets": offsets, "itemsize": step}
    )
    n, q = values.shape[:2]
    points = np.zeros((n, q), dtype)
    for name in names:
        points[name] = values[..., ("x", "y", "confidence").index(name)]
    rows = [row.tobytes() + b"\xff" * row_gap for row in points]
    message = PointCloud2(height=n, width=q, point_step=step, row_step=step * q + row_gap)
    message.is_bigendian = bigendian
    message.fields = [
        PointField(name=name, offset=offset, datatype=datatype, count=1)
        for name, offset, datatype in zip(names, offsets, datatypes, strict=False)
    ]
    message.data = array("B", b"".join(rows))
    return message


def multi_array(values: np.ndarray, sizes: tuple[int, ...], offset: int = 0) -> Float32MultiArray:
    """Return a Float32MultiArray of `values`, its layout saying `sizes`."""
    message = Float32MultiArray(data=array("f", [7.0] * offset + values.ravel().tolist()))
    message.layout.data_offset = offset
    message.layout.dim = [MultiArrayDimension(size=size) for size in sizes]
    return message


def polygon(values: np.ndarray) -> PolygonStamped:
    """Return a PolygonStamped of values (q, 3)."""
    message = PolygonStamped()
    message.polygon.points = [Point32(x=float(x), y=float(y), z=float(z)) for x, y, z in values]
    return message


@BOTH
@settings(deadline=None)
@given(
    n=st.integers(0, 3),
    q=st.integers(1, 9),
    names=st.permutations(["x", "y", "confidence"]),
    datatypes=st.tuples(*[st.sampled_from(sorted(FORMATS))] * 3),
    gap=st.integers(0, 5),
    row_gap=st.integers(0, 9),
    bigendian=st.booleans(),
)
def test_point_cloud_of_any_make(origin: str, n: int, q: int, names: Any, **make: Any) -> None:
    values = keypoints(n, q)
    message = received(cloud(values, names=tuple(names), **make), POINT_CLOUD, origin)
    points, confidence, *_ = read_observation(message, POINT_CLOUD, q)
    np.testing.assert_array_equal(points, values[..., :2])
    np.testing.assert_array_equal(confidence, values[..., 2])
    assert points.dtype == confidence.dtype == np.float32


@BOTH
def test_point_cloud_without_confidence_is_certain(origin: str) -> None:
    message = cloud(keypoints(2, 5), names=("y", "x"))
    assert (
        read_observation(received(message, POINT_CLOUD, origin), POINT_CLOUD, 5).confidence == 1
    ).all()


def test_packed_points_read_back() -> None:
    values = keypoints(2, 6)
    message = PointCloud2(height=2, width=6, point_step=POINT_STEP, row_step=6 * POINT_STEP)
    message.fields = [PointField(name=n, offset=o, datatype=7, count=1) for n, o in POINT_FIELDS]
    message.data = array("B", pack_points(values[..., :2], values[..., 2]))
    points, confidence, *_ = read_observation(message, POINT_CLOUD, 6)
    np.testing.assert_array_equal(points, values[..., :2])
    np.testing.assert_array_equal(confidence, values[..., 2])


@BOTH
@pytest.mark.parametrize("size", [2, 3])
@pytest.mark.parametrize("shape", ["p", "n p", "flat", "none"])
def test_multi_array_by_its_layout(origin: str, shape: str, size: int) -> None:
    n, q = (3, 6) if shape == "n p" else (1, 6)
    values = keypoints(n, q)
    sizes = {"p": (q, size), "n p": (n, q, size), "flat": (q * size,), "none": ()}[shape]
    message = multi_array(values[..., :size], sizes, offset=2)
    points, confidence, *_ = read_observation(
        received(message, MULTI_ARRAY, origin), MULTI_ARRAY, q
    )
    np.testing.assert_array_equal(points, values[..., :2])
    np.testing.assert_array_equal(confidence, values[..., 2] if size == 3 else np.ones((n, q)))


@BOTH
def test_polygon_takes_z_for_confidence(origin: str) -> None:
    values = keypoints(1, 7)
    points, confidence, *_ = read_observation(
        received(polygon(values[0]), POLYGON, origin), POLYGON, 7
    )
    np.testing.assert_array_equal(points, values[..., :2])
    np.testing.assert_array_equal(confidence, values[..., 2])
    values[..., 2] = 0
    flat = read_observation(received(polygon(values[0]), POLYGON, origin), POLYGON, 7)
    np.testing.assert_array_equal(flat.points, values[..., :2])
    assert (flat.confidence == 1).all()


@pytest.mark.parametrize(
    "missing",
    [
        (np.nan, 5, 1),
        (5, np.inf, 1),
        (-np.inf, 5, 1),
        (0, 0, 1),
        (5, 5, 0),
        (5, 5, -1),
        (5, 5, np.nan),
        (5, 5, np.inf),
        (5, 5, 0.29),
        (1e300, 5, 1),
    ],
    ids=str,
)
def test_missing_keypoints(missing: tuple[float, float, float]) -> None:
    values = keypoints(1, 5).astype(float)
    values[..., 2] = 0.5
    values[0, 3] = missing
    with np.errstate(all="raise", over="ignore"):
        message = cloud(values, datatypes=(PointField.FLOAT64,) * 3)
        points, confidence, *_ = read_observation(message, POINT_CLOUD, 5, min_confidence=0.3)
    np.testing.assert_array_equal(confidence, [[0.5, 0.5, 0.5, 0, 0.5]])
    np.testing.assert_array_equal(points[0, 3], [0, 0])
    np.testing.assert_array_equal(points[0, :3], values[0, :3, :2].astype(np.float32))


def test_a_keypoint_on_an_image_border_is_there() -> None:
    seen = to_observation(np.array([[[0, 5, 1], [5, 0, 1], [-3, -4, 1], [0, 0, 1]]]))
    np.testing.assert_array_equal(seen.confidence, [[1, 1, 1, 0]])


def test_confidence_is_at_most_one() -> None:
    seen = to_observation(np.array([[[5, 5, 1.3], [5, 5, 100]]]))
    np.testing.assert_array_equal(seen.confidence, [[1, 1]])


@pytest.mark.parametrize(
    ("input_type", "message"),
    [
        (POINT_CLOUD, cloud(keypoints(1, 17))),
        (MULTI_ARRAY, multi_array(keypoints(1, 17), (17, 3))),
        (POLYGON, polygon(keypoints(1, 17)[0])),
    ],
    ids=[POINT_CLOUD, MULTI_ARRAY, POLYGON],
)
def test_wrong_number_of_keypoints_names_both(input_type: str, message: Any) -> None:
    with pytest.raises(MessageError, match="17 keypoints.*has 25"):
        read_observation(message, input_type, 25)


def test_flat_array_of_wrong_length_says_what_it_takes() -> None:
    with pytest.raises(MessageError, match=r"50 numbers.*34.*51"):
        read_observation(multi_array(np.zeros(50), ()), MULTI_ARRAY, 17)


@pytest.mark.parametrize(
    ("mend", "expected"),
    [
        ({"fields": []}, "expected one field 'x'; the fields are: none"),
        ({"fields": "twice"}, "expected one field 'x'; the fields are: x, x"),
        ({"datatype": 5}, "'x' has datatype 5"),
        ({"offset": 9}, "'x' at offset 9"),
        ({"offset": 2**32 - 1}, "'x' at offset 4294967295"),
        ({"point_step": 0}, "point_step of 0"),
        ({"row_step": 0}, "row_step is 0"),
        ({"height": 2**32 - 1}, "data has 120 bytes"),
        ({"point_step": 2**31, "row_step": 2**32 - 1}, "row_step is 4294967295"),
        ({"row_step": 2**32 - 1}, "data has 120 bytes"),
        ({"data": array("B")}, "data has 0 bytes"),
        ({"data": array("B", bytes(119))}, "data has 119 bytes; 2 x 5 points need 120"),
    ],
    ids=str,
)
def test_malformed_point_cloud(mend: dict[str, Any], expected: str) -> None:
    message = cloud(keypoints(2, 5))
    mend = dict(mend)
    if mend.get("fields") == "twice":
        mend["fields"] = [*message.fields, message.fields[0], message.fields[0]][3:]
    for name in ("datatype", "offset"):
        if name in mend:
            setattr(message.fields[0], name, mend.pop(name))
    for name, value in mend.items():
        setattr(message, name, value)
    with pytest.raises(MessageError, match=expected):
        read_observation(message, POINT_CLOUD, 5)


@pytest.mark.parametrize(
    ("sizes", "expected"),
    [
        ((5, 4), "last dimension is 4"),
        ((10, 2), "10 keypoints .* layout has 5: name the layout"),
        ((2, 2, 5, 1), "4 dimensions"),
        ((3, 5, 3), "3 x 5 x 3 numbers; data has 20"),
        ((2**32 - 1, 2**32 - 1, 2**32 - 1), "numbers; data has 20"),
        ((2**32 - 1, 0, 3), "numbers; data has 20"),
    ],
    ids=str,
)
def test_malformed_multi_array(sizes: tuple[int, ...], expected: str) -> None:
    with pytest.raises(MessageError, match=expected):
        read_observation(multi_array(np.ones(20), sizes), MULTI_ARRAY, 5)


@settings(deadline=None, max_examples=300)
@given(
    height=st.integers(0, 2**32 - 1) | st.integers(0, 4),
    width=st.integers(0, 8) | st.just(2**32 - 1),
    point_step=st.integers(0, 2**32 - 1) | st.integers(0, 20),
    row_step=st.integers(0, 2**32 - 1) | st.integers(0, 200),
    data=st.binary(max_size=300),
    fields=st.lists(
        st.builds(
            SimpleNamespace,
            name=st.sampled_from(["x", "y", "confidence", ""]),
            offset=st.integers(0, 2**32 - 1) | st.integers(0, 20),
            datatype=st.integers(0, 255) | st.sampled_from([7, 8]),
        ),
        max_size=5,
    ),
    is_bigendian=st.booleans(),
)
def test_arbitrary_point_cloud_is_read_or_refused(**message: Any) -> None:
    try:
        points, confidence, *_ = read_observation(SimpleNamespace(**message), POINT_CLOUD, 5)
    except MessageError as refusal:
        assert str(refusal)
    else:
        # An empty cloud, of width 0, may have any height: nobody is there.
        assert points.shape == (message["height"] if message["width"] else 0, 5, 2)
        assert np.isfinite(points).all() and np.isfinite(confidence).all()


@given(
    data=st.lists(st.floats(width=32), max_size=40),
    sizes=st.lists(st.integers(0, 2**32 - 1) | st.integers(0, 6), max_size=4),
    offset=st.integers(0, 2**32 - 1) | st.integers(0, 3),
)
def test_arbitrary_multi_array_is_read_or_refused(
    data: list[float], sizes: list[int], offset: int
) -> None:
    layout = SimpleNamespace(data_offset=offset, dim=[SimpleNamespace(size=s) for s in sizes])
    try:
        points, confidence, *_ = read_observation(
            SimpleNamespace(layout=layout, data=data), MULTI_ARRAY, 5
        )
    except MessageError as refusal:
        assert str(refusal)
    else:
        assert points.shape[1:] == (5, 2) and len(points) * 10 <= len(data)
        assert np.isfinite(points).all() and np.isfinite(confidence).all()


@pytest.mark.parametrize("input_type", INPUT_TYPES)
def test_message_of_another_type_is_refused(input_type: str) -> None:
    with pytest.raises(MessageError, match=f"message of type {input_type}"):
        read_observation(SimpleNamespace(header=None), input_type, 5)


def test_unknown_input_type_lists_the_known() -> None:
    with pytest.raises(ValueError, match="no input type 'a/B'; choose one of sensor_msgs/Point"):
        read_observation(None, "a/B", 5)


def test_a_type_is_found_by_name_and_else_the_choice_is_told() -> None:
    assert resolve_input_type("input_type", "sensor_msgs/msg/PointCloud2") == POINT_CLOUD
    with pytest.raises(ValueError, match=r"input_type is 'a/B'; name one of .*field mapping"):
        resolve_input_type("input_type", "a/B")
    with pytest.raises(ValueError, match="field mapping nowhere.yaml: cannot be read"):
        resolve_input_type("input_type", "nowhere.yaml")


@pytest.mark.parametrize(
    ("sizes", "numbers", "count"),
    [
        ((), 0, 0),
        ((), 10, 5),
        ((), 9, 3),
        ((10,), 10, 5),
        ((5, 2), 10, 5),
        ((5, 3), 15, 5),
        ((2, 5, 3), 30, 5),
        ((0, 5, 3), 0, 0),
    ],
)
def test_arrays_tell_how_many_keypoints_they_have(
    sizes: tuple[int, ...], numbers: int, count: int
) -> None:
    message = Float32MultiArray(data=array("f", range(numbers)))
    message.layout.dim = [MultiArrayDimension(size=size) for size in sizes]
    assert count_keypoints(message, MULTI_ARRAY) == count


@pytest.mark.parametrize("numbers", [7, 12])
def test_plain_numbers_that_fit_twice_or_never_tell_nothing(numbers: int) -> None:
    message = Float32MultiArray(data=array("f", range(numbers)))
    with pytest.raises(MessageError, match=f"{numbers} numbers and no dimensions; give it them"):
        count_keypoints(message, MULTI_ARRAY)


def test_the_layout_is_not_blamed_for_what_is_turned_or_in_one_row() -> None:
    message = cloud(keypoints(2, 5))
    message.height, message.width = 5, 2
    with pytest.raises(MessageError, match="width is 2 and height 5; .*: send 2 x 5"):
        read_observation(message, POINT_CLOUD, 5)
    message.height, message.width = 1, 10
    with pytest.raises(MessageError, match="width is 10 and height 1; .*: send 2 x 5"):
        read_observation(message, POINT_CLOUD, 5)
    message.height, message.width = 1, 7
    with pytest.raises(MessageError, match="7 keypoints .*: name the layout"):
        read_observation(message, POINT_CLOUD, 5)
    for sizes, count, reason in (
        ((2, 5), 10, "2 x 5, send them as 5 x 2"),
        ((), 30, r"give the data of several objects dimensions \(layout.dim\)"),
        ((), 34, "name the layout .*parameter keypoint_layout, option --keypoint-layout"),
    ):
        dim = [SimpleNamespace(size=size) for size in sizes]
        layout = SimpleNamespace(data_offset=0, dim=dim)
        with pytest.raises(MessageError, match=reason):
            read_observation(SimpleNamespace(layout=layout, data=[1.0] * count), MULTI_ARRAY, 5)


def test_a_message_of_nobody_has_no_objects() -> None:
    nobody = cloud(keypoints(1, 5))
    nobody.width, nobody.data = 0, array("B")
    for sizes in ((), (0,), (0, 3), (0, 5, 3)):
        dim = [SimpleNamespace(size=size) for size in sizes]
        layout = SimpleNamespace(data_offset=0, dim=dim)
        array_of = SimpleNamespace(layout=layout, data=[])
        assert read_observation(array_of, MULTI_ARRAY, 5).points.shape == (0, 5, 2)
    polygon_of = SimpleNamespace(polygon=SimpleNamespace(points=[]))
    assert read_observation(polygon_of, POLYGON, 5).points.shape == (0, 5, 2)
    assert read_observation(nobody, POINT_CLOUD, 5).points.shape == (0, 5, 2)


def test_as_many_keypoints_as_a_hand_has_name_its_model() -> None:
    with pytest.raises(MessageError, match="21 keypoints are those of model 'hand21': -p model:"):
        check_keypoints(21, 25, "width")
    with pytest.raises(MessageError, match="has 25: name the layout"):
        check_keypoints(18, 25, "width")
