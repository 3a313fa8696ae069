"""CMU motion capture: ASF skeletons and AMC motions into datasets.

Forward kinematics after the ASF/AMC definition: each bone turns about its own `axis` frame C by
the angles L of its degrees of freedom, so its world rotation is R_parent C L C^-1.
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
"""Metres per ASF length unit (1/0.45 inch)."""
HEIGHT_18 = 1 / 0.869
"""Factor that makes the CMU rest skeleton 1.8 m high, the paper's convention for centimetres."""


@dataclass(frozen=True)
class Bone:
    """One bone of the rest pose; its keypoint is its end."""

    name: str
    parent: str
    offset: NDArray[np.float64]  # (3,) metres, direction x length
    axis: NDArray[np.float64]  # (3, 3) the frame C
    dof: tuple[str, ...]  # e.g. ("rx", "rz")


Skeleton = tuple[Bone, ...]


@dataclass(frozen=True)
class Motion:
    """World positions and orientations of the 31 keypoints of CMU31 in one trial."""

    joints: NDArray[np.float32]  # (f, 31, 3) metres, y up
    head: NDArray[np.float32]  # (f, 3, 3) rotation of the head bone's frame to the world


def _euler(angles: NDArray[np.float64], axes: str) -> NDArray[np.float64]:
    """Return R (..., 3, 3) for degrees (..., len(axes)) applied about x, y, z in that order."""
    R = np.broadcast_to(np.eye(3), (*angles.shape[:-1], 3, 3))
    for i, name in enumerate(axes):
        a = np.radians(angles[..., i])
        u, v = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[name]
        turn = np.broadcast_to(np.eye(3), (*a.shape, 3, 3)).copy()
        turn[..., u, u] = turn[..., v, v] = np.cos(a)
        turn[..., v, u] = np.sin(a)
        turn[..., u, v] = -np.sin(a)
        R = turn @ R
    return R


def read_asf(path: Path) -> Skeleton:
    """Read a skeleton; bones in ASF order, parents before children.

    Raises ValueError naming the file when it is not an ASF skeleton.
    """
    lines = path.read_text(errors="replace").splitlines()
    try:
        return _bones(line.split() for line in lines)
    except (IndexError, KeyError, ValueError) as error:
        raise ValueError(f"{path} is no ASF skeleton: {error}") from error


def _bones(lines: Iterable[list[str]]) -> Skeleton:
    """Return the bones of an ASF, given as the words of its lines."""
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
    """Read a trial and run forward kinematics over all its frames at once.

    Raises ValueError naming the file when bones or frames are missing.
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
    """Return the motion of a skeleton whose bones have the angles `columns`, a row a frame."""
    frames = len(columns["root"])
    root = np.array(columns["root"], float).reshape(frames, 6)
    position = {"root": METRES * root[:, :3]}
    turn = {"root": _euler(root[:, 3:], "xyz")}
    for bone in skeleton:
        turn[bone.name] = turn[bone.parent]
        if bone.dof:
            angles = np.array(columns[bone.name], float).reshape(frames, len(bone.dof))
            local = _euler(angles, "".join(d[1] for d in bone.dof))
            turn[bone.name] = turn[bone.parent] @ bone.axis @ local @ bone.axis.T
        position[bone.name] = position[bone.parent] + turn[bone.name] @ bone.offset
    joints = np.stack([position[name] for name in CMU31.keypoints], 1)
    return Motion(joints.astype(np.float32), turn["head"].astype(np.float32))


# HUMAN17 from CMU joints. A detector's wrist is the end of `lwrist`, not that of `lradius`; its
# neck and mid-hip are midpoints by definition.
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
    """Return the keypoints of HUMAN17 (f, 17, 3) as a detector would place them."""
    at = CMU31.index
    points: dict[str, NDArray[Any]] = {}
    for side in ("left", "right"):
        for part, bone in _HUMAN17_FROM_CMU.items():
            points[f"{side}_{part}"] = motion.joints[:, at(side[0] + bone)]
    points["neck"] = (points["left_shoulder"] + points["right_shoulder"]) / 2
    points["mid_hip"] = (points["left_hip"] + points["right_hip"]) / 2
    base, top = motion.joints[:, at("upperneck")], motion.joints[:, at("head")]
    # The head bone's end is the crown; the nose sits 35 % up it and 0.11 m before it.
    forward = motion.head @ np.array([0, 0, 0.11], np.float32)
    points["nose"] = base + np.float32(0.35) * (top - base) + forward
    return np.stack([points[name] for name in HUMAN17.keypoints], 1)


def cmu31(motion: Motion) -> NDArray[np.float32]:
    """Return the 31 joints (f, 31, 3) of the paper's experiments."""
    return motion.joints


KEYPOINTS_OF: dict[str, Callable[[Motion], NDArray[np.float32]]] = {
    "cmu31": cmu31,
    "human17": human17,
}


def trials(folder: Path, subject: str) -> list[Path]:
    """Return the AMC files of a subject in trial order; raise ValueError if there are none."""
    found = sorted((folder / subject).glob(f"{subject}_*.amc"))
    if not found:
        raise ValueError(f"no trials {subject}_*.amc in {folder / subject}")
    return found


def protocol_split(paths: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Return (training, held-out) trials: the paper trains on the first floor(0.8 N)."""
    cut = int(0.8 * len(paths))
    return list(paths[:cut]), list(paths[cut:])


def read_trials(
    paths: Sequence[Path],
    layout: KeypointLayout = CMU31,
    *,
    seed: int = 0,
    stride: int = 1,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Dataset:
    """Project each `stride`-th frame by a random orthonormal camera of its own, fixed by `seed`.

    Points and ground-truth shapes are centred and in metres. Trials of one subject share the
    skeleton beside them. Raises ValueError for a layout that motion capture cannot give.
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
        W = S @ random_cameras(len(S), rng)
        source = f"CMU motion capture, subject {path.parent.name}"
        parts.append(Dataset(W, np.ones(W.shape[:2], bool), layout, source, S))
        on_progress(done + 1, len(paths))
    return concatenate(parts)
