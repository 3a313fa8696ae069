# SPDX-License-Identifier: Apache-2.0
"""A file that names its keypoints as the model does loses none, whatever the spelling of both."""

from __future__ import annotations

import dataclasses
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.commands.lift import main
from deep_nrsfm_ros.data.formats.names import NAMED_BY_INPUT, layout_of_names
from deep_nrsfm_ros.data.keypoint_files import KeypointFileError, read_keypoints
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.data.resolve_layout import check_names
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import COCO17, HUMAN25
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.model_files.model_file import load_model, save_model

MOUSE = KeypointLayout(
    "mouse", ("EarL", "EarR", "Snout", "WristL", "Shoulder_right", "Nose", "Haunch_left")
)
SPELLINGS = {
    "equal": MOUSE.keypoints,
    "presets": (
        "left_ear",
        "right_ear",
        "snout",
        "left_wrist",
        "right_shoulder",
        "nose",
        "l_haunch",
    ),
    "mixed": ("ear_l", "Ear R", "SNOUT", "LWrist", "shoulder-right", "nose", "HaunchLeft"),
}
Q = len(MOUSE)
POINTS = np.random.default_rng(0).uniform(100, 500, (4, Q, 2)).astype(np.float32)


def write(kind: str, folder: Path, names: tuple[str, ...], points: np.ndarray = POINTS) -> Path:
    """Write named keypoints as a file of any kind; return its path."""
    rows = points.astype(float).tolist()
    if kind == "npz":
        np.savez(folder / "a.npz", points=points, names=names)
        return folder / "a.npz"
    if kind == "csv":
        head = ",".join(f"{name}_x,{name}_y" for name in names)
        path = folder / "a.csv"
        lines = [f"{i},{','.join(map(str, sum(row, [])))}" for i, row in enumerate(rows)]
        path.write_text("\n".join([f"frame,{head}", *lines]))
        return path
    if kind == "DeepLabCut":
        each = [
            ["scorer", *["me"] * 3 * len(names)],
            ["bodyparts", *(name for name in names for _ in range(3))],
            ["coords", *["x", "y", "likelihood"] * len(names)],
            *([str(i), *(str(v) for xy in row for v in (*xy, 1.0))] for i, row in enumerate(rows)),
        ]
        path = folder / "a.csv"
        path.write_text("\n".join(map(",".join, each)))
        return path
    content: Any = [dict(zip(names, row, strict=True)) for row in rows]
    if kind == "COCO":
        content = {
            "categories": [{"id": 1, "name": "mouse", "keypoints": list(names)}],
            "images": [{"id": i, "file_name": f"{i}.jpg"} for i in range(len(rows))],
            "annotations": [
                {"image_id": i, "category_id": 1, "keypoints": np.ravel(row).tolist()}
                for i, row in enumerate(np.dstack([points, np.full(points.shape[:2], 2)]))
            ],
        }
    path = folder / "a.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("kind", ["npz", "csv", "DeepLabCut", "json", "COCO"])
@pytest.mark.parametrize("is_told", [True, False])
def test_no_keypoint_of_the_model_is_lost(
    kind: str, spelling: str, is_told: bool, tmp_path: Path
) -> None:
    options = ReadOptions(target=MOUSE if is_told else None)
    found = read_keypoints(write(kind, tmp_path, SPELLINGS[spelling]), options)
    assert found.layout
    points, sure = KeypointMap(found.layout, MOUSE)(found.points, found.confidence)
    np.testing.assert_allclose(points, POINTS, rtol=1e-6)
    assert sure.all()
    assert not any(check_names(found.layout, MOUSE, "model 'mouse'"))
    if is_told:
        assert found.layout.keypoints == MOUSE.keypoints


def test_a_name_of_the_target_stays_and_others_are_translated() -> None:
    target = KeypointLayout("odd", ("wristL", "left_wrist", "EarL", "tail"))
    names = ("left_wrist", "wristL", "LShoulder", "ear_l")
    found = layout_of_names(names, [target])
    assert found.keypoints == ("left_wrist", "wristL", "left_shoulder", "EarL")
    assert found.name == NAMED_BY_INPUT
    assert layout_of_names(["Nose", *COCO17.keypoints[1:]], [HUMAN25]) is COCO17


def test_the_layout_that_is_named_may_spell_otherwise(tmp_path: Path) -> None:
    path = write("npz", tmp_path, SPELLINGS["presets"])
    assert read_keypoints(path, ReadOptions(layout=MOUSE)).layout is MOUSE
    swapped = write("npz", tmp_path, ("right_ear", "left_ear", *SPELLINGS["presets"][2:]))
    with pytest.raises(KeypointFileError, match="keypoint 0 is .*that of mouse is EarL"):
        read_keypoints(swapped, ReadOptions(layout=MOUSE))


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("EarL", "EarR", "Snout", "WristL", "a", "b", "c"), ["unnamed"]),
        (("EarL", "EarR", "Snout", "WristL", "Nose", "b", "c"), []),
        (("EarL", "EarR", "Snout", "WristL"), []),
    ],
)
def test_many_keypoints_under_no_name_are_a_finding(
    names: tuple[str, ...], expected: list[str]
) -> None:
    found = check_names(KeypointLayout(NAMED_BY_INPUT, names), MOUSE, "model 'mouse'").findings
    assert [each.code for each in found] == expected
    for finding in found:
        assert "4 of the 7 keypoints of model 'mouse', and 3 other ones (a, b, c)" in str(finding)


def test_a_face_and_fingers_are_no_names_of_a_body() -> None:
    names = ("left_shoulder", "right_shoulder", "left_hip", "right_hip", "left_jaw_1", "left_jaw_2")
    layout = KeypointLayout(NAMED_BY_INPUT, (*names, "right_pinky_mcp", "right_pinky_tip"))
    assert not any(check_names(layout, HUMAN25, "model 'human'"))


def test_lift_uses_each_name_of_the_model(tmp_path: Path) -> None:
    hand = load_model("hand21")
    names = (*MOUSE.keypoints, *(f"Spine{i}" for i in range(len(hand.layout) - Q)))
    called = dict(zip(hand.layout.keypoints, names, strict=True))
    edges = tuple((called[a], called[b]) for a, b in hand.layout.edges)
    rigid = tuple((called[a], called[b]) for a, b in hand.layout.rigid)
    layout = KeypointLayout("mouse", names, edges=edges, rigid=rigid)
    model = dataclasses.replace(hand, name="mouse", layout=layout)
    save_model(tmp_path / "mouse.safetensors", model)
    points = np.random.default_rng(1).uniform(100, 500, (3, len(names), 2)).astype(np.float32)
    order = np.random.default_rng(2).permutation(len(names))
    shuffled = tuple(names[i] for i in order)
    output = tmp_path / "out.npz"
    arguments = ("--model", str(tmp_path / "mouse.safetensors"), "--output", str(output), "--force")
    main([str(write("csv", tmp_path, shuffled, points[:, order])), *arguments])
    with np.load(output) as file:
        by_file = file["shapes"]
    main([str(write("npz", tmp_path, names, points)), *arguments])
    with np.load(output) as file:
        np.testing.assert_allclose(by_file, file["shapes"], atol=1e-4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lifted = Lifter(model, layout=[name.lower() for name in names])(points)
        assert lifted.confidence.min() > 0
        Lifter(model, layout=names[:9])
    with pytest.warns(
        UserWarning, match="names 9 of the 21 keypoints of model 'mouse', and 12 other"
    ):
        Lifter(model, layout=[*names[:9], *"abcdefghijkl"])
