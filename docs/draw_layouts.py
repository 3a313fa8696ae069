# SPDX-License-Identifier: Apache-2.0
"""Draw each preset of a keypoint layout once: `python -m docs.draw_layouts`.

A picture shows a person from the front, an animal from its left, or the back of a hand, with
the index of each keypoint. The positions are made up; names, indices and edges are the layout's.
"""

from __future__ import annotations

from collections.abc import Iterable
from io import BytesIO
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from PIL import Image

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.reporting.drawing import COLOURS, MIDDLE

FOLDER = Path(__file__).parent / "reference" / "layouts"
Point = tuple[float, float]
_LEFT, _RIGHT, _MIDDLE = COLOURS["left"], COLOURS["right"], MIDDLE

# Of the left side, in the middle 0; the right side is its mirror image.
_BODY: dict[str, Point] = {
    "head_top": (0, 9.6),
    "head": (0, 9.3),
    "nose": (0, 8.6),
    "upper_neck": (0, 7.75),
    "neck_base": (0, 7.9),
    "neck": (0, 7.2),
    "thorax": (0, 7.1),
    "spine": (0, 5.7),
    "spine_3": (0, 6.7),
    "spine_2": (0, 6.0),
    "spine_1": (0, 5.3),
    "pelvis": (0, 4.6),
    "chest_spine": (0, 6.4),
    "naval_spine": (0, 5.5),
    "mid_hip": (0, 4.6),
    "left_eye": (0.45, 8.95),
    "left_ear": (0.95, 8.75),
    "left_mouth": (0.35, 8.15),
    "left_eye_inner": (0.2, 9.2),
    "left_eye_outer": (0.72, 9.2),
    "left_clavicle": (0.6, 7.0),
    "left_shoulder": (1.4, 7.0),
    "left_elbow": (2.3, 5.7),
    "left_wrist": (2.9, 4.4),
    "left_hand": (3.1, 3.9),
    "left_handtip": (3.3, 3.3),
    "left_thumb": (2.6, 3.7),
    "left_pinky": (3.5, 3.7),
    "left_index": (3.0, 3.4),
    "left_thumb_tip": (2.5, 3.7),
    "left_index_mcp": (2.85, 3.5),
    "left_pinky_mcp": (3.5, 3.7),
    "left_middle_tip": (3.2, 2.9),
    "left_hip": (0.75, 4.4),
    "left_knee": (0.95, 2.4),
    "left_ankle": (1.0, 0.5),
    "left_heel": (0.75, 0.05),
    "left_foot": (1.45, -0.4),
    "left_big_toe": (1.2, -0.5),
    "left_small_toe": (1.75, -0.2),
}
_ANIMAL: dict[str, Point] = {
    "nose": (-4.6, 3.9),
    "left_eye": (-3.8, 4.6),
    "right_eye": (-4.2, 4.9),
    "neck": (-2.6, 3.9),
    "tail_root": (3.0, 3.7),
    "left_front_shoulder": (-2.2, 2.8),
    "left_front_elbow": (-2.0, 1.5),
    "left_front_paw": (-2.1, 0),
    "left_back_hip": (2.5, 2.7),
    "left_back_knee": (2.2, 1.5),
    "left_back_paw": (2.8, 0),
    "right_front_shoulder": (-3.1, 3.0),
    "right_front_elbow": (-3.2, 1.7),
    "right_front_paw": (-3.4, 0.3),
    "right_back_hip": (1.5, 2.9),
    "right_back_knee": (1.1, 1.7),
    "right_back_paw": (1.5, 0.3),
}
_CMU = {
    "root": (0, 4.6),
    "lowerback": (0, 5.2),
    "upperback": (0, 5.9),
    "thorax": (0, 6.6),
    "lowerneck": (0, 7.3),
    "upperneck": (0, 8.0),
    "head": (0, 8.8),
    "lhipjoint": (0.75, 4.4),
    "lfemur": (0.95, 2.4),
    "ltibia": (1.0, 0.5),
    "lfoot": (1.2, -0.1),
    "ltoes": (1.5, -0.6),
    "lclavicle": (0.7, 7.0),
    "lhumerus": (1.8, 6.2),
    "lradius": (2.6, 4.9),
    "lwrist": (2.9, 4.2),
    "lhand": (3.1, 3.6),
    "lfingers": (3.3, 3.0),
    "lthumb": (2.5, 3.7),
}


def _hand() -> dict[str, Point]:
    """Return the positions of a right hand from its back, the fingers up."""
    points = {"wrist": (0.3, 0.0), "hand_wrist": (0.3, 0.0)}
    bases = {"index": (-1.1, 4.0), "middle": (0.0, 4.2), "ring": (1.0, 3.9), "pinky": (1.9, 3.3)}
    lengths = {"index": 0.9, "middle": 1.0, "ring": 0.9, "pinky": 0.7}
    for finger, (x, y) in bases.items():
        for i, joint in enumerate(("mcp", "pip", "dip", "tip")):
            points[f"{finger}_{joint}"] = (x * (1 + 0.08 * i), y + i * lengths[finger])
    for i, joint in enumerate(("cmc", "mcp", "ip", "tip")):
        points[f"thumb_{joint}"] = (-0.9 - 0.75 * i, 0.8 + 0.9 * i)
    return points


def _face() -> list[Point]:
    """Return the positions of the 68 points of a face; the person's right is at the left."""
    angle = np.linspace(np.pi, 2 * np.pi, 17)
    jaw = [(4.0 * np.cos(a), 5.8 * np.sin(a) + 1) for a in angle]
    brow = [(-3.3 + 0.6 * i, 2.6 + 0.25 * np.sin(np.pi * i / 4)) for i in range(5)]
    brows = brow + [(-x, y) for x, y in reversed(brow)]
    nose = [(0.0, 1.7 - 0.65 * i) for i in range(4)]
    nostrils = [(-1.2 + 0.6 * i, -0.75 - 0.2 * (1 - abs(i - 2) / 2)) for i in range(5)]
    eye = [(-3.1, 1.4), (-2.5, 1.9), (-1.6, 1.9), (-1.0, 1.4), (-1.6, 0.9), (-2.5, 0.9)]
    other = [(-eye[i][0], eye[i][1]) for i in (3, 2, 1, 0, 5, 4)]
    turn = np.pi - np.linspace(0, 2 * np.pi, 12, endpoint=False)
    outer = [(2.4 * np.cos(a), 1.25 * np.sin(a) - 2.8) for a in turn]
    inner_turn = np.pi - np.linspace(0, 2 * np.pi, 8, endpoint=False)
    inner = [(1.6 * np.cos(a), 0.5 * np.sin(a) - 2.8) for a in inner_turn]
    return jaw + brows + nose + nostrils + eye + other + outer + inner


def positions(layout: KeypointLayout) -> list[tuple[str, dict[int, Point]]]:
    """Return the parts of the picture: title and the position of each keypoint of the part."""
    if layout.name == "hand21":
        return [("back of a right hand", _place(layout, range(21), _hand()))]
    if layout.name == "ap10k17":
        return [("", _place(layout, range(17), _ANIMAL))]
    if layout.name == "cmu31":
        mirrored = {"r" + n[1:]: (-x, y) for n, (x, y) in _CMU.items() if n[0] == "l" and x}
        return [("", _place(layout, range(31), {**_CMU, **mirrored}))]
    body = _BODY | {f"right_{n[5:]}": (-x, y) for n, (x, y) in _BODY.items() if x}
    start = next((i for i, n in enumerate(layout.keypoints) if n == "right_jaw_1"), None)
    if start is None:
        own = [i for i, name in enumerate(layout.keypoints) if name in body]
        parts = [("", _place(layout, own, body))]
    else:
        face = dict(enumerate(_face(), start))
        if "left_pupil" in layout.keypoints:
            face[layout.index("right_pupil")] = (-2.05, 1.4)
            face[layout.index("left_pupil")] = (2.05, 1.4)
        count = 26 if start == 26 else min(start, 25)
        parts = [("", _place(layout, range(count), body)), ("face", face)]
    for side, sign in (("right", 1), ("left", -1)):
        hand = {f"{side}_{n}": (sign * x, y) for n, (x, y) in _hand().items()}
        if f"{side}_hand_wrist" in layout.keypoints or start is not None:
            own = [layout.index(n) for n in hand if n in layout.keypoints]
            parts.append((f"back of the {side} hand", _place(layout, own, hand)))
    return parts


def _place(layout: KeypointLayout, which: Iterable[int], at: dict[str, Point]) -> dict[int, Point]:
    """Return the positions of some keypoints by their indices."""
    return {i: at[layout.keypoints[i]] for i in which}


def _draw(axes: Axes, layout: KeypointLayout, title: str, at: dict[int, Point]) -> None:
    """Draw a part: edges, and the index of each keypoint in a disc."""
    for a, b in layout.edge_indices():
        if a in at and b in at:
            axes.plot(*zip(at[a], at[b], strict=True), color="#9aa3ad", lw=1.5, zorder=1)
    for i, (x, y) in at.items():
        name = layout.keypoints[i]
        side = _LEFT if name.startswith("left_") else _RIGHT if name.startswith("right_") else ""
        if layout.name == "cmu31" and x:
            side = _LEFT if x > 0 else _RIGHT
        box = {"boxstyle": "circle,pad=0.18", "fc": side or _MIDDLE, "ec": "white", "lw": 0.6}
        axes.text(
            x,
            y,
            str(i),
            color="white",
            fontsize=5 if title == "face" else 6,
            ha="center",
            va="center",
            bbox=box,
        )
    xs, ys = zip(*at.values(), strict=True)
    axes.set_xlim(min(xs) - 0.6, max(xs) + 0.6)
    axes.set_ylim(min(ys) - 0.6, max(ys) + 0.6)
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=8)
    axes.axis("off")


def draw(layout: KeypointLayout, folder: Path) -> None:
    """Write the picture of a layout, NAME.png, to a folder."""
    parts = positions(layout)
    if len(parts) == 1:
        figure, axes = plt.subplots(figsize=(4.2, 5.6))
        _draw(axes, layout, *parts[0])
    else:
        figure, grid = plt.subplots(2, 2, figsize=(9, 9.5))
        for axes in grid.flat:
            axes.axis("off")
        for axes, part in zip(grid.flat, parts, strict=False):
            _draw(axes, layout, *part)
    drawn = BytesIO()
    figure.savefig(drawn, dpi=100, bbox_inches="tight", facecolor="white")
    plt.close(figure)
    palette = Image.open(drawn).convert("RGB").quantize(32)  # a third of the bytes
    palette.save(folder / f"{layout.name}.png", optimize=True)


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for preset in LAYOUTS.values():
        draw(preset, FOLDER)
