# SPDX-License-Identifier: Apache-2.0
"""CMU motion capture: ASF skeletons and AMC motions to datasets.

Forward kinematics of the ASF/AMC definition: each bone rotates in its own `axis` frame C by the
angles L of its degrees of freedom, so that its rotation to the world is R_parent C L C^-1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.dataset import Dataset, concatenate
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import CMU31, HUMAN17, HUMAN25
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras

METRES = 0.0254 / 0.45
"""Metres per ASF length unit, which is 1/0.45 inch."""
HEIGHT_18 = 1 / 0.869
"""Factor that makes the CMU rest skeleton 1.8 m high, for the paper's errors in cm (tab:nrsfm)."""


@dataclass(frozen=True)
class Bone:
    """One bone of the rest pose; its keypoint is at its end.

    Attributes:
        name: e.g. "lfemur".
        parent: name of the bone at whose end it begins, or "root".
        offset: (3,) from its beginning to its end in the rest pose, in metres.
        axis: (3, 3) rotation C of the bone's frame.
        dof: degrees of freedom, e.g. ("rx", "rz").
    """

    name: str
    parent: str
    offset: NDArray[np.float64]
    axis: NDArray[np.float64]
    dof: tuple[str, ...]


Skeleton = tuple[Bone, ...]


@dataclass(frozen=True)
class Motion:
    """The motion of one trial of f frames.

    Attributes:
        joints: (f, 31, 3) positions of the keypoints of CMU31 in metres, y up.
        head: (f, 3, 3) rotations from the head bone's frame to the world: left, up, front.
        feet: (f, 2, 3, 3) the same of the left and the right foot.
    """

    joints: NDArray[np.float32]
    head: NDArray[np.float32]
    feet: NDArray[np.float32]


def _euler(angles: NDArray[np.float64], axes: str) -> NDArray[np.float64]:
    """Return rotations (..., 3, 3) by degrees (..., len(axes)) about `axes`, in order."""
    R = np.broadcast_to(np.eye(3), (*angles.shape[:-1], 3, 3))
    for i, name in enumerate(axes):
        a = np.radians(angles[..., i])
        u, v = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[name]
        step = np.broadcast_to(np.eye(3), (*a.shape, 3, 3)).copy()
        step[..., u, u] = step[..., v, v] = np.cos(a)
        step[..., v, u] = np.sin(a)
        step[..., u, v] = -np.sin(a)
        R = step @ R
    return R


def read_asf(path: Path) -> Skeleton:
    """Return the bones of an ASF file in its order, parents before children.

    Raises:
        ValueError: the file is not an ASF skeleton.
    """
    lines = path.read_text(errors="replace").splitlines()
    try:
        return _bones(line.split() for line in lines)
    except (IndexError, KeyError, ValueError) as error:
        raise ValueError(f"{path} is no ASF skeleton: {error}") from error


def _bones(lines: Iterable[list[str]]) -> Skeleton:
    """Return the bones of an ASF, whose lines are given as lists of words."""
    fields: dict[str, dict[str, list[str]]] = {}
    parents: dict[str, str] = {}
    block: dict[str, list[str]] = {}
    for words in lines:
        if not words:
            continue
        if words[0] == "begin":
            block = {}
        elif words[0] == "end" and "name" in block:
            fields[block["name"][0]] = block
        elif words[0] in ("name", "direction", "length", "axis", "dof"):
            block[words[0]] = words[1:]
        elif words[0] in fields or words[0] == "root":
            parents |= dict.fromkeys(words[1:], words[0])
    if not fields or not set(fields) <= set(parents):
        raise ValueError("it lacks bones or their hierarchy")
    return tuple(
        Bone(
            name,
            parents[name],
            METRES * float(bone["length"][0]) * np.array(bone["direction"], float).reshape(3),
            _euler(np.array(bone["axis"][:3], float).reshape(3), "xyz"),
            tuple(bone.get("dof", [])),
        )
        for name, bone in fields.items()
    )


def read_amc(path: Path, skeleton: Skeleton) -> Motion:
    """Return the motion of a trial: forward kinematics of all its frames.

    Args:
        path: AMC file.
        skeleton: of the same subject.

    Raises:
        ValueError: the file is no AMC motion of this skeleton.
    """
    try:
        return _pose(skeleton, _read_columns(path))
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path} is no AMC motion of this skeleton: {error}") from error


def read_amc_angles(path: Path, bones: Sequence[str]) -> NDArray[np.float64]:
    """Return the angles (f, len(bones)) in degrees that an AMC file has for hinges.

    Args:
        path: AMC file.
        bones: names of bones with one degree of freedom, as "ltibia", which the knee moves.

    Raises:
        ValueError: the file is no AMC motion, or one of the bones has no single angle.
    """
    columns = _read_columns(path)
    try:
        angles = [np.array(columns[bone], float).reshape(-1) for bone in bones]
        return np.stack(angles, 1)
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path} has no single angle of {', '.join(bones)}: {error}") from error


def _read_columns(path: Path) -> dict[str, list[list[str]]]:
    """Return bone -> words of each frame of an AMC file."""
    columns: dict[str, list[list[str]]] = {}
    for line in path.read_text(errors="replace").splitlines():
        name, *values = line.split() or [""]
        if values:
            columns.setdefault(name, []).append(values)
    return columns


def _pose(skeleton: Skeleton, columns: dict[str, list[list[str]]]) -> Motion:
    """Return the motion of a skeleton; `columns` are the angles of each bone, one row per frame."""
    frames = len(columns["root"])
    root = np.array(columns["root"], float).reshape(frames, 6)
    position = {"root": METRES * root[:, :3]}
    rotation = {"root": _euler(root[:, 3:], "xyz")}
    for bone in skeleton:
        rotation[bone.name] = rotation[bone.parent]
        if bone.dof:
            angles = np.array(columns[bone.name], float).reshape(frames, len(bone.dof))
            local = _euler(angles, "".join(d[1] for d in bone.dof))
            rotation[bone.name] = rotation[bone.parent] @ bone.axis @ local @ bone.axis.T
        position[bone.name] = position[bone.parent] + rotation[bone.name] @ bone.offset
    joints = np.stack([position[name] for name in CMU31.keypoints], 1)
    bones = {bone.name: bone for bone in skeleton}
    feet = [rotation[side + "foot"] @ _foot_axes(bones, side) for side in "lr"]
    return Motion(
        joints.astype(np.float32),
        rotation["head"].astype(np.float32),
        np.stack(feet, 1).astype(np.float32),
    )


def _foot_axes(bones: Mapping[str, Bone], side: str) -> NDArray[np.float64]:
    """Return left, up and front of a foot (3, 3), as columns, in the rest pose of the skeleton."""
    up = -bones[side + "tibia"].offset
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    left = np.cross(up, [0.0, 0.0, 1.0])  # the skeleton faces z
    left = left / max(float(np.linalg.norm(left)), 1e-9)
    return np.stack((left, up, np.cross(left, up)), 1)


# Bones whose ends are keypoints of HUMAN17. A detector's wrist is the end of `lwrist`, not of
# `lradius`; its neck and mid-hip are midpoints.
_HUMAN17_FROM_CMU = {
    "shoulder": "clavicle",
    "elbow": "humerus",
    "wrist": "wrist",
    "hip": "hipjoint",
    "knee": "femur",
    "ankle": "tibia",
    "big_toe": "toes",
}


def human17(motion: Motion) -> NDArray[np.float32]:
    """Return the keypoints of HUMAN17 (f, 17, 3) in metres, where a detector places them."""
    points = _body(motion)
    return np.stack([points[name] for name in HUMAN17.keypoints], 1)


def human25(motion: Motion) -> NDArray[np.float32]:
    """Return the keypoints of HUMAN25 (f, 25, 3) in metres, where a detector places them.

    Motion capture has no eyes, ears, heels and small toes: `face` and `foot` place them.
    """
    points = _body(motion)
    points |= face(points["nose"], motion.head, FaceShape())
    for i, side in enumerate(("left", "right")):
        ankle, ball = (motion.joints[:, CMU31.index(side[0] + bone)] for bone in ("tibia", "foot"))
        points |= foot(side, ankle, ball, motion.feet[:, i])
    return np.stack([points[name] for name in HUMAN25.keypoints], 1).astype(np.float32)


def _body(motion: Motion) -> dict[str, NDArray[Any]]:
    """Return the keypoints (f, 3) of HUMAN17 by their names."""
    at = CMU31.index
    points: dict[str, NDArray[Any]] = {}
    for side in ("left", "right"):
        for part, bone in _HUMAN17_FROM_CMU.items():
            points[f"{side}_{part}"] = motion.joints[:, at(side[0] + bone)]
    points["neck"] = (points["left_shoulder"] + points["right_shoulder"]) / 2
    points["mid_hip"] = (points["left_hip"] + points["right_hip"]) / 2
    base, top = motion.joints[:, at("upperneck")], motion.joints[:, at("head")]
    # The head bone ends at the crown; the nose is 35 % up the bone and 0.11 m in front of it.
    forward = motion.head @ np.array([0, 0, 0.11], np.float32)
    points["nose"] = base + np.float32(0.35) * (top - base) + forward
    return points


class FaceShape(NamedTuple):
    """Where eyes and ears are from the tip of the nose, in metres; one number, or one a frame.

    The defaults are rounded means of adults: eyes 64 mm apart, ears at the tragus, 145 mm apart.

    Attributes:
        eye_up, eye_back, eye_apart: up, back and half the distance of the eyes.
        ear_up, ear_back, ear_apart: the same of the ears.
    """

    eye_up: Any = 0.035
    eye_back: Any = 0.025
    eye_apart: Any = 0.032
    ear_up: Any = 0.02
    ear_back: Any = 0.105
    ear_apart: Any = 0.0725


def face(nose: NDArray[Any], head: NDArray[Any], shape: FaceShape) -> dict[str, NDArray[Any]]:
    """Return eyes and ears (f, 3) of a head that moves as one.

    Args:
        nose: (f, 3) its tip, in metres.
        head: (f, 3, 3) rotation of the head's axes: left, up, front.
        shape: each number a scalar or (f, 1).
    """
    left, up, front = head[:, :, 0], head[:, :, 1], head[:, :, 2]
    eyes = nose + shape.eye_up * up - shape.eye_back * front
    ears = nose + shape.ear_up * up - shape.ear_back * front
    return {
        "left_eye": eyes + shape.eye_apart * left,
        "right_eye": eyes - shape.eye_apart * left,
        "left_ear": ears + shape.ear_apart * left,
        "right_ear": ears - shape.ear_apart * left,
    }


HEEL_DOWN, HEEL_BACK, SMALL_TOE_FORWARD, SMALL_TOE_OUT = 0.045, 0.045, 0.02, 0.065
"""Metres: heel below the ankle and behind it, small toe before the ball and to the outside."""


def foot(
    side: str, ankle: NDArray[Any], ball: NDArray[Any], axes: NDArray[Any]
) -> dict[str, NDArray[Any]]:
    """Return heel and small toe (f, 3) of a foot that moves as one.

    Args:
        side: "left" or "right".
        ankle: (f, 3) in metres.
        ball: (f, 3) where the toes begin.
        axes: (f, 3, 3) rotation of the foot's axes: left, up, front.
    """
    left, up, front = axes[:, :, 0], axes[:, :, 1], axes[:, :, 2]
    outward = left if side == "left" else -left
    return {
        f"{side}_heel": ankle - HEEL_DOWN * up - HEEL_BACK * front,
        f"{side}_small_toe": ball + SMALL_TOE_FORWARD * front + SMALL_TOE_OUT * outward,
    }


def cmu31(motion: Motion) -> NDArray[np.float32]:
    """Return the 31 joints (f, 31, 3) of the paper's experiments in metres."""
    return motion.joints


KEYPOINTS_OF: dict[str, Callable[[Motion], NDArray[np.float32]]] = {
    "cmu31": cmu31,
    "human17": human17,
    "human25": human25,
}


def trials(folder: Path, subject: str) -> list[Path]:
    """Return the AMC files of a subject in trial order; raise ValueError if there are none."""
    paths = sorted((folder / subject).glob(f"{subject}_*.amc"))
    if not paths:
        raise ValueError(f"no trials {subject}_*.amc in {folder / subject}")
    return paths


def protocol_split(paths: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Return the paper's training trials, the first floor(0.8 N) of N, and the others."""
    cut = int(0.8 * len(paths))
    return list(paths[:cut]), list(paths[cut:])


def read_trials(
    paths: Sequence[Path],
    layout: KeypointLayout = CMU31,
    *,
    seed: int = 0,
    stride: int = 1,
    cameras: int = 1,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Dataset:
    """Return a dataset of trials; random orthonormal cameras project each frame.

    Points and ground-truth shapes are centred and in metres. The skeleton is the .asf file of the
    subject, next to the trials.

    Args:
        paths: AMC files.
        layout: CMU31 or HUMAN17.
        seed: of the random cameras.
        stride: take every stride-th frame.
        cameras: cameras of each frame; the images of one camera are consecutive.
        on_progress: called with the number of trials done and their total number.

    Raises:
        ValueError: motion capture does not have the keypoints of the layout.
    """
    if layout.name not in KEYPOINTS_OF:
        raise ValueError(f"motion capture gives {', '.join(KEYPOINTS_OF)}, not {layout.name!r}")
    skeletons: dict[Path, Skeleton] = {}
    parts = []
    rng = np.random.default_rng(seed)
    for done, path in enumerate(paths):
        asf = path.parent / f"{path.parent.name}.asf"
        skeleton = skeletons.setdefault(asf, skeletons.get(asf) or read_asf(asf))
        S = centre(KEYPOINTS_OF[layout.name](read_amc(path, skeleton))[::stride])
        n = len(S)
        S = np.tile(S, (cameras, 1, 1))
        M = random_cameras(len(S), rng)
        source = f"CMU motion capture, subject {path.parent.name}"
        # The end of the trial is held out from all cameras: a pose is never in both parts.
        starts = np.arange(0, len(S), max(n, 1))
        visible = np.ones(S.shape[:2], bool)
        parts.append(Dataset(S @ M, visible, layout, source, S, starts, cameras=M))
        on_progress(done + 1, len(paths))
    return concatenate(parts)


@dataclass(frozen=True)
class TrialSelection:
    """Trials of the CMU motion capture.

    Attributes:
        folder: folder of the database (NN/NN.asf, NN/NN_*.amc).
        subjects: folders of the subjects, e.g. "01".
        split: "train" or "held-out" by the paper's protocol, or "all".
        stride: every n-th frame is taken.
        camera_seed: seed of the random cameras.
        cameras: cameras that project each frame.
    """

    folder: Path
    subjects: Sequence[str]
    split: str = "train"
    stride: int = 1
    camera_seed: int = 0
    cameras: int = 1


def selected_trials(selection: TrialSelection) -> list[Path]:
    """Return the AMC files of a selection; raise ValueError if a subject has none."""
    paths: list[Path] = []
    for subject in selection.subjects:
        found = trials(selection.folder, subject)
        train, held_out = protocol_split(found)
        paths += {"train": train, "held-out": held_out, "all": found}[selection.split]
    return paths


def read_split(
    selection: TrialSelection,
    layout: KeypointLayout,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Dataset:
    """Return the selected trials as one dataset, as `read_trials` reads them."""
    return read_trials(
        selected_trials(selection),
        layout,
        seed=selection.camera_seed,
        stride=selection.stride,
        cameras=selection.cameras,
        on_progress=on_progress,
    )
