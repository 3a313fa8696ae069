# SPDX-License-Identifier: Apache-2.0
"""What a context adds to the lift of a frame, in NumPy: the readable form of `kernel/history.c`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.correction import ErrorModel
from deep_nrsfm_ros.lifting.gravity import Upright
from deep_nrsfm_ros.lifting.history import MAX_BACK, MAX_GAP, Context, State, StateLayout
from deep_nrsfm_ros.lifting.network_smoothing import (
    smooth_rotations,
    smooth_shapes,
    weigh_turns,
)
from deep_nrsfm_ros.lifting.own_bones import Learned, learn, measure, own_bones
from deep_nrsfm_ros.nrsfm.geometry import Floats

if TYPE_CHECKING:
    from deep_nrsfm_ros.lifting.numpy_backend import LifterConstants


class HistoryUpdate:
    """What is remembered of the n objects of a frame.

    An object that is not lifted changes nothing. A frame that is not later than the last one of its
    object uses the bones that are learned, and changes nothing either, unless it is earlier by more
    than `MAX_BACK`: time has begun anew.
    """

    def __init__(
        self, constants: LifterConstants, context: Context, not_lifted: NDArray[np.bool_]
    ) -> None:
        """Read the states of a context.

        Args:
            constants: of the lifter.
            context: of the frame.
            not_lifted: (n,) objects that cannot be lifted.
        """
        self._constants, self._context = constants, context
        n, p = len(not_lifted), constants.network.p
        b = 0 if constants.bones is None else len(constants.bones.lengths)
        self._layout = StateLayout(p, b)
        to_view = context.to_view
        self._to_view = np.tile(np.eye(3), (n, 1, 1)) if to_view is None else to_view
        rows = np.full((n, self._layout.size), np.nan)
        known = context.rows >= 0
        rows[known] = context.states[context.rows[known]]
        self._state = self._layout.split(rows)
        elapsed = context.time - self._state.time
        begins = np.isnan(elapsed)
        for part in (self._state.misfit, self._state.growth, self._state.evidence):
            part[begins] = 0
        self._restarts = begins | (elapsed < -MAX_BACK) | (elapsed > MAX_GAP)
        self._goes_on = ~self._restarts & (elapsed > 0)
        self._updates = known & ~not_lifted & (self._restarts | self._goes_on)
        self._seconds = np.where(begins | (elapsed < 0), 0, elapsed)
        self._new = self._state

    def smoothed(self, S: Floats, R: Floats, visible: NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """Return what the network finds, smoothed.

        Args:
            S: (n, p, 3) in object axes.
            R: (n, 3, 3) from object axes to those of the view.
            visible: (n, p) whether the network reads the keypoint.
        """
        options, state, n = self._constants.history, self._state, len(S)
        mean = S.mean(1, keepdims=True)
        shape, rotation = (S - mean).astype(np.float64), self._to_view.swapaxes(1, 2) @ R
        # A number that is not finite is not remembered, and not gone on with.
        self._updates &= np.isfinite(shape).all((1, 2))
        moves = self._goes_on & self._updates & np.isfinite(state.shape).all((1, 2))
        times = options.shape_time, options.hidden_time
        agreement = np.zeros(n)
        if options.rotation_time:
            held, begins, agreement[moves] = weigh_turns(
                state.rotation[moves], rotation[moves], state.agreement[moves], self._seconds[moves]
            )
            self._hold(moves, held, shape, rotation)
            moves[moves] = ~(held | begins)
        shape[moves] = smooth_shapes(
            state.shape[moves], shape[moves], visible[moves], self._seconds[moves], times
        )
        rotation[moves] = smooth_rotations(
            state.rotation[moves], rotation[moves], self._seconds[moves], options.rotation_time
        )
        self._new = self._new._replace(
            time=np.full(n, self._context.time),
            agreement=agreement,
            shape=shape,
            rotation=rotation,
        )
        return (shape + mean).astype(S.dtype), (self._to_view @ rotation).astype(R.dtype)

    def _hold(
        self, moves: NDArray[np.bool_], held: NDArray[np.bool_], S: Floats, R: Floats
    ) -> None:
        """Put what is remembered of the held ones in the place of S and R, at the size of S.

        Args:
            moves: (n,) objects that go on.
            held: (m,) those of them whose new rotation is not believed.
            S: (n, p, 3) centred shapes.
            R: (n, 3, 3).
        """
        rows = np.flatnonzero(moves)[held]
        known = self._state.shape[rows]
        visible = np.zeros(known.shape[:2], bool)
        S[rows] = smooth_shapes(known, S[rows], visible, np.zeros(len(rows)), (1.0, 1.0))
        R[rows] = self._state.rotation[rows]

    def learn(self, X: Floats, R: Floats, weight: Floats) -> None:
        """Learn the lengths of the bones from the first stage X (n, p, 3) of the correction."""
        bones, options = self._constants.bones, self._constants.history
        if bones is None or not options.bones_time:
            return
        sight = measure(bones, X.astype(np.float64), R.astype(np.float64), weight)
        partners = self._constants.bone_partners
        after = learn(bones, partners, self._learned, sight, self._seconds, options.bones_time)
        self._new = self._new._replace(**after._asdict())

    def errors(self, R: Floats) -> ErrorModel:
        """Return the prior of the errors, with each object's own bones, and gravity."""
        constants, up = self._constants, self._context.up
        bones, upright = constants.bones, None
        if bones is not None:
            bones = own_bones(bones, self._learned, constants.history.bones_time)
        if up is not None and constants.axis is not None:
            in_view = self._to_view @ up
            upright = Upright(constants.axis, (in_view[:, None] @ R)[:, 0].astype(np.float64))
        assert constants.covariance is not None
        return ErrorModel(constants.covariance, bones, upright)

    def write(self) -> None:
        """Write the states after the frame to the context."""
        updates = self._updates
        rows = np.empty((updates.sum(), self._layout.size))
        for part, new in zip(self._layout.split(rows), self._new, strict=True):
            part[:] = new[updates]
        self._context.states[self._context.rows[updates]] = rows

    @property
    def _learned(self) -> Learned:
        """What was learned of the bones before the frame."""
        state: State = self._state
        return Learned(state.growth, state.evidence, state.misfit)
