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
    mapping = FieldMapping("a/B", keypoints="points", missing=-1)
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
    with pytest.raises(MessageError, match=f"expected a message of type {mapping.type}"):
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
