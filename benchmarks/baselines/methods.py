# SPDX-License-Identifier: Apache-2.0
"""The methods that the paper compares with and their peers, written from their papers' equations.

Each takes W (f, p, 2), one orthographic image a frame, centred on its points, and returns
S (f, p, 3). An orthographic image does not determine the sign of depth, so the result is up to one
reflection of all frames. A method that has equally good results for one problem returns all,
S (n, f, p, 3). Cameras are rotations without a scale. No method uses the order of the frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines.alike import block_matrix_of_neighbours
from benchmarks.baselines.sparse import sparse
from benchmarks.baselines.structure_from_category import structure_from_category
from deep_nrsfm_ros.nrsfm.factorisation.block_matrix import block_matrix
from deep_nrsfm_ros.nrsfm.factorisation.em_ppca import em_ppca, em_ppca_by_likelihood
from deep_nrsfm_ros.nrsfm.factorisation.rigid import rigid

__all__ = ["BASELINES", "BATCH", "Baseline", "block_matrix", "em_ppca", "rigid", "shuffled_batches"]

Floats = NDArray[Any]
Method = Callable[..., Floats]
Setting = Mapping[str, Any]

BATCH = 500
"""Frames of a batch, as in the paper; no baseline scales to a whole subject."""


@dataclass(frozen=True)
class Baseline:
    """A method and how it is run.

    Attributes:
        method: of (W, **setting), or of (W, frames, **setting) if `by_neighbours`.
        settings: to choose from, by the truth, which favours the method.
        legend: what the row shows.
        by_neighbours: each of some frames is solved with the frames most like it.
        whole: all frames are solved together.
    """

    method: Method
    settings: tuple[Setting, ...] = ({},)
    legend: str = ""
    by_neighbours: bool = False
    whole: bool = False


def _ranks(*ranks: int) -> tuple[Setting, ...]:
    return tuple({"K": K} for K in ranks)


BASELINES: dict[str, Baseline] = {
    "rigid factorisation (Tomasi-Kanade)": Baseline(rigid, whole=True),
    "Simple (Dai et al.)": Baseline(block_matrix, _ranks(2, 3, 4, 5, 6, 8)),
    "Simple, weighted nuclear norm (Kumar)": Baseline(
        lambda W, K: block_matrix(W, K, weighted=True),
        _ranks(2, 3, 4, 5, 6, 8),
        "singular values shrunk in proportion to 1 / (sigma + floor); cameras of Simple",
    ),
    "Simple on frames that look alike": Baseline(
        block_matrix_of_neighbours,
        tuple({"K": K, "neighbours": n} for K, n in ((2, 12), (2, 25), (2, 50), (4, 150))),
        "each frame is solved with the frames most like it, found without labels or time",
        by_neighbours=True,
    ),
    "EM-SfM (Torresani et al.)": Baseline(em_ppca, _ranks(5, 8, 12, 16)),
    "EM-SfM, annealed or not by likelihood": Baseline(
        em_ppca_by_likelihood,
        (*_ranks(8, 12, 16), {"K": 12, "starts": 3}),
        "of two runs, with the annealing of the authors' program and without, the more likely one; "
        "and a mirror test of each frame; starts: restarts with the cameras disturbed at random, "
        "of which the likeliest counts",
    ),
}

_SPARSE = tuple({"K": K, "active": active} for K, active in ((5, 1), (10, 2)))
BASELINES |= {
    "Sparse (Kong and Lucey), as released": Baseline(
        lambda W, K, active: sparse(W, K, active, repaired=False, focuss=True),
        _SPARSE,
        "coded by block FOCUSS; absolute eigenvalues, atoms synchronised by two random frames, the "
        "first camera",
    ),
    "Sparse, repaired": Baseline(
        lambda W, K, active, focuss: sparse(W, K, active, focuss=focuss),
        (*({**setting, "focuss": True} for setting in _SPARSE), {**_SPARSE[1], "focuss": False}),
        "positive Gram matrices with an inverse, atoms synchronised by all frames that they share, "
        "cameras from all atoms, shapes moved onto the images; coded by block FOCUSS or, without "
        "the word, by matching pursuit",
    ),
    "SfC (Kong et al.)": Baseline(
        lambda W, K, sparsity: structure_from_category(W, K, sparsity=sparsity, growth=1.03),
        (
            {"K": 1, "sparsity": 0.001},  # nearly rigid
            *({"K": K, "sparsity": 0.05} for K in (1, 2, 3, 5, 7)),
            {"K": 7, "sparsity": 0.01},
        ),
        "one start; the depth signs of the basis shapes, which the method "
        "leaves open, by the truth, which favours it",
    ),
}


def shuffled_batches(frames: int, rng: np.random.Generator) -> list[NDArray[np.int64]]:
    """Return the indices of shuffled batches of about `BATCH` frames, by `numpy.array_split`.

    Each batch has an object frame and a reflection of its own.
    """
    return np.array_split(rng.permutation(frames), max(1, round(frames / BATCH)))
