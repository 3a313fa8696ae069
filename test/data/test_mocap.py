# SPDX-License-Identifier: Apache-2.0
"""Motion capture: forward kinematics against a slow recursion, and the paper's frame counts."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.data.mocap import (
    KEYPOINTS_OF,
    METRES,
    Motion,
    human17,
    human25,
    protocol_split,
    read_amc,
    read_amc_angles,
    read_asf,
    read_trials,
    trials,
)
from deep_nrsfm_ros.layouts.presets import CMU31, COCO17, HUMAN17, HUMAN25, preset
from deep_nrsfm_ros.nrsfm.handedness import votes

PARENT = dict(CMU31.edges)
UNIT = 0.0254 / 0.45
DATA = os.environ.get("DEEP_NRSFM_DATA")
needs_data = pytest.mark.skipif(
    not DATA, reason="DEEP_NRSFM_DATA does not name the folder that holds cmu/"
)


def asf(bones: dict[str, dict[str, str]]) -> str:
    """Return an ASF of the bones: name -> direction, length, axis and perhaps dof."""
    text = "# made by hand\n:version 1.10\n:units\n  length 0.45\n  angle deg\n:root\n"
    text += "   order TX TY TZ RX RY RZ\n   axis XYZ\n   position 0 0 0\n:bonedata\n"
    for i, (name, fields) in enumerate(bones.items()):
        lines = [f"     {key} {value}" for key, value in fields.items()]
        text += "\n".join(["  begin", f"     id {i + 1}", f"     name {name}", *lines, "  end\n"])
    text += ":hierarchy\n  begin\n"
    for parent in dict.fromkeys(PARENT[name] for name in bones):
        children = [name for name in bones if PARENT[name] == parent]
        text += f"    {parent} {' '.join(children)}\n"
    return text + "  end\n"


def amc(frames: list[dict[str, list[float]]]) -> str:
    """Return an AMC of the frames: bone -> values."""
    text = "#!OML:ASF nothing\n:FULLY-SPECIFIED\n:DEGREES\n"
    for i, frame in enumerate(frames):
        rows = [" ".join([name, *(f"{v:.17g}" for v in row)]) for name, row in frame.items()]
        text += "\n".join([str(i + 1), *rows]) + "\n"
    return text


def random_skeleton(seed: int = 0) -> dict[str, dict[str, str]]:
    rng = np.random.default_rng(seed)
    bones = {}
    for name in CMU31.keypoints[1:]:
        direction, axis = rng.standard_normal(3), rng.uniform(-180, 180, 3)
        bones[name] = {
            "direction": " ".join(map(str, direction / np.linalg.norm(direction))),
            "length": str(rng.uniform(1, 8)),
            "axis": " ".join(map(str, axis)) + "  XYZ",
        }
        if dof := [f"r{a}" for a in "xyz" if rng.random() < 0.7]:
            bones[name] |= {"dof": " ".join(dof), "limits": "(-90.0 20.0)"}
    return bones


def random_frames(bones: dict[str, dict[str, str]], f: int = 4) -> list[dict[str, list[float]]]:
    rng = np.random.default_rng(1)
    return [
        {"root": rng.uniform(-100, 100, 6).tolist()}
        | {
            name: rng.uniform(-120, 120, len(b["dof"].split())).tolist()
            for name, b in reversed(bones.items())  # AMC files have an order of their own
            if "dof" in b
        }
        for _ in range(f)
    ]


def turn(axis: str, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


def turns(axes: str, degrees: list[float]) -> np.ndarray:
    R = np.eye(3)
    for axis, angle in zip(axes, degrees, strict=True):
        R = turn(axis, angle) @ R
    return R


def slow(
    bones: dict[str, dict[str, str]], frame: dict[str, list[float]], name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return position (inches x 0.45) and rotation of one joint, from the root down to it."""
    if name == "root":
        return np.array(frame["root"][:3]), turns("xyz", frame["root"][3:])
    position, R = slow(bones, frame, PARENT[name])
    bone = bones[name]
    C = turns("xyz", [float(word) for word in bone["axis"].split()[:3]])
    L = turns(bone.get("dof", "").replace("r", "").replace(" ", ""), frame.get(name, []))
    R = R @ C @ L @ np.linalg.inv(C)
    offset = float(bone["length"]) * np.array([float(w) for w in bone["direction"].split()])
    return position + R @ offset, R


def written(folder: Path, bones: Any, frames: Any, subject: str = "07") -> tuple[Path, Path]:
    """Write subject folder, skeleton and one trial; return both files."""
    where = folder / subject
    where.mkdir(parents=True, exist_ok=True)
    (where / f"{subject}.asf").write_text(asf(bones))
    (where / f"{subject}_01.amc").write_text(amc(frames))
    return where / f"{subject}.asf", where / f"{subject}_01.amc"


def test_forward_kinematics(tmp_path: Path) -> None:
    bones = random_skeleton()
    frames = random_frames(bones)
    skeleton_file, motion_file = written(tmp_path, bones, frames)
    motion = read_amc(motion_file, read_asf(skeleton_file))
    assert motion.joints.shape == (4, 31, 3) and motion.joints.dtype == np.float32
    for f, frame in enumerate(frames):
        for name in CMU31.keypoints:
            expected = UNIT * slow(bones, frame, name)[0]
            found = motion.joints[f, CMU31.index(name)]
            np.testing.assert_allclose(found, expected, atol=1e-5, err_msg=name)
        np.testing.assert_allclose(motion.head[f], slow(bones, frame, "head")[1], atol=1e-5)


def straight(**special: dict[str, str]) -> dict[str, dict[str, str]]:
    """Return bones of one unit each along x."""
    plain = {"direction": "1 0 0", "length": "1", "axis": "0 0 0 XYZ"}
    return {name: plain | special.get(name, {}) for name in CMU31.keypoints[1:]}


def test_a_skeleton_turned_by_hand(tmp_path: Path) -> None:
    bones = straight(
        lfemur={"dof": "rz"},
        rfemur={"dof": "rz", "axis": "90 0 0 XYZ"},  # its z axis points to -y
        rtibia={"dof": "rx"},
    )
    still = {"root": [0, 0, 0, 0, 0, 0], "lfemur": [0], "rfemur": [0], "rtibia": [77]}
    frames = [
        still,
        still | {"root": [10, 20, 30, 0, 0, 90]},
        still | {"lfemur": [90], "rfemur": [90]},
    ]
    skeleton_file, motion_file = written(tmp_path, bones, frames)
    joints = read_amc(motion_file, read_asf(skeleton_file)).joints / UNIT
    at = CMU31.index
    np.testing.assert_allclose(joints[0, at("ltoes")], [5, 0, 0], atol=1e-5)
    np.testing.assert_allclose(joints[0, at("rtibia")], [3, 0, 0], atol=1e-5)
    np.testing.assert_allclose(joints[1, at("root")], [10, 20, 30], atol=1e-4)
    np.testing.assert_allclose(joints[1, at("ltoes")], [10, 25, 30], atol=1e-4)
    np.testing.assert_allclose(joints[2, at("lhipjoint")], [1, 0, 0], atol=1e-5)
    np.testing.assert_allclose(joints[2, at("lfemur")], [1, 1, 0], atol=1e-5)
    np.testing.assert_allclose(joints[2, at("ltoes")], [1, 4, 0], atol=1e-5)
    np.testing.assert_allclose(joints[2, at("rfemur")], [1, 0, 1], atol=1e-5)
    assert METRES == pytest.approx(0.0564444)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (":hierarchy", None),  # cut off there
        (":bonedata", None),
        ("direction", "bearing"),
        ("length", "size"),
        ("axis", "hinge"),
        ("length 1", "length long"),
        ("direction 1 0 0", "direction 1 0"),
        ("axis 0 0 0", "axis 0 0"),
        ("root lhipjoint", "trunk lhipjoint"),
    ],
)
def test_a_bad_skeleton_is_named(tmp_path: Path, old: str, new: str | None) -> None:
    text = asf(straight())
    body = text.index(":bonedata")
    changed = (
        text[: text.index(old)] if new is None else text[:body] + text[body:].replace(old, new)
    )
    assert changed != text
    bad = tmp_path / "bad.asf"
    bad.write_text(changed)
    with pytest.raises(ValueError, match="bad.asf"):
        read_asf(bad)


@pytest.mark.parametrize(
    "data", [b"", b"\x00\xff" * 100, b"begin\nend\n", b"name\nbegin\nname\nend"]
)
def test_any_file_is_no_skeleton(tmp_path: Path, data: bytes) -> None:
    bad = tmp_path / "bad.asf"
    bad.write_bytes(data)
    with pytest.raises(ValueError, match="bad.asf"):
        read_asf(bad)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("lfemur", "lfibula"),
        ("root 0 0 0 0 0 0", "trunk 0 0 0 0 0 0"),
        ("root 0 0 0 0 0 0", "root 0 0 0"),
        ("lfemur 0", "lfemur"),
        ("lfemur 0", "lfemur north"),
        ("lfemur 0\n2", "lfemur 0 0\n2"),
        ("lfemur 0\n2", "2"),
    ],
)
def test_a_bad_motion_is_named(tmp_path: Path, old: str, new: str) -> None:
    frame: dict[str, list[float]] = {"root": [0] * 6, "lfemur": [0]}
    skeleton_file, motion_file = written(tmp_path, straight(lfemur={"dof": "rz"}), [frame] * 3)
    skeleton = read_asf(skeleton_file)
    assert read_amc(motion_file, skeleton).joints.shape == (3, 31, 3)
    text = motion_file.read_text()
    assert old in text
    motion_file.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match="07_01.amc"):
        read_amc(motion_file, skeleton)


def test_hinges_are_read_as_the_file_has_them(tmp_path: Path) -> None:
    frames = [{"root": [0.0] * 6, "ltibia": [10.0 * i], "lradius": [-float(i)]} for i in range(3)]
    _, motion_file = written(tmp_path, straight(), frames)
    angles = read_amc_angles(motion_file, ("lradius", "ltibia"))
    np.testing.assert_array_equal(angles, [[0, 0], [-1, 10], [-2, 20]])
    for bones in (("ltibia", "root"), ("lfemur",)):
        with pytest.raises(ValueError, match=r"07_01.amc has no single angle of"):
            read_amc_angles(motion_file, bones)


def test_a_skeleton_of_another_kind_has_no_such_motion(tmp_path: Path) -> None:
    bones = straight()
    del bones["head"]
    skeleton_file, motion_file = written(tmp_path, bones, [{"root": [0.0] * 6}])
    with pytest.raises(ValueError, match="07_01.amc"):
        read_amc(motion_file, read_asf(skeleton_file))


def test_files_that_are_not_there_are_named(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="absent.asf"):
        read_asf(tmp_path / "absent.asf")
    with pytest.raises(ValueError, match="07_.*amc"):
        trials(tmp_path, "07")


def test_trials_come_in_order(tmp_path: Path) -> None:
    bones = straight()
    written(tmp_path, bones, [{"root": [0.0] * 6}])
    for number in ("10", "02", "09"):
        (tmp_path / "07" / f"07_{number}.amc").touch()
    (tmp_path / "07" / "08_01.amc").touch()
    names = [path.stem for path in trials(tmp_path, "07")]
    assert names == ["07_01", "07_02", "07_09", "07_10"]


def test_each_frame_is_seen_by_as_many_cameras_as_asked_for(tmp_path: Path) -> None:
    frame: dict[str, list[float]] = {"root": [0] * 6}
    _, motion_file = written(tmp_path, straight(), [frame, frame | {"root": [0, 0, 0, 0, 90, 0]}])
    dataset = read_trials([motion_file], cameras=3)
    assert dataset.shapes is not None and len(dataset) == 6
    np.testing.assert_array_equal(dataset.shapes[:2], dataset.shapes[4:])
    assert dataset.sequence_starts.tolist() == [0, 2, 4]
    distances = np.abs(dataset.points[:, None] - dataset.points).max((-2, -1))
    assert (distances[~np.eye(6, dtype=bool)] > 1e-3).all()


def test_the_protocol_trains_on_the_first_four_fifths() -> None:
    for n in range(200):
        paths = [Path(str(i)) for i in range(n)]
        train, held_out = protocol_split(paths)
        assert len(train) == 4 * n // 5 and train + held_out == paths


def test_every_frame_is_seen_by_an_orthonormal_camera_fixed_by_the_seed(tmp_path: Path) -> None:
    bones = random_skeleton()
    _, file = written(tmp_path, bones, random_frames(bones))
    _, other = written(tmp_path, bones, random_frames(bones)[:2], "08")
    seen: list[tuple[int, int]] = []
    dataset = read_trials([file, other], seed=3, on_progress=lambda *p: seen.append(p))
    assert len(dataset) == 6 and seen == [(1, 2), (2, 2)]
    assert dataset.layout is CMU31 and dataset.visible.all()
    assert "subject 07" in dataset.source and "subject 08" in dataset.source
    np.testing.assert_allclose(dataset.points.mean(1), 0, atol=1e-5)
    assert dataset.shapes is not None
    np.testing.assert_allclose(dataset.shapes.mean(1), 0, atol=1e-5)
    for W, S in zip(dataset.points, dataset.shapes, strict=True):
        M, *_ = np.linalg.lstsq(S.astype(float), W.astype(float), rcond=None)
        np.testing.assert_allclose(S @ M, W, atol=1e-5)
        np.testing.assert_allclose(M.T @ M, np.eye(2), atol=1e-4)
    np.testing.assert_array_equal(read_trials([file, other], seed=3).points, dataset.points)
    assert not np.allclose(read_trials([file, other], seed=4).points, dataset.points)


def test_only_some_layouts_can_be_made_of_motion_capture(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cmu31, human17, human25, not 'coco17'"):
        read_trials([tmp_path / "01.amc"], COCO17)


def test_keypoints_of_a_person() -> None:
    rng = np.random.default_rng(0)
    motion = Motion(
        rng.standard_normal((3, 31, 3)).astype(np.float32),
        np.tile(turn("y", 90).astype(np.float32), (3, 1, 1)),
        np.tile(turn("y", 90).astype(np.float32), (3, 2, 1, 1)),
    )
    points = human17(motion)

    def of(name: str) -> np.ndarray:
        return points[:, HUMAN17.index(name)]

    def joint(name: str) -> np.ndarray:
        return motion.joints[:, CMU31.index(name)]

    np.testing.assert_array_equal(of("left_wrist"), joint("lwrist"))
    np.testing.assert_array_equal(of("right_knee"), joint("rfemur"))
    np.testing.assert_array_equal(of("right_big_toe"), joint("rtoes"))
    np.testing.assert_allclose(of("neck"), (of("left_shoulder") + of("right_shoulder")) / 2)
    np.testing.assert_allclose(of("mid_hip"), (of("left_hip") + of("right_hip")) / 2)
    # The head's z axis is its front; turned by 90 degrees about y it is x.
    skull = 0.65 * joint("upperneck") + 0.35 * joint("head")
    np.testing.assert_allclose(of("nose") - skull, [[0.11, 0, 0]] * 3, atol=1e-6)
    more = human25(motion)
    np.testing.assert_array_equal(more[:, : len(HUMAN17)], points)
    part = {name: more[:, i] for i, name in enumerate(HUMAN25.keypoints)}
    # The head's x axis is its left; turned by 90 degrees about y it is -z.
    apart = part["left_ear"] - part["right_ear"]
    np.testing.assert_allclose(apart, [[0, 0, -0.145]] * 3, atol=1e-5)
    heel = part["right_heel"] - part["right_ankle"]
    np.testing.assert_allclose(heel, [[-0.045, -0.045, 0]] * 3, atol=1e-5)
    small_toe = part["right_small_toe"] - joint("rfoot")
    np.testing.assert_allclose(small_toe, [[0.02, 0, 0.065]] * 3, atol=1e-5)


def test_feet_stand_flat_in_the_rest_pose(tmp_path: Path) -> None:
    frame: dict[str, list[float]] = {"root": [0] * 6}
    skeleton_file, motion_file = written(tmp_path, straight(), [frame])
    (feet,) = read_amc(motion_file, read_asf(skeleton_file)).feet
    np.testing.assert_allclose(feet.mT @ feet, [np.eye(3)] * 2, atol=1e-6)
    np.testing.assert_allclose(feet[:, 2, 2], 1, atol=1e-6)  # the front is z


@needs_data
def test_the_paper_counts_9502_frames_of_subject_127() -> None:
    folder = Path(str(DATA)) / "cmu"
    train, held_out = protocol_split(trials(folder, "127"))
    assert len(train) == 30 and len(held_out) == 8
    dataset = read_trials(train)
    assert len(dataset) == 9502
    assert dataset.shapes is not None
    assert np.isfinite(dataset.points).all() and np.isfinite(dataset.shapes).all()
    height = dataset.shapes[0].max(0) - dataset.shapes[0].min(0)
    assert 1.2 < height[1] < 1.9  # metres, y up


@needs_data
@pytest.mark.parametrize("name", KEYPOINTS_OF)
def test_real_people_are_right_handed(name: str) -> None:
    dataset = read_trials(trials(Path(str(DATA)) / "cmu", "02")[:3], preset(name))
    assert dataset.shapes is not None
    assert ((votes(dataset.shapes, dataset.layout) > 0).mean(0) > 0.9).all()
