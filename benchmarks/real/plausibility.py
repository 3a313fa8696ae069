# SPDX-License-Identifier: Apache-2.0
"""Label-free measures of lifted people: facing, knees, toes, bone lengths, depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.nrsfm.bones import relative_lengths
from deep_nrsfm_ros.nrsfm.geometry import centre

Floats = NDArray[Any]

SIDES = ("left", "right")
BENT = 20.0
"""Degrees from which a knee counts as bent."""
FIGURES = {
    "faces %": "frames with the nose in front of the plane of neck and hips",
    "knees %": f"knees bent by {BENT:.0f} degrees or more that bend to the front",
    "toes %": "feet with the toes in front of the ankle",
    "bones %": "spread of a bone's share of the total length: half the distance of the 16th and "
    "84th percentile over the median, mean of the bones",
    "depth %": "RMS depth over RMS size: 0 is flat",
}
"""Only visible keypoints count. A mirrored person has 0 % where a real one has 100 %."""
_VIEWS = ("camera", "right", "above")
_COLOURS = {"left": "tab:blue", "right": "tab:red"}


def figures(S: Floats, visible: NDArray[np.bool_]) -> dict[str, float]:
    """Return the FIGURES of people S (f, p, 3) in camera axes, any unit, in the layout human17."""
    forward = _forward_direction(S)
    nose = _in_front(_joint(S, "nose") - _joint(S, "neck"), forward)
    knees, toes = [], []
    for side in SIDES:
        leg = [f"{side}_{part}" for part in ("hip", "knee", "ankle", "big_toe")]
        hip, knee, ankle, toe = (_joint(S, name) for name in leg)
        visible_joints = np.stack([visible[:, HUMAN17.index(name)] for name in leg], 1)
        bent = visible_joints[:, :3].all(1) & (_angle(knee - hip, ankle - knee) >= BENT)
        knees.append(_in_front(knee - (hip + ankle) / 2, forward)[bent])
        toes.append(_in_front(toe - ankle, forward)[visible_joints[:, 2:].all(1)])
    shares = (nose, np.concatenate(knees), np.concatenate(toes))
    X = centre(S)
    depth = np.sqrt((X[..., 2] ** 2).mean() / (X**2).sum(2).mean())
    values = (*map(_percent, shares), 100 * _spread(S, visible), 100 * float(depth))
    return dict(zip(FIGURES, values, strict=True))


def draw(
    figure: Figure, dataset: Dataset, lifted: Mapping[str, Floats], frames: Sequence[int]
) -> None:
    """Draw the keypoints of some frames and, below, each method's people from three sides."""
    rows = [("seen", None), *((name, view) for name in lifted for view in _VIEWS)]
    figure.set_size_inches(1.9 * len(frames), 2.2 * len(rows))
    axes = figure.subplots(len(rows), len(frames), squeeze=False)
    for (name, view), row in zip(rows, axes, strict=True):
        row[0].set_ylabel(name if view is None else f"{name}\nfrom {view}", fontsize="small")
        for axis, i in zip(row, frames, strict=True):
            if view is None:
                visible_joints = dataset.visible[i, :, None]
                _person(axis, np.where(visible_joints, dataset.points[i], np.nan))
                axis.set_title(f"object {i}", fontsize="small")
            else:
                x, y, z = lifted[name][i].T
                # The camera looks along z, y is down: from the right z goes to the left of it.
                across = {"camera": (x, y), "right": (z, y), "above": (x, -z)}[view]
                _person(axis, np.stack(across, 1))


def _person(axis: Axes, points: Floats) -> None:
    """Draw points (p, 2), y down."""
    for a, b in HUMAN17.edges:
        side = next((s for s in SIDES if s in a or s in b), "")
        ends = points[[HUMAN17.index(a), HUMAN17.index(b)]]
        axis.plot(*ends.T, color=_COLOURS.get(side, "0.3"), linewidth=1.5)
    axis.set_aspect("equal", adjustable="datalim")
    axis.invert_yaxis()
    axis.set(xticks=[], yticks=[])


def _joint(S: Floats, name: str) -> Floats:
    joint: Floats = S[:, HUMAN17.index(name)]
    return joint


def _forward_direction(S: Floats) -> Floats:
    """Return the facing direction of people (f, p, 3): normal of hip line and spine."""
    left = _joint(S, "left_hip") - _joint(S, "right_hip")
    forward: Floats = np.cross(left, _joint(S, "neck") - _joint(S, "mid_hip"))
    return forward


def _in_front(X: Floats, forward: Floats) -> NDArray[np.bool_]:
    ahead: NDArray[np.bool_] = (X * forward).sum(-1) > 0
    return ahead


def _angle(a: Floats, b: Floats) -> Floats:
    sizes = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    cosine = (a * b).sum(-1) / np.maximum(sizes, 1e-9)
    degrees: Floats = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return degrees


def _percent(condition: NDArray[np.bool_]) -> float:
    return 100 * float(condition.mean()) if len(condition) else float("nan")


def _spread(S: Floats, visible: NDArray[np.bool_]) -> float:
    edges = HUMAN17.edge_indices()
    a, b = np.array(edges).T
    lengths = relative_lengths(S, edges)
    visible_joints = visible[:, a] & visible[:, b]
    lengths[~visible_joints] = np.nan
    low, middle, high = np.nanpercentile(lengths[:, visible_joints.any(0)], (16, 50, 84), axis=0)
    return float(np.mean((high - low) / 2 / middle))
