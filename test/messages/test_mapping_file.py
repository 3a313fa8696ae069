# SPDX-License-Identifier: Apache-2.0
"""Field mappings as people write them."""

from pathlib import Path

import pytest

from deep_nrsfm_ros.messages.field_mapping import FieldMapping
from deep_nrsfm_ros.messages.mapping_file import MappingError, read_mapping

SHIPPED = sorted((Path(__file__).parents[2] / "config" / "mappings").glob("*.yaml"))
WHOLE = """
type: my_msgs/msg/Animals
objects: found
identity: number
keypoints: joints
x: place.u
y: place.v
confidence: sure
keypoint_id: label
names: [head, tail]
where: valid
count: size
counts: {0: 2}
max_confidence: 100
units: normalised
missing: -1
first_id:
"""


def test_every_field_is_read(tmp_path: Path) -> None:
    path = tmp_path / "mapping.yaml"
    path.write_text(WHOLE)
    assert read_mapping(path) == FieldMapping(
        "my_msgs/Animals",
        objects="found",
        identity="number",
        keypoints="joints",
        x="place.u",
        y="place.v",
        confidence="sure",
        keypoint_id="label",
        names=("head", "tail"),
        units="normalised",
        where="valid",
        count="size",
        counts=((0, 2),),
        max_confidence=100,
        missing=(-1,),
    )


def test_those_that_come_along_are_read() -> None:
    types = {read_mapping(path).type for path in SHIPPED}
    assert {"ros_openpose/Frame", "opendr_interface/OpenDRPose2D"} < types


def test_the_first_explains_every_field() -> None:
    (text,) = (p.read_text() for p in SHIPPED if p.stem == "media_pipe_ros2")
    for name in FieldMapping.__dataclass_fields__:
        assert f"\n{name}:" in text or f"\n# {name}:" in text


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("type: a/B", "lacks the field 'keypoints'"),
        ("keypoints: k", "lacks the field 'type'"),
        ("type: B\nkeypoints: k", "type is 'B'; it must be like my_msgs/People"),
        ("type: a/B\nkeypoints: k\nunit: pixels", "no field 'unit'; the fields are type, "),
        ("type: a/B\nkeypoints: k\nunits: inches", "units is 'inches'"),
        ("type: a/B\nkeypoints: k\nunits: []", "units is a list"),
        ("type: a/B\nkeypoints: 'k.'", "keypoints is 'k.'; it must be a field"),
        ("type: a/B\nkeypoints: k\nx: _dict__.a", "x is '_dict__.a'"),
        ("type: a/B\nkeypoints: [[k]]", "keypoints is a list; it must be a field"),
        ("type: a/B\nkeypoints: {a: k}", "keypoints is a mapping; it must be a field"),
        ("type: a/B\nkeypoints: [a, b]\nkeypoint_id: i", "keypoints names a field for each"),
        ("type: a/B\nkeypoints: [a, b]\ncount: n", "count is there, but keypoints names a field"),
        ("type: a/B\nkeypoints: [a, 'b[]']", "keypoints is 'b[]'; it must lead to one value"),
        ("type: a/B\nkeypoints: /k", "it begins at the object, without /"),
        ("type: a/B\nobjects: /k\nkeypoints: k", "it begins at the message, without /"),
        ("type: a/B\nkeypoints: k\nx: kp.0", "an index is in brackets: kp[0]"),
        ("type: a/B\nkeypoints: k\nx: kp[-1]", "x is 'kp[-1]'; it must be a field"),
        ("type: a/B\nkeypoints: k\nx: 'kp[0::0]'", "it must be a field"),
        ("type: a/B\nkeypoints: k\nx: 'xs[]'", "leave out keypoints where x and y are lists"),
        ("type: a/B\nkeypoints: k\nx: [a, b]", "leave out keypoints where x and y are lists"),
        ("type: a/B\nkeypoints: k\nkeypoint_id: /names", "leave out keypoints where"),
        ("type: a/B\nx: xs", "or x and y, the lists of their coordinates"),
        ("type: a/B\nx: [a, b]\ny: [c]", "x, y and confidence name 2, 1 fields"),
        ("type: a/B\nx: a\ny: b\nidentity: 'c[]'", "it must lead to one value, without []"),
        ("type: a/B\nkeypoints: k\ncount: n\ncounts: [18]", "like {0: 18, 1: 34}"),
        ("type: a/B\nkeypoints: k\ncounts: {0: 18}", "but no count whose values they are"),
        ("type: a/B\nkeypoints: k\nmissing: none", "a list of numbers, or negative"),
        ("type: a/B\nkeypoints: k\nmax_confidence: 0", "max_confidence is 0; it must be above"),
        ("type: a/B\nkeypoints: k\nfirst_id: 1", "there is no keypoint_id that counts from it"),
        ("type: a/B\nkeypoints: k\nkeypoint_id: i\nnames: [a]\nfirst_id: 1", "have names"),
        ("type: a/B\nkeypoints: k\nunits: [224]", "like [224, 224]"),
        ("type: a/B\nkeypoints: k\nfirst_id: one", "first_id is 'one'; it must be a number"),
        ("type: a/B\nkeypoints: k\nmissing: true", "missing is True"),
        ("type: a/B\nkeypoints: k\nnames: [a, b]", "no keypoint_id"),
        ("type: a/B\nkeypoints: k\nkeypoint_id: i\nnames: [a, a]", "a name twice"),
        ("type: a/B\nkeypoints: k\nkeypoint_id: i\nnames: [a, 2]", "in quotes if need be"),
        ("type: a/B\ntype: c/D", "has the field 'type' 2 times"),
        ("[1]", "is a list"),
        ("a: [", "is not YAML"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "mapping.yaml"
    path.write_text(text)
    with pytest.raises(MappingError) as error:
        read_mapping(path)
    assert reason in str(error.value) and str(path) in str(error.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(MappingError, match="nowhere.yaml: cannot be read"):
        read_mapping(tmp_path / "nowhere.yaml")
