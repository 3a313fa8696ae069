"""CMU motion capture: ASF skeletons and AMC motions to datasets.

Forward kinematics of the ASF/AMC definition: each bone rotates in its own `axis` frame C by the
angles L of its degrees of freedom, so that its rotation to the world is R_parent C L C^-1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.dataset import Dataset, concatenate
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import CMU31, HUMAN17
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
        head: (f, 3, 3) rotations from the head bone's frame to the world.
    """

    joints: NDArray[np.float32]
    head: NDArray[np.float32]


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
    columns: dict[str, list[list[str]]] = {}
    for line in path.read_text(errors="replace").splitlines():
        name, *values = line.split() or [""]
        if values:
            columns.setdefault(name, []).append(values)
    try:
        return _pose(skeleton, columns)
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path} is no AMC motion of this skeleton: {error}") from error


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
    return Motion(joints.astype(np.float32), rotation["head"].astype(np.float32))


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
    return np.stack([points[name] for name in HUMAN17.keypoints], 1)


def cmu31(motion: Motion) -> NDArray[np.float32]:
    """Return the 31 joints (f, 31, 3) of the paper's experiments in metres."""
    return motion.joints


KEYPOINTS_OF: dict[str, Callable[[Motion], NDArray[np.float32]]] = {
    "cmu31": cmu31,
    "human17": human17,
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
        S = np.tile(S, (cameras, 1, 1))
        W = S @ random_cameras(len(S), rng)
        source = f"CMU motion capture, subject {path.parent.name}"
        parts.append(Dataset(W, np.ones(W.shape[:2], bool), layout, source, S))
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
