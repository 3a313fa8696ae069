# SPDX-License-Identifier: Apache-2.0
"""Layout files say what a layout is; whatever else they hold is refused by name."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.layouts import presets
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.layout_file import LayoutFileError, read_layout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.model_files.find_layout import find_layout
from deep_nrsfm_ros.model_files.model_file import Model, save_model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser

EXAMPLES = sorted((Path(__file__).parents[2] / "config" / "layouts").glob("*.yaml"))
DOOR = """
name: door
keypoints: [hinge_top, hinge_bottom, handle, corner_top, corner_bottom]
edges:
  - [hinge_top, hinge_bottom]
  - [corner_top, corner_bottom]
rigid:
  - [hinge_top, corner_bottom]
handedness: {left: hinge_bottom, right: corner_bottom, up: hinge_top, front: handle}
reference: [hinge_top, hinge_bottom]
reference_length: 2
derived:
  handle: [corner_top, corner_bottom]
top: hinge_top
bottom: [hinge_bottom, corner_bottom]
"""
LEAST = "name: thing\nkeypoints: [a, b, c, d]\n"


def write(folder: Path, text: str | bytes, name: str = "thing.yaml") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def refused(path: Path) -> str:
    with pytest.raises(LayoutFileError) as caught:
        read_layout(path)
    message = str(caught.value)
    assert isinstance(caught.value, ValueError) and message.startswith(f"layout file {path}: ")
    assert len(message) < 1000 and "\n" not in message
    return message


def test_every_field_arrives(tmp_path: Path) -> None:
    assert read_layout(write(tmp_path, DOOR)) == KeypointLayout(
        "door",
        ("hinge_top", "hinge_bottom", "handle", "corner_top", "corner_bottom"),
        edges=(("hinge_top", "hinge_bottom"), ("corner_top", "corner_bottom")),
        handedness=(("hinge_bottom", "corner_bottom", "hinge_top", "handle"),),
        reference=("hinge_top", "hinge_bottom"),
        derived={"handle": ("corner_top", "corner_bottom")},
        reference_length=2.0,
        top=("hinge_top",),
        bottom=("hinge_bottom", "corner_bottom"),
        rigid=(("hinge_top", "corner_bottom"),),
    )


def test_handedness_may_be_several(tmp_path: Path) -> None:
    text = (
        "handedness:\n"
        "  - {left: a, right: b, up: c, front: d}\n"
        "  - {front: c, up: a, right: d, left: b}\n"
    )
    several = read_layout(write(tmp_path, LEAST + text)).handedness
    assert several == (("a", "b", "c", "d"), ("b", "d", "a", "c"))


def test_name_and_keypoints_are_enough(tmp_path: Path) -> None:
    expected = KeypointLayout("thing", ("a", "b", "c", "d"))
    assert read_layout(write(tmp_path, LEAST)) == expected
    empty = "edges:\nrigid:\nhandedness:\nreference:\nreference_length:\nderived:\n"
    assert read_layout(write(tmp_path, LEAST + empty)) == expected


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_are_sound(path: Path) -> None:
    layout = read_layout(path)
    joined = {name for edge in layout.edges for name in edge}
    assert len(joined) >= 0.6 * len(layout) and joined <= set(layout.keypoints)


def test_there_are_examples() -> None:
    names = {path.stem: read_layout(path) for path in EXAMPLES}
    assert set(names) == {"excavator", "hand", "mouse22", "fly12", "chair10", "bird15", "car20"}
    # What a user copies has everything.
    for layout in (names["excavator"], names["hand"]):
        assert layout.handedness and layout.reference and layout.reference_length
        assert {name for edge in layout.edges for name in edge} == set(layout.keypoints)
    # Places that MediaPipe documents.
    hand = names["hand"]
    assert len(hand) == 21
    for place, name in {0: "wrist", 4: "thumb_tip", 5: "index_mcp", 12: "middle_tip"}.items():
        assert hand.index(name) == place
    assert (hand.index("ring_mcp"), hand.index("pinky_tip")) == (13, 20)


BAD: dict[str, tuple[str | bytes, str]] = {
    "unknown field": (LEAST + "skeleton: []", "no field 'skeleton'; the fields are name, keyp"),
    "like a field": (LEAST + "egdes: []", "no field 'egdes'; did you mean 'edges'?"),
    "keypoint of an edge": (
        DOOR.replace("  - [hinge_top, hinge", "  - [hinge_tpo, hinge", 1),
        "has no keypoint 'hinge_tpo', which edges names; did you mean 'hinge_top' or",
    ),
    "number as a field": (LEAST + "7: 8", "no field 7"),
    "field twice": (LEAST + "name: other", "the field 'name' 2 times"),
    "no name": ("keypoints: [a, b, c, d]", "lacks the field 'name'"),
    "no keypoints": ("name: thing", "lacks the field 'keypoints'"),
    "empty keypoints": ("name: thing\nkeypoints:", "lacks the field 'keypoints'"),
    "name is a list": ("name: [a]\nkeypoints: [a, b, c, d]", "name is a list"),
    "keypoints are one text": (
        "name: x\nkeypoints: a b c d",
        "keypoints is 'a b c d'; it must be a",
    ),
    "keypoint is a number": ("name: x\nkeypoints: [a, b, c, 4]", "keypoints[3] is 4"),
    "keypoint is a boolean": ("name: x\nkeypoints: [a, on, c, d]", "keypoints[1] is True"),
    "keypoint is blank": ("name: x\nkeypoints: [a, ' ', c, d]", "keypoints[1] is ' '"),
    "keypoint twice": ("name: x\nkeypoints: [a, b, c, d, b]", "b more than once"),
    "too few keypoints": ("name: x\nkeypoints: [a, b, c]", "3 keypoints; at least 4"),
    "edge to a stranger": (LEAST + "edges: [[a, z]]", "no keypoint 'z'"),
    "edge of three": (LEAST + "edges: [[a, b], [a, b, c]]", "edges[1] has 3 names"),
    "edge to itself": (LEAST + "edges: [[a, a]]", "repeats a name"),
    "edges are a mapping": (LEAST + "edges: {a: b}", "edges is a mapping"),
    "edge is a text": (LEAST + "edges: [a-b]", "edges[0] is 'a-b'"),
    "handedness of names": (
        LEAST + "handedness: [a, b, c, d]",
        "handedness[0] is 'a'; it must be a ma",
    ),
    "handedness is a text": (LEAST + "handedness: a", "handedness is 'a'; it must be a mapping"),
    "half of the second": (
        LEAST + "handedness: [{left: a, right: b, up: c, front: d}, {up: a}]",
        "handedness[1] names 'up'",
    ),
    "half of handedness": (LEAST + "handedness: {left: a, right: b}", "must name left, right, up"),
    "handedness repeats": (LEAST + "handedness: {left: a, right: b, up: c, front: c}", "repeats"),
    "handedness of a stranger": (
        LEAST + "handedness: {left: a, right: b, up: c, front: z}",
        "no keypoint 'z'",
    ),
    "reference of one": (LEAST + "reference: [a]", "reference has 1 names"),
    "length of nothing": (LEAST + "reference_length: 1", "name reference"),
    "length with a unit": (LEAST + "reference: [a, b]\nreference_length: 9 cm", "is '9 cm'; it mu"),
    "length is true": (LEAST + "reference: [a, b]\nreference_length: yes", "is True; it must"),
    "length is 0": (LEAST + "reference: [a, b]\nreference_length: 0", "is 0.0, not above"),
    "length is NaN": (LEAST + "reference: [a, b]\nreference_length: .nan", "is nan, not above"),
    "derived stranger": (LEAST + "derived: {z: [a, b]}", "no keypoint 'z'"),
    "derived of nothing": (LEAST + "derived: {d: []}", "'d' is a mean of no names"),
    "derived of a text": (LEAST + "derived: {d: a}", "derived.d is 'a'; it must be a list"),
    "empty": ("", "is empty; it must hold fields"),
    "list": ("- a", "is a list"),
    "text": ("hand", "is 'hand'"),
    "no YAML": ("name: [", "is not YAML"),
    "tab": ("name:\n\t- a", "is not YAML"),
    "code": ("!!python/object/apply:os.system ['true']", "is not YAML"),
    "bytes": (b"\xff\xfe\x00\xd8", "is not YAML"),
    "impossible date": ("name: 2001-99-99", "is not YAML"),
    "deep": ("[" * 30_000, "nested deeper than 8"),
    "huge": ("#" * 100_000, "larger than 64 KiB"),
    "long value": (f"name: x\nkeypoints: {'a' * 10_000}", "aaa..."),
}


@pytest.mark.parametrize(("text", "complaint"), BAD.values(), ids=BAD)
def test_what_no_layout_can_be_is_refused(
    tmp_path: Path, text: str | bytes, complaint: str
) -> None:
    assert complaint in refused(write(tmp_path, text))


def test_a_text_that_grows_without_end_is_refused_shortly(tmp_path: Path) -> None:
    lines = [
        "a0: &a0 [x, x]",
        *(f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 20)),
    ]
    assert "has the alias *a0" in refused(write(tmp_path, "\n".join(lines)))
    lines.append("name: *a19\nkeypoints: *a19")
    refused(write(tmp_path, "\n".join(lines)))


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.binary(max_size=200))
def test_any_bytes_are_refused(tmp_path: Path, data: bytes) -> None:
    refused(write(tmp_path, data))


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    assert "cannot be read: No such file" in refused(tmp_path / "absent.yaml")
    assert "not a regular file" in refused(tmp_path)
    os.mkfifo(tmp_path / "pipe.yaml")
    assert "not a regular file" in refused(tmp_path / "pipe.yaml")


def test_a_layout_is_found_by_preset_layout_file_and_model_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert find_layout("--object", "human17") is HUMAN17
    assert find_layout("--object", str(write(tmp_path, DOOR, "door.yml"))).name == "door"
    monkeypatch.setenv("HOME", str(tmp_path))
    layout = find_layout("--object", "~/door.yml")
    network = initialise(Architecture(widths=(4,)), len(layout), np.random.default_rng(0))
    frame = np.eye(3, dtype=np.float32)
    save_model(tmp_path / "m.safetensors", Model("m", network, layout, Normaliser(), frame))
    assert find_layout("--object", str(tmp_path / "m.safetensors")) == layout


@pytest.mark.parametrize(
    ("word", "complaint"),
    [
        ("horse", r"--object is 'horse'; name a preset \(human17.*layout file \(\.yaml\)"),
        ("COCO17", r"'COCO17'; name a preset \(did you mean 'coco17'\?\), a layout file"),
        ("", r"--object is ''; name a preset \(human17"),
        ("absent.yaml", "layout file absent.yaml: cannot be read"),
        ("absent.safetensors", "cannot read model absent.safetensors"),
    ],
)
def test_a_layout_that_is_not_there_is_refused(word: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        find_layout("--object", word)


def test_a_copy_of_a_preset_needs_a_name_of_its_own(tmp_path: Path) -> None:
    copy = write(tmp_path, Path(presets.__file__).with_name("coco17.yaml").read_bytes())
    with pytest.raises(
        LayoutFileError, match=f"layout file {copy}: name 'coco17' is that of a pre"
    ):
        find_layout("--object", str(copy))
    copy.write_text(copy.read_text().replace("name: coco17", "name: mine"))
    assert find_layout("--object", str(copy)).keypoints == presets.COCO17.keypoints


def test_little_text_that_stands_for_much_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.yaml"
    merged = "".join(
        f"a{i + 1}: &a{i + 1} {{<<: [{', '.join([f'*a{i}'] * 9)}]}}\n" for i in range(9)
    )
    for text, complaint in {
        "a0: &a0 {x: y}\n" + merged: "has the alias *a0",
        "name: &n x\nkeypoints: [*n, *n, *n, *n]": "has the alias *n",
        "name: " + "[" * 30000: "nested deeper than 8",
        "name: " + "{a: " * 9: "nested deeper than 8",
        "name: !!int ''\nkeypoints: []": "is not YAML",
        "name: !!timestamp x": "is not YAML",
        "name: !!python/object/apply:os.system [true]": "is not YAML",
    }.items():
        path.write_text(text)
        with pytest.raises(LayoutFileError) as refusal:
            read_layout(path)
        assert complaint in str(refusal.value)
