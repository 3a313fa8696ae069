# SPDX-License-Identifier: Apache-2.0
"""What was lifted is written, read back and looked at as the lifter answered it."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.data.bag_files import BagError, lifter_topics, open_bag
from deep_nrsfm_ros.data.bag_topics import keypoint_topics
from deep_nrsfm_ros.data.detections import Detections, gather, stamps_at
from deep_nrsfm_ros.data.keypoint_files import read_keypoints
from deep_nrsfm_ros.data.lifted_bags import (
    KEYPOINTS,
    POINTS,
    LiftedMessage,
    has_lifted_messages,
    read_lifted_messages,
    write_lifted_bag,
)
from deep_nrsfm_ros.data.lifted_files import check_output, write_recording
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.data.recording import Recording, join_lifted_messages, lift_recording
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.presets import BODY25, HUMAN17
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter
from deep_nrsfm_ros.lifting.observation import Observation, to_observation
from deep_nrsfm_ros.model_files.model_file import Model, load_model
from deep_nrsfm_ros.nrsfm.geometry import quaternion, rotation_from_quaternion
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser

COUNTS = (2, 0, 1, 1)


def people() -> Detections:
    """Return four frames; in the last one hardly anything of the person is seen."""
    rng = np.random.default_rng(0)
    values = np.concatenate(
        [rng.uniform(1, 900, (sum(COUNTS), 25, 2)), np.full((sum(COUNTS), 25, 1), 0.75)], -1
    )
    values[-1, 3:] = 0
    whole = to_observation(values)
    parts = np.split(np.arange(len(values)), np.cumsum(COUNTS)[:-1])
    frames = [Observation(whole.points[p], whole.confidence[p]) for p in parts]
    return gather(frames, stamps_at(10, len(COUNTS)) + 10**18, 25, "cam")


@pytest.fixture(scope="module")
def recording() -> Recording:
    net = initialise(Architecture(widths=(8, 4)), 17, np.random.default_rng(0))
    model = Model("mine", net, HUMAN17, Normaliser(), np.eye(3, dtype=np.float32))
    return lift_recording(people(), BODY25, Lifter(model))


def test_lifts_everyone_who_is_seen_well_enough(recording: Recording) -> None:
    assert recording.is_lifted.tolist() == [True, True, True, False]
    points, confidence = KeypointMap(BODY25, HUMAN17)(
        recording.detections.points, recording.detections.confidence
    )
    assert recording.lifted.shapes.shape == (4, 17, 3) and points.shape == (4, 17, 2)
    assert (recording.lifted.confidence[:3] > 0).any()


def test_head_and_shoulders_alone_are_nobody() -> None:
    everyone = people()
    shown = np.isin(BODY25.keypoints, ("nose", "neck", "left_shoulder", "right_shoulder"))
    everyone.confidence[1:3] *= shown
    lifter = Lifter(load_model("human"))
    assert lift_recording(everyone, BODY25, lifter).is_lifted.tolist() == [1, 0, 0, 0]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_bags_give_back_what_was_lifted(tmp_path: Path, recording: Recording, storage: str) -> None:
    bag = tmp_path / "bag"
    assert write_lifted_bag(bag, recording.detections, recording.lifted, storage) == 4 + 2 + 2
    assert has_lifted_messages(bag)
    seen = read_keypoints(
        bag, ReadOptions(layout=BODY25)
    )  # not the answers, though they are of a keypoint type
    np.testing.assert_array_equal(seen.points, recording.detections.points)
    np.testing.assert_array_equal(seen.stamps, recording.detections.stamps)
    assert seen.frame_id == "cam"
    again = join_lifted_messages(read_lifted_messages(bag), seen, BODY25, HUMAN17)
    was = recording.lifted
    np.testing.assert_array_equal(again.lifted.shapes, was.shapes)
    np.testing.assert_array_equal(again.lifted.confidence, was.confidence)
    np.testing.assert_allclose(again.lifted.rotations[[0, 2]], was.rotations[[0, 2]], atol=1e-6)
    assert np.isnan(again.lifted.rotations[1]).all()  # only that of the first is published
    np.testing.assert_allclose(again.lifted.scale, was.scale, rtol=1e-4)
    np.testing.assert_allclose(again.lifted.translation, was.translation, atol=1e-2)
    with pytest.raises(ValueError, match="points are 17 an object; the model has 25 keypoints"):
        join_lifted_messages(read_lifted_messages(bag), seen, BODY25, BODY25)
    with pytest.raises(BagError, match="exists already"):
        write_lifted_bag(bag, recording.detections, recording.lifted)


def test_answers_without_keypoints_are_shown_alone(tmp_path: Path, recording: Recording) -> None:
    write_lifted_bag(tmp_path / "bag", recording.detections, recording.lifted)
    alone = join_lifted_messages(read_lifted_messages(tmp_path / "bag"), None, BODY25, HUMAN17)
    assert alone.detections.frame.tolist() == [0, 0, 1] and not alone.detections.confidence.any()
    np.testing.assert_array_equal(alone.lifted.shapes, recording.lifted.shapes[:3])
    assert np.isnan(alone.lifted.scale).all()


def test_answers_far_from_any_keypoints_are_of_none(recording: Recording, tmp_path: Path) -> None:
    write_lifted_bag(tmp_path / "bag", recording.detections, recording.lifted)
    answers = [a._replace(stamp=a.stamp + 10**12) for a in read_lifted_messages(tmp_path / "bag")]
    assert not join_lifted_messages(answers, recording.detections, BODY25, HUMAN17).is_lifted.any()
    nobody = gather([], [], 25)
    assert not len(join_lifted_messages(answers, nobody, BODY25, HUMAN17).detections)


def test_a_lifter_is_known_by_its_topics(tmp_path: Path, recording: Recording) -> None:
    write_lifted_bag(tmp_path / "bag", recording.detections, recording.lifted)
    with closing(open_bag(tmp_path / "bag")) as bag:
        assert [points.name for points, _ in lifter_topics(bag)] == [POINTS]
        for name, expected in (("", KEYPOINTS), (POINTS, POINTS)):
            assert [found.topic.name for found in keypoint_topics(bag, name, None)] == [expected]


def test_npz_holds_every_object(tmp_path: Path, recording: Recording) -> None:
    write_recording(tmp_path / "out.npz", recording, "mine")
    with np.load(tmp_path / "out.npz") as file:
        for name, values in recording.lifted._asdict().items():
            np.testing.assert_array_equal(file[name], values)
        assert file["frame"].tolist() == [0, 0, 2, 3] and file["identities"].tolist() == [
            "0",
            "1",
            "0",
            "0",
        ]
        assert file["stamps"].tolist() == recording.detections.stamps.tolist()
        assert file["names"].tolist() == list(HUMAN17.keypoints)
        assert file["edges"].tolist() == [list(edge) for edge in HUMAN17.edge_indices()]
        assert str(file["model"]) == "mine"


def test_json_leaves_out_who_was_not_lifted(tmp_path: Path, recording: Recording) -> None:
    write_recording(tmp_path / "out.json", recording, "mine")
    document = json.loads((tmp_path / "out.json").read_text())
    assert [len(frame["objects"]) for frame in document["frames"]] == [2, 0, 1, 0]
    second = document["frames"][0]["objects"][1]
    assert second["identity"] == "1" and document["keypoints"] == list(HUMAN17.keypoints)
    np.testing.assert_allclose(second["shapes"], recording.lifted.shapes[1], atol=1e-5)
    np.testing.assert_allclose(second["rotations"], recording.lifted.rotations[1], atol=1e-5)


def test_outputs_that_cannot_be_are_refused_at_once(tmp_path: Path) -> None:
    for name, expected in {
        "out.bvh": "suffix '.bvh'; expected .npz, .json, or none for a bag",
        "nowhere/out.npz": "folder .*nowhere of out.npz does not exist",
        "": "exists already",
    }.items():
        with pytest.raises(ValueError, match=expected):
            check_output(tmp_path / name)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_quaternions_and_rotations_are_the_same(seed: int) -> None:
    R = Rotation.random(random_state=np.random.default_rng(seed)).as_matrix()
    np.testing.assert_allclose(rotation_from_quaternion(quaternion(R)), R, atol=1e-12)


LEVEL = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.float32)  # from the camera to base_link


def standing(frame_id: str) -> tuple[Recording, Detections]:
    """Return two people that stand before a level camera, and their keypoints of a frame."""
    rng = np.random.default_rng(0)
    shape = rng.normal(0, (0.2, 0.8, 0.2), (17, 3))  # in the camera's axes, y down
    shapes = (shape + [[[0, 0, 4]], [[1, 0, 5]]]).astype(np.float32)
    points = (600 * shapes[..., :2] / shapes[..., 2:] + 400).astype(np.float32)
    sure = np.ones((2, 17), np.float32)
    seen = gather([Observation(points, sure)], [10**18], 17, frame_id)
    none = np.full(2, np.nan, np.float32)
    R = np.tile(np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], np.float32), (2, 1, 1))
    lifted = Lifted(shapes, R, none, np.full((2, 2), np.nan, np.float32), none, sure, sure < 0)
    return Recording(HUMAN17, HUMAN17, seen, lifted), seen


@pytest.mark.parametrize("camera", ["cam", ""])  # the detector may not name its camera
def test_points_in_a_fixed_frame_stand(camera: str) -> None:
    recording, seen = standing(camera)
    shapes, R, confidence = (
        getattr(recording.lifted, n) for n in ("shapes", "rotations", "confidence")
    )
    as_is = LiftedMessage(10**18, shapes, confidence, R[0], camera)
    joined = join_lifted_messages([as_is], seen, HUMAN17, HUMAN17)
    assert joined.fixed_frame == "" and np.isfinite(joined.lifted.scale).all()
    np.testing.assert_array_equal(joined.lifted.shapes, shapes)
    fixed = as_is._replace(
        shapes=shapes @ LEVEL.T + [0, 0, 1.1], rotation=LEVEL @ R[0], frame_id="base_link"
    )
    joined = join_lifted_messages([fixed], seen, HUMAN17, HUMAN17)
    assert joined.fixed_frame == "base_link"
    np.testing.assert_allclose(joined.lifted.shapes, shapes - [0, 1.1, 0], atol=1e-5)
    np.testing.assert_allclose(joined.lifted.rotations[0], R[0], atol=1e-6)
    alone = join_lifted_messages([fixed], None, HUMAN17, HUMAN17, "base_link")
    np.testing.assert_allclose(alone.lifted.shapes, joined.lifted.shapes)


def test_points_of_several_cameras_are_in_no_fixed_frame() -> None:
    recording, seen = standing("cam")
    first = LiftedMessage(10**18, recording.lifted.shapes, recording.lifted.confidence, None, "cam")
    messages = [first, first._replace(stamp=10**18 + 10**10, frame_id="other")]
    assert join_lifted_messages(messages, seen, HUMAN17, HUMAN17).fixed_frame == ""


def test_bags_give_back_the_frame_of_the_points(tmp_path: Path, recording: Recording) -> None:
    write_lifted_bag(tmp_path / "bag", recording.detections, recording.lifted)
    assert {each.frame_id for each in read_lifted_messages(tmp_path / "bag")} == {"cam"}
