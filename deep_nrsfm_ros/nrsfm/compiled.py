"""The lifter's sums as one compiled call: `kernel/`, where it was compiled at installation.

Without it, and for options of the network that the default recipe does not use, `fitting` does the
same some ten times slower.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.confidence import CALIBRATED
from deep_nrsfm_ros.nrsfm.fitting import Constants
from deep_nrsfm_ros.nrsfm.network import Network, filling

try:
    from deep_nrsfm_ros.nrsfm import _kernel
except ImportError:  # no compiler at installation
    _kernel = None  # type: ignore[assignment]

AVAILABLE = _kernel is not None
_LANES = 16  # of the kernel: rows are padded to a multiple of it


def fits(network: Network) -> bool:
    """Tell whether there is a kernel, and it knows the network's options."""
    return AVAILABLE and network.architecture.usual


class Kernel:
    """A lifter's constants, laid out for the kernel."""

    def __init__(self, constants: Constants) -> None:
        """Take the constants, of a network that the kernel `fits`."""
        net, p = constants.network, constants.network.p
        options = net.architecture
        covariance = np.eye(3 * p) if constants.covariance is None else constants.covariance
        header = [p, len(options.widths), len(constants.turns), constants.partners is not None]
        header += [bool(options.whitening), constants.normaliser.scale == "rms"]
        header += [constants.covariance is not None]
        header += [constants.refill, *(constants.reference or (-1, -1)), constants.min_visible]
        header += [*options.widths, *(constants.partners or range(p))]
        floats = [_padded(net.L), _padded(net.L_inverse)]
        for i, (D, b, b_) in enumerate(zip(net.D, net.b, net.b_, strict=True)):
            encoder = D if i else D.reshape(p, -1)
            # The shape's coordinates come out one after the other, (3, p).
            decoder = D.T if i else D.transpose(2, 1, 0).reshape(-1, 3 * p)
            floats += [_padded(encoder), b, _padded(decoder), b_ if i else b_.T]
        floats += [_padded(net.code_head), net.camera_head, constants.spread]
        doubles = [filling(net), constants.turns, constants.frame, covariance, CALIBRATED]
        doubles += [constants.noise, constants.length, np.trace(covariance) / (3 * p)]
        self._plan = _kernel.plan(
            np.array(header, np.int32), _joined(floats, np.float32), _joined(doubles, np.float64)
        )
        self._p = p

    def __call__(
        self, points: NDArray[np.float32], confidence: NDArray[np.float32], perspective: bool
    ) -> tuple[tuple[NDArray[np.float32], ...], NDArray[np.bool_]]:
        """Return the fields of `lifting.Lifted`, and (n,) where there is nothing to lift.

        Arguments as those of `Lifter.__call__`, their shapes checked.
        """
        n, p = confidence.shape
        shapes = ((n, p, 3), (n, 3, 3), n, (n, 2), n, (n, p))
        lifted = tuple(np.empty(shape, np.float32) for shape in shapes)
        lost = np.empty(n, np.bool_)
        _kernel.lift(
            self._plan,
            np.ascontiguousarray(points, np.float32),
            np.ascontiguousarray(confidence, np.float32),
            perspective,
            *lifted,
            lost,
        )
        return lifted, lost


def _padded(A: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.pad(A, ((0, 0), (0, -A.shape[1] % _LANES)))


def _joined(parts: Sequence[object], kind: type) -> NDArray[np.float32]:
    return np.concatenate([np.ravel(np.asarray(part, kind)) for part in parts])
