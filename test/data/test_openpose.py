# SPDX-License-Identifier: Apache-2.0
"""OpenPose JSON becomes observations; the subject is the largest person."""

import json

import numpy as np
import pytest

from deep_nrsfm_ros.data.openpose import largest, read_people


def person(size: float, q: int = 25) -> dict[str, list[float]]:
    """Return a person whose keypoints lie on a diagonal of `size` pixels."""
    line = np.linspace(10, 10 + size, q)
    return {"pose_keypoints_2d": np.stack([line, line, np.full(q, 0.5)], -1).ravel().tolist()}


def test_people_and_the_largest() -> None:
    small, large, nobody = person(50), person(200), {"pose_keypoints_2d": [0.0] * 75}
    large["pose_keypoints_2d"][3:6] = [0, 0, 0]
    people = read_people(json.dumps({"people": [small, nobody, large]}), 25)
    assert people.points.shape == (3, 25, 2) and largest(people) == 2
    np.testing.assert_array_equal(people.confidence[2], [0.5, 0, *[0.5] * 23])
    assert not people.confidence[1].any()


def test_no_one_there() -> None:
    people = read_people('{"people": []}', 25)
    assert people.points.shape == (0, 25, 2) and largest(people) is None


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "not a frame"),
        ("[]", "not a frame"),
        ('{"people": [{}]}', "not a frame"),
        ('{"people": [{"pose_keypoints_2d": "x"}]}', "not a frame"),
        (json.dumps({"people": [person(5, 18)]}), "18 keypoints; expected 25"),
    ],
)
def test_other_json_is_refused(text: str, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        read_people(text, 25)
