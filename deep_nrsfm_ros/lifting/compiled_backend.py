# SPDX-License-Identifier: Apache-2.0
"""The lifter's computation as one call of the compiled kernel, for networks that it supports.

`numpy_backend` computes the same for all networks, some ten times slower; a test compares the two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.kernel import _kernel
from deep_nrsfm_ros.lifting import gravity, history, own_bones
from deep_nrsfm_ros.lifting.confidence import (
    EXTENT_OFFSET,
    MIN_KNOWN,
    RESIDUAL_OFFSET,
)
from deep_nrsfm_ros.lifting.correction import UNKNOWN_VARIANCE
from deep_nrsfm_ros.lifting.history import Context
from deep_nrsfm_ros.lifting.network_smoothing import MAX_AGREEMENT, MAX_TURN
from deep_nrsfm_ros.lifting.numpy_backend import MIN_RELATIVE_DEPTH, RESIDUAL_SCALE, LifterConstants
from deep_nrsfm_ros.lifting.options import HistoryOptions
from deep_nrsfm_ros.lifting.weights import FULL_RATIO, TRUSTED_RATIO
from deep_nrsfm_ros.lifting.wrong_keypoints import (
    CANDIDATES,
    FEWEST,
    MIN_DISTANCE,
    MIN_RESIDUAL,
    MOST,
    RESIDUAL_RATIO,
)
from deep_nrsfm_ros.nrsfm.bones import Bones
from deep_nrsfm_ros.nrsfm.network import completion_matrix, point_precision


class CompiledBackend:
    """Lifts with the kernel, which holds the lifter's constants in its own layout (a plan)."""

    def __init__(self, constants: LifterConstants) -> None:
        """Lay out the constants.

        Args:
            constants: of a network that `kernel.supports`.

        Raises:
            ValueError: A constant is out of the kernel's range.
        """
        net, p = constants.network, constants.network.p
        options = net.architecture
        covariance = np.eye(3 * p) if constants.covariance is None else constants.covariance
        header = [
            p,
            len(options.widths),
            len(constants.test_time_rotations),
            constants.partners is not None,
        ]
        header += [bool(options.whitening), constants.normaliser.scale == "rms"]
        header += [constants.covariance is not None]
        header += [constants.refill, *(constants.reference or (-1, -1)), constants.min_visible]
        bones = constants.bones or Bones(np.zeros((2, 0), np.int32), np.zeros(0), np.zeros(0))
        header += [constants.leave_out_wrong, *(FEWEST, CANDIDATES, MOST)]
        header += [len(bones.lengths), len(constants.derivations), *options.widths]
        header += [*(constants.partners or range(p)), *bones.ends.T.flat]
        header += [*constants.derivations.flat, *constants.bone_partners]
        floats = [_panels(net.L), _panels(net.L_inverse)]
        for i, (D, b, b_) in enumerate(zip(net.D, net.b, net.b_, strict=True)):
            # The kernel stores shapes with the keypoints last, (3, p).
            encoder = D if i else _padded(D).reshape(p, -1)
            decoder = D.T if i else _padded(D.transpose(2, 1, 0)).reshape(D.shape[2], -1)
            floats += [_panels(encoder), _padded(b), _panels(decoder), _padded(b_ if i else b_.T)]
        last = options.widths[-1]
        code_head = _padded(net.code_head.reshape(6, last, last).swapaxes(1, 2)).swapaxes(1, 2)
        floats += [
            _panels(code_head.reshape(-1, last)),
            net.camera_head,
            np.log(constants.error_std),
        ]
        # Three rows for each keypoint: (p, 3, 3, p), both p padded.
        rows = _padded(covariance.reshape(p, 3, p, 3).swapaxes(2, 3), _kernel.DOUBLES)
        rows = _padded(rows.swapaxes(0, 3), _kernel.DOUBLES).swapaxes(0, 3)
        floats += [rows]
        doubles = [completion_matrix(net), constants.test_time_rotations, constants.object_frame]
        axis = np.zeros(p) if constants.axis is None else constants.axis
        correlation = bones.correlation
        doubles += [constants.calibration, point_precision(net)]
        doubles += [np.stack((bones.lengths, bones.spread), 1)]
        doubles += [np.eye(len(bones.lengths)) if correlation is None else correlation]
        doubles += [axis, _history_constants(constants.history)]
        doubles += [
            constants.noise,
            constants.reference_length,
            UNKNOWN_VARIANCE * np.trace(covariance) / (3 * p),
            MIN_RELATIVE_DEPTH,
            RESIDUAL_SCALE,
        ]
        doubles += [MIN_RESIDUAL, RESIDUAL_RATIO, MIN_DISTANCE]
        doubles += [RESIDUAL_OFFSET, TRUSTED_RATIO**6, FULL_RATIO, EXTENT_OFFSET, MIN_KNOWN]
        self._plan = _kernel.plan(
            np.array(header, np.int32), _joined(floats, np.float32), _joined(doubles, np.float64)
        )
        self._p = p

    def __call__(
        self,
        points: NDArray[np.float32],
        confidence: NDArray[np.float32],
        perspective: bool,
        context: Context | None = None,
    ) -> tuple[tuple[NDArray[Any], ...], NDArray[np.bool_]]:
        """Return the fields of `lifting.Lifted`, and (n,) True for objects that are not lifted.

        Args:
            points: (n, p, 2) as in `Lifter.__call__`.
            confidence: (n, p) in [0, 1], 0 = missing.
            perspective: as in `Lifter.lift`.
            context: as in `Lifter.lift`.

        Raises:
            ValueError: The shapes do not fit the model.
        """
        n, p = confidence.shape
        shapes = ((n, p, 3), (n, 3, 3), n, (n, 2), n, (n, p))
        numbers = (np.empty(shape, np.float32) for shape in shapes)
        lifted = (*numbers, np.empty((n, p), np.bool_))
        not_lifted = np.empty(n, np.bool_)
        _kernel.lift(
            self._plan,
            np.ascontiguousarray(points, np.float32),
            np.ascontiguousarray(confidence, np.float32),
            perspective,
            context,
            *lifted,
            not_lifted,
        )
        return lifted, not_lifted


def _history_constants(options: HistoryOptions) -> list[float]:
    """Return the numbers of the kernel's `HistoryConstants`, in its order."""
    return [
        *(options.shape_time, options.hidden_time, options.rotation_time, options.bones_time),
        *(history.MAX_GAP, history.MAX_BACK),
        *(own_bones.OUTLIER, own_bones.MAX_STEP, own_bones.MAX_SECONDS, own_bones.MEMORY),
        *(own_bones.MAX_VARIANCE_REDUCTION, own_bones.MISFIT_TIME, own_bones.MISFIT_RATIO),
        *(own_bones.CHANGE_EVIDENCE, own_bones.DOUBTED_EVIDENCE),
        *(gravity.LEAN_DEVIATION, gravity.FREE_LEAN),
        *(math.cos(math.radians(MAX_TURN)), MAX_AGREEMENT),
    ]


def _padded(A: NDArray[Any], multiple: int | None = None) -> NDArray[Any]:
    """Return A (..., n) padded with zeros to n a multiple, by default of FLOATS."""
    more = -A.shape[-1] % (multiple or _kernel.FLOATS)
    return np.pad(A, ((0, 0),) * (A.ndim - 1) + ((0, more),))


def _panels(A: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return A (k, n) in panels of FLOATS columns, (panels, k, FLOATS), as the kernel reads it."""
    return _padded(A).reshape(len(A), -1, _kernel.FLOATS).swapaxes(0, 1)


def _joined(parts: Sequence[object], kind: type) -> NDArray[np.float32]:
    return np.concatenate([np.ravel(np.asarray(part, kind)) for part in parts])
