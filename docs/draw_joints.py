# SPDX-License-Identifier: Apache-2.0
"""Draw the frames of a person's joints, for docs/body.md: `python -m docs.draw_joints`.

The left picture is the pose in which all angles are 0; the right one is a pose with its angles. The
bones are the capsules of the person's URDF.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.body.kinematic_tree import KinematicTree, Pose
from deep_nrsfm_ros.body.urdf import UrdfDrawing, urdf
from deep_nrsfm_ros.layouts.presets import HUMAN17

Floats = NDArray[Any]

FILE = Path(__file__).parent / "joints.png"
COLOURS = ("#c0392b", "#27ae60", "#2471a3")  # x front, y left, z up
AXIS = 0.11  # m
_ELEVATION, _AZIMUTH = 12, 38
_SHOWN = {"r_y_shoulder": 0.5, "r_p_shoulder": 1.1, "r_elbow": 0.9, "l_p_shoulder": 0.35}
_SHOWN |= {"l_r_hip": 1.0, "l_knee": -1.1, "y_head": 0.5, "l_elbow": 1.2, "y_waist": -0.2}
_NAMED = (
    *("body", "nose", "left_shoulder", "left_elbow", "left_hip", "left_knee", "left_foot"),
    *("right_shoulder", "right_elbow"),
)
_OFFSETS = {
    "torso": (0, 0, 0.5),
    "nose": (0.13, 0, 0.26),
    "left_shoulder": (0, 0.18, 0),
    "left_elbow": (0, 0, -0.28),
    "left_wrist": (0, 0, -0.25),
    "left_hip": (0, 0.1, 0),
    "left_knee": (0, 0, -0.42),
    "left_ankle": (0, 0, -0.42),
    "left_big_toe": (0.2, 0, 0),
}


def pose_of(tree: KinematicTree, angles: dict[str, float]) -> tuple[Pose, Floats]:
    """Return the pose of a person with some angles, and the offsets (j, 3) of its joints."""
    offsets = np.zeros((len(tree), 3))
    for i, name in enumerate(tree.names):
        mirrored = (1, -1 if name.startswith("right_") else 1, 1)
        offsets[i] = np.multiply(_OFFSETS.get(name.replace("right_", "left_"), (0, 0, 0)), mirrored)
    values = np.array([[angles.get(name, 0.0) for name in tree.angle_names]])
    return tree.forward(np.zeros((1, 3)), np.eye(3)[None], values, offsets), offsets


def draw(axes: Any, tree: KinematicTree, angles: dict[str, float], title: str) -> None:
    """Draw a person's capsules, and the frames of its joints."""
    pose, offsets = pose_of(tree, angles)
    for capsule in UrdfDrawing(urdf(tree, offsets)).capsules(angles):
        ends = np.stack([capsule.start, capsule.end]).T
        axes.plot(*ends, color="#9fb6cd", linewidth=12, solid_capstyle="round", alpha=0.55)
    for i, name in enumerate(tree.names):
        origin = pose.origins[0, i]
        for axis, colour in enumerate(COLOURS):
            end = origin + AXIS * pose.rotations[0, i, :, axis]
            axes.plot(*np.stack([origin, end]).T, color=colour, linewidth=2)
        if name in _NAMED:
            side = "right" if name == "body" else "left"  # a hip is close to its right
            axes.text(*(origin + [0, 0, 0.035]), f"  {name}  ", fontsize=9, ha=side)
    axes.set_title(title, fontsize=9, y=-0.1)
    axes.set_box_aspect((1, 1, 2), zoom=1.3)
    axes.set(xlim=(-0.45, 0.45), ylim=(-0.45, 0.45), zlim=(-1.1, 1.0))
    axes.view_init(_ELEVATION, _AZIMUTH)
    axes.set_axis_off()


def main() -> None:
    """Write the picture."""
    tree = KinematicTree(HUMAN17)
    figure = plt.figure(figsize=(10, 7.5), layout="constrained")
    shown = ", ".join(f"{name} {value:g}" for name, value in _SHOWN.items())
    for column, (angles, title) in enumerate(
        (({}, "all angles 0"), (_SHOWN, shown.replace(", l_r_hip", ",\nl_r_hip")))
    ):
        axes = figure.add_subplot(1, 2, column + 1, projection="3d")
        draw(axes, tree, angles, title)
    figure.suptitle("x front (red), y left (green), z up (blue) of each joint", fontsize=11)
    figure.savefig(FILE, dpi=80)
    print(FILE)


if __name__ == "__main__":
    main()
