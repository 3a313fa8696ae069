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
        missing=-1,
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
        ("type: a/B\nkeypoints: [k]", "keypoints is a list"),
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
