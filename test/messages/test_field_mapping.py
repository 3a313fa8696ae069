# SPDX-License-Identifier: Apache-2.0
"""Messages of any detector, told by names of fields."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.messages.decoding import count_keypoints, may_omit_keypoints, read_observation
from deep_nrsfm_ros.messages.field_mapping import (
    MAPPINGS,
    SKELETON_2D,
    YOLO,
    FieldMapping,
)

ANIMALS = FieldMapping(
    "my_msgs/Animals",
    objects="found",
    identity="number",
    keypoints="joints",
    x="place.u",
    y="place.v",
    keypoint_id="label",
    names=("head", "tail", "paw", "ear"),
)


def points(q: int, seed: int = 0) -> np.ndarray:
    """Return (q, 3) pixels with confidence."""
    random = np.random.default_rng(seed)
    return np.column_stack([random.uniform(1, 900, (q, 2)), random.uniform(0.5, 1, q)])


def test_yolo_detections(detectors: Any) -> None:
    a, b = points(17), points(17, 1)
    message = detectors.detections(
        [
            {"id": "7", "points": a, "seen": range(17)},
            {"id": "", "points": a, "seen": []},  # a chair
            {"id": "", "points": b, "seen": [0, 5, 16]},
        ]
    )
    seen = read_observation(message, YOLO.type, 17)
    assert seen.identities == ("7", None)
    np.testing.assert_allclose(seen.points[0], a[:, :2], rtol=1e-6)
    np.testing.assert_allclose(seen.confidence[0], a[:, 2], rtol=1e-6)
    np.testing.assert_array_equal(np.flatnonzero(seen.confidence[1]), [0, 5, 16])
    np.testing.assert_allclose(seen.points[1, 16], b[16, :2], rtol=1e-6)
    empty = read_observation(detectors.detections([]), YOLO.type, 17)
    assert empty.points.shape == (0, 17, 2) and empty.identities == ()


def test_yolo_of_another_layout_says_so(detectors: Any) -> None:
    message = detectors.detections([{"id": "", "points": points(25), "seen": [24]}])
    with pytest.raises(MessageError, match="id of a keypoint is 25; the 17 .* are 1 to 17"):
        read_observation(message, YOLO.type, 17)


def test_skeletons_are_normalised_by_width_and_height_apart(detectors: Any) -> None:
    given = points(18) / [1000, 1000, 1]
    given[3] = 0  # missing
    message = detectors.skeleton(given)
    seen = read_observation(message, SKELETON_2D.type, 18, size=(640, 480))
    np.testing.assert_allclose(seen.points[0], given[:, :2] * [640, 480], rtol=1e-5)
    assert seen.confidence[0, 3] == 0 and (np.delete(seen.confidence[0], 3) > 0).all()
    assert seen.identities == (None,)
    with pytest.raises(MessageError, match="size of the image is needed; set image_width"):
        read_observation(message, SKELETON_2D.type, 18)
    with pytest.raises(MessageError, match=r"18 keypoints \(skeleton\).*has 17"):
        read_observation(message, SKELETON_2D.type, 17, size=(640, 480))


def test_a_type_of_ones_own_with_names(detectors: Any) -> None:
    message = detectors.animals(
        [(3, {"paw": (1, 2), "head": (3, 4)}), (5, {}), (9, {"tail": (5, 6), "ear": (0, 0)})]
    )
    seen = read_observation(message, ANIMALS, 4)
    assert seen.identities == ("3", "9")
    np.testing.assert_array_equal(seen.points[0], [[3, 4], [0, 0], [1, 2], [0, 0]])
    np.testing.assert_array_equal(seen.confidence, [[1, 0, 1, 0], [0, 1, 0, 0]])
    with pytest.raises(MessageError, match="label is 'hoof'; the mapping names head, tail"):
        read_observation(detectors.animals([(1, {"hoof": (1, 1)})]), ANIMALS, 4)
    with pytest.raises(MessageError, match="4 keypoints .*has 5"):
        read_observation(message, ANIMALS, 5)


def test_a_value_may_stand_for_missing() -> None:
    mapping = FieldMapping("a/B", keypoints="points", missing=(-1,))
    places = [(-1, -1), (4, -1), (-2, 5), (1, 1)]
    message = SimpleNamespace(points=[SimpleNamespace(x=x, y=y) for x, y in places])
    seen = read_observation(message, mapping, 4)
    np.testing.assert_array_equal(seen.confidence, [[0, 0, 1, 1]])


@pytest.mark.parametrize("none", ["", "-1", -1])
def test_what_trackers_write_for_none_is_none(none: Any) -> None:
    mapping = FieldMapping("a/B", keypoints="points", identity="id")
    point = SimpleNamespace(x=1, y=1)
    assert read_observation(SimpleNamespace(points=[point], id=none), mapping, 1).identities == (
        None,
    )


@pytest.mark.parametrize("mapping", [*MAPPINGS.values(), ANIMALS], ids=lambda m: m.type)
@pytest.mark.parametrize(
    "message",
    [
        None,
        SimpleNamespace(detections=5, skeleton=5, found=5),
        SimpleNamespace(detections=[None], skeleton=[None] * 18, found=[None]),
        SimpleNamespace(
            skeleton=[SimpleNamespace(x="a", y="b", c="c")] * 18,
            detections=[
                SimpleNamespace(
                    id="", keypoints=SimpleNamespace(data=[SimpleNamespace(id="x", point=None)])
                )
            ],
            found=[SimpleNamespace(number=1, joints=[SimpleNamespace(label=[], place=None)])],
        ),
    ],
    ids=["nothing", "no lists", "empty", "no numbers"],
)
def test_messages_with_other_fields_are_refused(mapping: FieldMapping, message: Any) -> None:
    with pytest.raises(MessageError, match=f"message of type {mapping.type} does not fit"):
        read_observation(message, mapping, 18, size=(1, 1))


def test_how_many_keypoints_there_are(detectors: Any) -> None:
    some = detectors.detections([{"id": "", "points": points(17), "seen": [0, 11]}])
    assert count_keypoints(some, YOLO.type) == 12 and may_omit_keypoints(YOLO.type)
    body = detectors.skeleton(points(18))
    assert count_keypoints(body, SKELETON_2D.type) == 18 and not may_omit_keypoints(
        SKELETON_2D.type
    )
    assert count_keypoints(detectors.animals([]), ANIMALS) == 4 and not may_omit_keypoints(ANIMALS)
    assert count_keypoints(detectors.detections([]), YOLO.type) == 0


def test_a_keypoint_of_any_number_is_not_believed() -> None:
    far = SimpleNamespace(id=2**31 - 1, point=SimpleNamespace(x=1.0, y=1.0), score=1.0)
    keypoints = SimpleNamespace(data=[far])
    message = SimpleNamespace(detections=[SimpleNamespace(id="", keypoints=keypoints)])
    with pytest.raises(MessageError, match="2147483647"):
        count_keypoints(message, YOLO.type)


def structure(**fields: Any) -> SimpleNamespace:
    """Return a message of some fields."""
    return SimpleNamespace(**fields)


SEEN = points(4)
NAMES = ["head", "tail", "paw", "ear"]
BACK = [2, 0, 3, 1]  # an order in which messages may have the keypoints
POINTS = [structure(x=x, y=y, z=c) for x, y, c in SEEN.tolist()]
X, Y, SCORE = SEEN.T
SHAPES: dict[str, tuple[Any, dict[str, Any]]] = {
    "arrays of fixed size": (
        structure(points=[structure(kp=np.array([x, y]), s=[c]) for x, y, c in SEEN]),
        {"keypoints": "points", "x": "kp[0]", "y": "kp[1]", "confidence": "s[0]"},
    ),
    "one array for all": (
        structure(data=SEEN.ravel()),
        {"x": "data[0::3]", "y": "data[1::3]", "confidence": "data[2::3]"},
    ),
    "a field for each": (
        structure(a=structure(**dict(zip(NAMES, POINTS, strict=True)))),
        {"keypoints": tuple(f"a.{name}" for name in NAMES), "confidence": "z"},
    ),
    "numbers for each": (
        structure(
            **{f"{n}_{k}": getattr(p, k) for n, p in zip(NAMES, POINTS, strict=True) for k in "xyz"}
        ),
        {
            key: tuple(f"{n}_{k}" for n in NAMES)
            for key, k in (("x", "x"), ("y", "y"), ("confidence", "z"))
        },
    ),
    "parallel lists": (
        structure(xs=X, ys=[*Y], scores=[*SCORE]),
        {"x": "xs", "y": "ys", "confidence": "scores"},
    ),
    "names in a list of their own": (
        structure(p=[POINTS[i] for i in BACK], names=[NAMES[i] for i in BACK], s=SCORE[BACK]),
        {
            "x": "p[].x",
            "y": "p[].y",
            "confidence": "s",
            "keypoint_id": "names",
            "names": tuple(NAMES),
        },
    ),
    "names in the message": (
        structure(
            names=[NAMES[i] for i in BACK], found=[structure(x=X[BACK], y=Y[BACK], s=SCORE[BACK])]
        ),
        {
            "objects": "found",
            "x": "x",
            "y": "y",
            "confidence": "s",
            "keypoint_id": "/names",
            "names": tuple(NAMES),
        },
    ),
    "a prefix": (
        structure(found=[structure(p=POINTS + POINTS[:2], n=4)]),
        {"objects": "found", "keypoints": "p", "confidence": "z", "count": "n"},
    ),
    "a prefix of lists, by a code of the message": (
        structure(code=7, found=[structure(x=[*X, 0], y=[*Y, 0], s=[*SCORE, 0])]),
        {
            "objects": "found",
            "x": "x",
            "y": "y",
            "confidence": "s",
            "count": "/code",
            "counts": ((7, 4), (8, 5)),
        },
    ),
    "the first of many": (
        structure(p=POINTS + POINTS),
        {"keypoints": "p[:4]", "confidence": "z"},
    ),
    "nested lists": (
        structure(
            cameras=[
                structure(people=[]),
                structure(
                    people=[structure(limbs=[structure(p=POINTS[:3]), structure(p=POINTS[3:])])]
                ),
            ]
        ),
        {"objects": "cameras[].people", "keypoints": "limbs[].p", "confidence": "z"},
    ),
    "nested parallel lists": (
        structure(limbs=[structure(x=X[:1], p=POINTS[:1]), structure(x=X[1:], p=POINTS[1:])]),
        {"x": "limbs[].x", "y": "limbs[].p[].y", "confidence": "limbs[].p[].z"},
    ),
    "numbers of keypoints in a list of their own": (
        structure(x=X[BACK], y=Y[BACK], s=SCORE[BACK], ids=np.array(BACK) + 1),
        {"x": "x", "y": "y", "confidence": "s", "keypoint_id": "ids", "first_id": 1},
    ),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_any_shape_of_message_is_read(shape: str) -> None:
    message, fields = SHAPES[shape]
    mapping = FieldMapping("a/B", **fields)
    seen = read_observation(message, mapping, 4)
    np.testing.assert_allclose(seen.points, SEEN[None, :, :2], rtol=1e-6)
    np.testing.assert_allclose(seen.confidence, SEEN[None, :, 2], rtol=1e-6)
    assert count_keypoints(message, mapping) == 4


def test_identities_in_a_list_of_their_own() -> None:
    mapping = FieldMapping("a/B", objects="found", keypoints="p", identity="/ids", where="valid")
    found = [structure(valid=valid, p=POINTS) for valid in (True, False, True)]
    seen = read_observation(structure(found=found, ids=[4, 5, 6]), mapping, 4)
    assert seen.identities == ("4", "6")
    with pytest.raises(MessageError, match=r"identity \(/ids\) has 2; the message has 3 objects"):
        read_observation(structure(found=found, ids=[4, 5]), mapping, 4)


@pytest.mark.parametrize(
    ("missing", "expected"),
    [((-1.0,), [0, 0, 1, 1, 1]), ((-1.0, 9999.0), [0, 0, 1, 0, 1]), ("negative", [0, 0, 0, 1, 1])],
)
def test_markers_of_missing_keypoints(missing: Any, expected: list[int]) -> None:
    places = [(-1, -1), (-1, 8), (-3, 5), (9999, 9999), (1, 1), (0, 0), (np.nan, 3)]
    message = structure(p=[structure(x=x, y=y) for x, y in places])
    seen = read_observation(message, FieldMapping("a/B", "p", missing=missing), 7)
    np.testing.assert_array_equal(seen.confidence[0], [*expected, 0, 0])


def test_pixels_of_a_scaled_image_and_percent() -> None:
    mapping = FieldMapping(
        "a/B", "p", confidence="c", units=(224, 224), max_confidence=100, missing="negative"
    )
    message = structure(p=[structure(x=112, y=224, c=50), structure(x=-1, y=-1, c=90)])
    seen = read_observation(message, mapping, 2, size=(1280, 720))
    np.testing.assert_allclose(seen.points[0, 0], [640, 720])
    np.testing.assert_allclose(seen.confidence[0], [0.5, 0])
    with pytest.raises(MessageError, match="are pixels of 224 x 224: the size of the image is"):
        read_observation(message, mapping, 2)


PLACE = structure(u=1.0, v=2.0)
PERSON = structure(kps=[structure(kp=np.array([1.0, 2.0]), at=PLACE, name="nose")], n=2, ids=["a"])
PEOPLE = structure(header=None, people=[PERSON])


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"objects": "peple"}, "objects is 'peple', and the message is .* its fields are header, "),
        ({"objects": "header"}, "objects is 'header', and that is None, not a list"),
        ({"keypoints": "kp"}, "keypoints is 'kp', and the object is .* its fields are kps, n, ids"),
        ({"keypoints": "n"}, "keypoints is 'n', and that is 2, not a list"),
        ({"x": "kp"}, r"x is 'kp', and that is a list of 2, not a number: write kp\[0\]"),
        ({"x": "kp[2]"}, r"x is 'kp\[2\]', and kp is a list of 2: it has no item \[2\]"),
        ({"x": "at"}, "x is 'at', and that is .* go on to one of its fields, like at.u"),
        ({"x": "at.x"}, "x is 'at.x', and at is .* its fields are u, v"),
        ({"x": "name"}, "x is 'name', and that is 'nose', not a number"),
        ({"x": "at[0]"}, r"x is 'at\[0\]', and at is .*, which has no items"),
        ({"keypoints": "kps.at"}, r"kps is a list of 1, which has no field 'at': \[\] after it"),
        ({"where": "valid"}, "where is 'valid', and the object is .* no field 'valid'"),
        ({"keypoint_id": "id"}, "keypoint_id is 'id', and the keypoint is .* are kp, at, name"),
        ({"keypoint_id": "name"}, "name of a keypoint is 'nose', which is no number: list the"),
        ({"count": "ids"}, "count is 'ids', and that is a list of 1, not a number"),
        ({"count": "n"}, "n says 2 keypoints; kps has 1"),
        ({"keypoints": "", "x": "kps[].kp[0]", "y": "ids[]"}, "items are no numbers: one is 'a'"),
        ({"keypoints": "", "x": "kps[].kp[0]", "y": "kps[:0]"}, "of one length: x .* has 1, y"),
        ({"keypoints": "", "x": "n", "y": "n"}, "x is 'n', and that is 2, not a list"),
        ({"keypoints": ("kps[0]", "nose")}, "keypoints is 'nose', and the object is"),
    ],
)
def test_what_does_not_fit_is_named_with_what_is_there(fields: dict[str, Any], reason: str) -> None:
    right: dict[str, Any] = {"objects": "people", "keypoints": "kps", "x": "kp[0]", "y": "kp[1]"}
    assert read_observation(PEOPLE, FieldMapping("a/B", **right), 1).points.shape == (1, 1, 2)
    with pytest.raises(MessageError, match=reason):
        read_observation(PEOPLE, FieldMapping("a/B", **right | fields), 1)


def test_the_layout_is_not_blamed_for_first_id() -> None:
    message = structure(p=[structure(x=1, y=2, id=0)])
    with pytest.raises(MessageError, match="id of a keypoint is 0; first_id of the mapping is 1"):
        read_observation(message, FieldMapping("a/B", "p", keypoint_id="id", first_id=1), 17)


def test_places_that_are_not_filled_are_told_from_keypoints() -> None:
    message = structure(p=[*POINTS, *[structure(x=0.0, y=0.0)] * 6])
    with pytest.raises(MessageError, match=r"10 places .* first 4 are filled; .* write p\[:4\] in"):
        read_observation(message, FieldMapping("a/B", "p"), 4)
    with pytest.raises(MessageError, match="layout has 3: write .* and name the layout"):
        read_observation(message, FieldMapping("a/B", "p"), 3)
    with pytest.raises(MessageError, match="10 keypoints .* has 5: name the layout"):
        read_observation(message, FieldMapping("a/B", "p"), 5)
