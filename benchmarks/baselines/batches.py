"""The baselines on whole subjects, as in the paper: shuffled batches, mean of the errors."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from benchmarks.baselines.methods import BATCH, Method, block_matrix, em_ppca, in_batches, rigid
from benchmarks.harness import Session
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.nrsfm.metrics import ShapeErrors, shape_errors

RANKS = (2, 3, 4, 5, 6, 7, 8)
"""Ranks K to choose from."""
BASELINES: dict[str, Any] = {
    "rigid factorisation (Tomasi-Kanade)": rigid,
    "Simple (Dai et al.)": block_matrix,
    "EM-SfM (Torresani et al., EM-PPCA)": em_ppca,
}
LEGEND = {
    "Simple, EM-SfM": f"shuffled batches of {BATCH} frames, each with its own reflection; "
    "K has the lowest error against the ground truth on the first batch, which favours them",
}


class Solved(NamedTuple):
    """The result of a baseline on all frames."""

    errors: ShapeErrors
    rank: int  # 0 if the method has no rank
    cpu_seconds: float  # without the search for the rank


def solve(session: Session, name: str, dataset: Dataset) -> Solved:
    """Return a baseline's errors on a dataset with ground truth, kept in the output folder."""
    digest = hashlib.sha256(name.encode() + dataset.points.tobytes()).hexdigest()[:10]
    path = session.output / "baselines" / f"{digest}.json"
    if not path.exists():
        solved = _solve(name, dataset)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(solved))
    errors, rank, seconds = json.loads(path.read_text())
    return Solved(ShapeErrors(*errors), rank, seconds)


def _solve(name: str, dataset: Dataset) -> Solved:
    method, rank = BASELINES[name], 0
    if method is rigid:
        began = time.process_time()
        errors = shape_errors(rigid(dataset.points), _truth(dataset))
        return Solved(errors, rank, time.process_time() - began)
    first = dataset[np.random.default_rng(0).permutation(len(dataset))[:BATCH]]
    by_rank = {
        K: shape_errors(method(first.points, K), _truth(first)).shape
        for K in tqdm(RANKS, f"{name}, K", leave=False)
    }
    rank = min(by_rank, key=by_rank.__getitem__)
    began = time.process_time()
    errors = batch_errors(partial(method, K=rank), dataset, name)
    return Solved(errors, rank, time.process_time() - began)


def batch_errors(method: Method, dataset: Dataset, title: str = "") -> ShapeErrors:
    """Return the errors of `method` in batches, each compared by itself, averaged over frames."""
    count = max(1, round(len(dataset) / BATCH))
    with tqdm(total=count, desc=title) as bar:

        def counted(W: Any) -> Any:
            S = method(W)
            bar.update()
            return S

        S, frames = in_batches(counted, dataset.points, np.random.default_rng(0))
    pairs = zip(
        np.array_split(S, count), np.array_split(_truth(dataset)[frames], count), strict=True
    )
    return _mean([(len(part), shape_errors(part, truth)) for part, truth in pairs])


def _mean(parts: Sequence[tuple[int, ShapeErrors]]) -> ShapeErrors:
    sizes = [size for size, _ in parts]
    return ShapeErrors(*np.average([errors for _, errors in parts], axis=0, weights=sizes).tolist())


def _truth(dataset: Dataset) -> Any:
    if dataset.shapes is None:
        raise ValueError(f"{dataset.source} has no ground truth to compare with")
    return dataset.shapes
