# SPDX-License-Identifier: Apache-2.0
"""Depth that is steady over time, while each point stays where the image has it.

A point's depth is what the network estimates, and trembles; its place in the image is what the
detector has measured. So a One-Euro filter is applied to the depths alone, after the correction:
nothing lags in the image. All points of an object share one cutoff, which rises with the object's
speed, so that its shape does not lag behind itself.

Sources: Casiez, Roussel and Vogel, "1 Euro Filter", CHI 2012. The filter of depths alone is ours.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.lifting.history import MAX_BACK, MAX_GAP, Context, Memory
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.smoothing import SPEED_CUTOFF, low_pass_gain
from deep_nrsfm_ros.nrsfm.geometry import rotation_from_vector

Floats = NDArray[Any]

BETA = 8.0
"""Hz by which the cutoff rises for each RMS radius per second."""
_NEAREST = 1e-6  # depth in front of the camera, below which there is no ray


class _State(NamedTuple):
    """What is remembered of one object, as views of its row.

    Attributes:
        time: (1,) of the last frame in seconds; NaN: there was none.
        points: (p, 3) as lifted in that frame.
        velocity: (p, 3) smoothed, in units of the points per second.
        depths: (p,) smoothed.
    """

    time: Floats
    points: Floats
    velocity: Floats
    depths: Floats


def _split(row: Floats, p: int) -> _State:
    """Return the parts of the row (1 + 7 p,) of an object of p points."""
    points, velocity = row[1 : 1 + 6 * p].reshape(2, p, 3)
    return _State(row[:1], points, velocity, row[1 + 6 * p :])


@functools.lru_cache(maxsize=8)
def _constants(cutoff: float) -> Floats:
    """Return the constants of the kernel's form."""
    return np.array([cutoff, BETA, SPEED_CUTOFF, MAX_GAP, MAX_BACK])


def steady_depths(lifted: Lifted, memory: Memory, context: Context) -> Lifted:
    """Return the objects of a frame with steady depths.

    An object all of whose points are in front of the camera is at its place: its points move along
    their rays. Otherwise they move along the optical axis. The rotation follows the points. Objects
    that are new, were away, or have the stamp of their last frame are returned as they are.

    Args:
        lifted: n objects.
        memory: of their topic; what it knows of their depths is updated.
        context: as the memory returned it for this frame.
    """
    cutoff = memory.depth_cutoff
    if not cutoff or not len(context.rows):
        return lifted
    shapes, rotations = lifted.shapes.copy(), lifted.rotations.copy()
    if kernel.AVAILABLE and shapes.dtype == rotations.dtype == np.float32:
        kernel._kernel.steady_depths(
            context.time, _constants(cutoff), memory.depth_states, context.rows, shapes, rotations
        )
    else:
        for i, row in enumerate(context.rows.tolist()):
            if row >= 0 and not np.isnan(shapes[i]).any():
                state = _split(memory.depth_states[row], shapes.shape[1])
                shapes[i], rotations[i] = _steadied(
                    state, shapes[i].astype(np.float64), rotations[i], context.time, cutoff
                )
    return lifted._replace(shapes=shapes, rotations=rotations)


def _steadied(
    state: _State, S: Floats, R: Floats, time: float, cutoff: float
) -> tuple[Floats, Floats]:
    """Return points S (p, 3) and rotation R (3, 3) of one object with steady depths."""
    elapsed = time - float(state.time[0])
    if not -MAX_BACK <= elapsed <= MAX_GAP:
        state.time[:], state.points[:], state.velocity[:] = time, S, 0
        state.depths[:] = S[:, 2]
        return S, R
    if elapsed <= 0:
        return S, R
    centred = S - S.mean(0)
    radius = np.sqrt((centred * centred).sum(1).mean()) or 1.0
    state.velocity[:] += low_pass_gain(SPEED_CUTOFF, elapsed) * (
        (S - state.points) / elapsed - state.velocity
    )
    speed = np.sqrt((state.velocity * state.velocity).sum(1).mean()) / radius
    state.depths[:] += low_pass_gain(cutoff + BETA * speed, elapsed) * (S[:, 2] - state.depths)
    state.time[:], state.points[:] = time, S
    if (np.minimum(S[:, 2], state.depths) > _NEAREST).all():
        steady = S * (state.depths / S[:, 2])[:, None]
    else:
        steady = np.column_stack((S[:, :2], state.depths))
    return steady, rotation_from_vector(_turn(centred, steady - S)) @ R


def _turn(centred: Floats, moved: Floats) -> Floats:
    """Return the rotation vector (3,) that explains best how points have moved, to first order.

    Args:
        centred: (p, 3) points about their centroid.
        moved: (p, 3) by how much each has moved.
    """
    squares = (centred * centred).sum()
    inertia = squares * np.eye(3) - centred.T @ centred
    # Points on one line determine no rotation about it: a millionth of their extent is added.
    vector: Floats = np.linalg.solve(
        inertia + 1e-6 * squares * np.eye(3), np.cross(centred, moved).sum(0)
    )
    return vector
