# SPDX-License-Identifier: Apache-2.0
"""Shapes on which several factorisations of few frames agree, chosen without ground truth.

0. An object that comes closer grows in the image. Rank-9 factorisation determines the scale of each
   image. Where scales differ by more than the noise of that, the images are divided by them.
1. Cameras come from rigid factorisation and from the block-matrix method with several ranks. The
   shapes of lowest nuclear norm are found for each. Cameras whose norm is within 0.5 % of the
   lowest are kept.
2. From each of these, EM-PPCA refines cameras and shapes with 3, 5, 8 and 12 modes. Where 2 to 4
   modes leave no noise, the object has no more: the likeliest of these models is the result.
3. All solutions meet the images after back-projection, so they differ in depth alone. Solutions far
   from the median are left out. EM-PPCA starts again from the weighted mean of the others. For its
   cameras there are shapes of lowest weighted nuclear norm, too. The result is the weighted mean of
   all these solutions.
4. Where half or more of the solutions of EM-PPCA are far from the median, only its cameras are
   kept, with those of EM-PPCA from rigid factorisation. The shapes of lowest nuclear norm take the
   place of its shapes. In each of three rounds EM-PPCA starts from the mean of these solutions. In
   the last round the nuclear norm is weighted, which shrinks large singular values less. Where a
   model of this round leaves no noise, the one with the fewest modes is the result.

The errors of depth of the solutions are partly independent, so that the mean is better than each:
on pickup, yoga and face_mocap by 15 to 50 %.

Source: Dai, Li and He (2014); Kumar (2020), weights; Torresani, Hertzmann and Bregler (2008);
the consensus is ours.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.factorisation.block_matrix import (
    NORM_ITERATIONS,
    block_cameras,
    block_rotations,
    least_nuclear_norm,
)
from deep_nrsfm_ros.nrsfm.factorisation.em_ppca import (
    LinearModel,
    fit_from_rigid,
    fit_from_shapes,
    shapes_of,
)
from deep_nrsfm_ros.nrsfm.factorisation.rigid import rigid_rotations
from deep_nrsfm_ros.nrsfm.geometry import align, back_project, centre, rotation_from_camera

Floats = NDArray[Any]

RANKS = (3, 8, 12)
"""Ranks of the block-matrix method, whose cameras are tried."""
MODES = (3, 5, 8, 12)
"""Numbers of modes of EM-PPCA."""
DISAGREEMENT = 0.1
"""Root mean square difference of depth, relative to the size of the images, above which a solution
is left out."""

_SCALE_RANK = 3
_SAME_SCALE = 0.15  # range of the middle half of the logarithms: 0.09 without differences on pickup
_LEAST_SCALE = 0.1
_SAME_NORM = 1.005  # times the lowest nuclear norm: cameras that are kept
_ROUNDS = (100, 100)  # iterations of EM-PPCA in each
_LAST_ROUND = 1000
_ALIGNMENTS = 20  # of the shapes to their mean, a round
_EM_ITERATIONS = 100
_MORE_ITERATIONS = 300  # where there is no noise: EM converges slowly
_NO_NOISE = 1e-5  # variance of the noise, relative to that of the images, that is none
_NO_NOISE_AT_LAST = 1e-6  # the same after the last round: furniture 5e-7, dance 1e-5
_FEW_MODES = (2, 3, 4)
_TIMED = 15  # iterations from which the duration of all is estimated
_MODES_FROM_MEAN = (5, 8, 12, 20)  # of EM-PPCA where solutions agree


class Consensus(NamedTuple):
    """Shapes of all frames and how far the solutions agree.

    Attributes:
        shapes: (f, p, 3) in the axes of one object frame, up to one reflection; centred.
        rotations: (f, 3, 3) from object to camera.
        scales: (f,) of the images, 1 where they hardly differ: scale * projected shape = image.
        spread: root mean square difference of depth between the solutions and the result, relative
            to the size of the images: 0.03 typical, 0.3 no agreement. It is that of the solutions
            before EM-PPCA starts from their mean, which are independent of each other; at first
            that of the two cameras with the lowest nuclear norms.
        solutions: number of solutions that were averaged.
    """

    shapes: Floats
    rotations: Floats
    scales: Floats
    spread: float
    solutions: int


class _Solution(NamedTuple):
    """Rotations Q (f, 3, 3) and shapes S (f, p, 3), which meet the images."""

    Q: Floats
    S: Floats


def consensus(
    W: Floats,
    before_each: Callable[[], None] = lambda: None,
    on_result: Callable[[Consensus], None] = lambda result: None,
) -> Consensus:
    """Return the shapes on which factorisations of all frames agree.

    Args:
        W: (f, p, 2) complete images, x right and y down; at least 4 frames and points.
        before_each: called before each iteration of each factorisation, so every second or more
            often for 2000 images; an exception ends the work.
        on_result: called with each mean of solutions on the way, which are nearer to the shapes
            from one to the next; the last one is returned.
    """
    W = centre(W.astype(np.float64))
    scales = image_scales(W)
    W = W / scales[:, None, None]
    result = None
    for found in _means(W, before_each):
        shapes = centre(found.seen @ found.Q)
        result = Consensus(shapes, found.Q, scales, found.spread, found.solutions)
        on_result(result)
    assert result is not None
    return result


def seconds_at_most(W: Floats, before_each: Callable[[], None] = lambda: None) -> float:
    """Return about how many seconds `consensus` takes at most here, from a few timed iterations.

    It counts the iterations of the longer way, in rounds, from two cameras that are kept. Where
    solutions agree it takes half of that or less.

    Args:
        W: see `consensus`.
        before_each: see `consensus`.
    """
    W = centre(W.astype(np.float64))
    Q = rotation_from_camera(rigid_rotations(W).swapaxes(1, 2))
    fewest, most = MODES[0], MODES[-1]
    norm = _seconds_of_one(
        lambda tick: least_nuclear_norm(W, Q[:, :2], _TIMED, before_each=tick), before_each
    )
    less, more = (_seconds_of_one(partial(_run_em, W, K), before_each) for K in (fewest, most))

    def em(modes: Sequence[int]) -> float:
        slope = (more - less) / (most - fewest)
        return sum(less + slope * (K - fewest) for K in modes)

    modes, starts = _modes_in_rounds(W), 2
    norms = len(RANKS) + 1 + len(modes) * (starts + 1 + len(_ROUNDS) + 1)
    each = 2 * em(_FEW_MODES) + starts * em(MODES) + em(modes)
    rounds = (sum(_ROUNDS) + _LAST_ROUND) * em(modes)
    return NORM_ITERATIONS * norms * norm + _EM_ITERATIONS * each + rounds


def _run_em(W: Floats, K: int, before_each: Callable[[], None]) -> None:
    """Take the iterations of EM-PPCA that are timed."""
    fit_from_rigid(W, K, iterations=_TIMED, before_each=before_each)


def _seconds_of_one(
    run: Callable[[Callable[[], None]], object], before_each: Callable[[], None]
) -> float:
    """Return the mean seconds of an iteration of `run`, which calls its argument before each."""
    ticks = []

    def tick() -> None:
        before_each()
        ticks.append(time.monotonic())

    run(tick)
    return (ticks[-1] - ticks[0]) / (len(ticks) - 1)


def _means(W: Floats, before_each: Callable[[], None]) -> Iterator[_Mean]:
    """Yield means of solutions, from the first to the best one."""
    starts, spread = _best_starts(W, before_each)
    yield _mean(W, starts)._replace(spread=spread)
    if exact := _exact(W, before_each):
        yield _mean(W, exact)
        return
    models = [
        model for start in starts for model in _models(W, start, MODES, _EM_ITERATIONS, before_each)
    ]
    refined = [_solution(W, model) for model in models]
    agreeing = _agreeing(W, starts, refined)
    yield from (
        _once_more(W, agreeing, before_each) if agreeing else _in_rounds(W, models, before_each)
    )


def _agreeing(W: Floats, starts: list[_Solution], refined: list[_Solution]) -> list[_Solution]:
    """Return the solutions near the median of the starts; none unless most of EM-PPCA are."""
    solutions = starts + refined
    depth = _depths(solutions)
    distance = _distances(depth, np.median(depth[: len(starts)], 0)) / W.std()
    kept = distance < DISAGREEMENT
    if kept[len(starts) :].mean() <= 0.5:
        return []
    return [s for s, good in zip(solutions, kept, strict=True) if good]


def _once_more(
    W: Floats, agreeing: list[_Solution], before_each: Callable[[], None]
) -> Iterator[_Mean]:
    """Yield the mean of agreeing solutions, and that with EM-PPCA that starts from their mean."""
    found = _mean(W, agreeing)
    yield found
    modes = [K for K in _MODES_FROM_MEAN if K < W.shape[1]] or list(MODES[:1])
    models = list(_models(W, _in_one_frame(found), modes, _EM_ITERATIONS, before_each))
    solutions = agreeing + [_solution(W, model) for model in models]
    solutions += [_of_least_norm(W, model.Q, before_each, weighted=True) for model in models]
    yield _mean(W, solutions)._replace(spread=found.spread)


def _in_rounds(
    W: Floats, models: list[LinearModel], before_each: Callable[[], None]
) -> Iterator[_Mean]:
    """Yield means of solutions for cameras of EM-PPCA, which starts from the mean each time.

    Left out: models with as many modes as points or more, which fit any cameras, and models with
    the fewest modes, which fit too little.
    """
    modes = _modes_in_rounds(W)
    several = [model for model in models if len(model.basis) - 1 in modes]
    for K in modes:
        model = fit_from_rigid(W, K, iterations=_EM_ITERATIONS, before_each=before_each)
        several.append(model)
    found = _mean(W, [_of_least_norm(W, model.Q, before_each) for model in several])
    spread = found.spread
    yield found
    for iterations in _ROUNDS:
        models = list(_models(W, _in_one_frame(found), modes, iterations, before_each))
        found = _mean(W, [_of_least_norm(W, model.Q, before_each) for model in models])
        yield found._replace(spread=spread)
    models = list(_models(W, _in_one_frame(found), modes, _LAST_ROUND, before_each))
    exact = [m for m in models if m.variance < _NO_NOISE_AT_LAST * float((W**2).mean())]
    last = exact[:1] or models  # modes grow in number: the first has the fewest
    found = _mean(W, [_of_least_norm(W, model.Q, before_each, weighted=True) for model in last])
    yield found._replace(spread=spread)


def _modes_in_rounds(W: Floats) -> list[int]:
    """Return the numbers of modes of `_in_rounds`."""
    return [K for K in MODES[1:] if K < W.shape[1]] or list(MODES[:1])


class _Mean(NamedTuple):
    """The weighted mean of solutions.

    Attributes:
        seen: (f, p, 3) shapes in camera axes.
        Q: (f, 3, 3) rotations of the solution nearest to the mean.
        spread: see `Consensus`.
        solutions: their number.
    """

    seen: Floats
    Q: Floats
    spread: float
    solutions: int


def _mean(W: Floats, solutions: list[_Solution]) -> _Mean:
    """Return the mean of the solutions; those near it weigh more."""
    depth = _depths(solutions)
    middle = np.median(depth, 0)
    for _ in range(5):
        distance = _distances(depth, middle)
        weight = 1 / (distance + np.median(distance) + 1e-12)
        middle = np.tensordot(weight / weight.sum(), depth, 1)
    spread = float(np.sqrt(((depth - middle) ** 2).mean()) / W.std())
    nearest = solutions[int(distance.argmin())]
    mirrored = _signs(np.stack((middle, _depths([nearest])[0]))).prod() < 0
    Q = _mirrored(nearest.Q) if mirrored else nearest.Q
    return _Mean(np.concatenate((W, middle[..., None]), 2), Q, spread, len(solutions))


def _depths(solutions: list[_Solution]) -> Floats:
    """Return the depths (n, f, p) of the solutions, with signs that agree best."""
    depth: Floats = np.stack([(item.S @ item.Q.swapaxes(1, 2))[..., 2] for item in solutions])
    return depth * _signs(depth)[:, None, None]


def _distances(depth: Floats, middle: Floats) -> Floats:
    """Return the root mean square differences (n,) of depths (n, f, p) from one (f, p)."""
    distance: Floats = np.sqrt(((depth - middle) ** 2).mean((1, 2)))
    return distance


def _in_one_frame(mean: _Mean) -> _Solution:
    """Return the shapes turned to their mean, with the rotations, near those given, that do so."""
    Q = mean.Q
    for _ in range(_ALIGNMENTS):
        middle = (mean.seen @ Q).mean(0)
        Q = align(np.broadcast_to(middle, mean.seen.shape), mean.seen).rotation.swapaxes(1, 2)
    return _Solution(Q, mean.seen @ Q)


def image_scales(W: Floats) -> Floats:
    """Return the scale (f,) of each image W (f, p, 2), median 1; all 1 if they hardly differ."""
    K = min(_SCALE_RANK, min(2 * len(W), W.shape[1]) // 3)
    scales = np.linalg.norm(block_cameras(W, K), axis=(1, 2))
    scales = np.maximum(scales / np.median(scales), _LEAST_SCALE)
    low, high = np.quantile(np.log(scales), (0.25, 0.75))
    same = high - low < _SAME_SCALE
    return np.ones(len(W)) if same else scales


def _best_starts(W: Floats, before_each: Callable[[], None]) -> tuple[list[_Solution], float]:
    """Return the cameras that allow shapes of the lowest nuclear norm, with these shapes.

    And the spread of the two with the lowest ones, which are of different cameras.
    """
    most = min(2 * len(W), W.shape[1]) // 3
    cameras = [rigid_rotations(W)]
    cameras += [block_rotations(W, K) for K in sorted({min(K, most) for K in RANKS})]
    starts, norms = [], []
    for R in cameras:
        starts.append(_of_least_norm(W, rotation_from_camera(R.swapaxes(1, 2)), before_each))
        norms.append(np.linalg.svd(starts[-1].S.reshape(len(W), -1), compute_uv=False).sum())
    order = np.argsort(norms)
    spread = _mean(W, [starts[i] for i in order[:2]]).spread
    return [starts[i] for i in range(len(starts)) if norms[i] <= _SAME_NORM * min(norms)], spread


def _of_least_norm(
    W: Floats, Q: Floats, before_each: Callable[[], None], *, weighted: bool = False
) -> _Solution:
    """Return the shapes of lowest nuclear norm, weighted or not, for rotations Q (f, 3, 3)."""
    S = least_nuclear_norm(W, Q[:, :2], weighted=weighted, before_each=before_each)
    return _meeting(W, Q, S)


def _exact(W: Floats, before_each: Callable[[], None]) -> list[_Solution]:
    """Return the likeliest solution of EM-PPCA with few modes, if it leaves no noise.

    It starts from rigid factorisation: the least nuclear norm is far from few modes. The runs with
    and without annealing end apart.
    """
    models = {}
    for K in _FEW_MODES:
        for annealed in (False, True):
            models[K, annealed] = fit_from_rigid(
                W, K, annealed=annealed, iterations=_EM_ITERATIONS, before_each=before_each
            )
    K, annealed = min(models, key=lambda settings: models[settings].variance)
    if models[K, annealed].variance > _NO_NOISE * float((W**2).mean()):
        return []
    model = fit_from_rigid(
        W, K, annealed=annealed, iterations=_MORE_ITERATIONS, before_each=before_each
    )
    return [_solution(W, model)]


def _models(
    W: Floats,
    start: _Solution,
    modes: Sequence[int],
    iterations: int,
    before_each: Callable[[], None],
) -> Iterator[LinearModel]:
    """Yield the models of EM-PPCA with different numbers of modes."""
    for K in modes:
        yield fit_from_shapes(
            W, start.Q, start.S, K, iterations=iterations, before_each=before_each
        )


def _solution(W: Floats, model: LinearModel) -> _Solution:
    """Return the cameras of EM-PPCA and its shapes, which meet the images."""
    return _meeting(W, model.Q, shapes_of(W, model))


def _meeting(W: Floats, Q: Floats, S: Floats) -> _Solution:
    """Return the shapes moved parallel to the images so that they meet them."""
    return _Solution(Q, centre(back_project(centre(S), Q[:, :2].swapaxes(1, 2), W)))


def _signs(depth: Floats) -> Floats:
    """Return 1 or -1 (n,) for each of n depths (n, f, p), so that they agree best."""
    flat = depth.reshape(len(depth), -1)
    sign: Floats = np.sign(np.linalg.eigh(flat @ flat.T)[1][:, -1])
    agreed: Floats = np.where(sign == 0, 1.0, sign * (sign[0] or 1.0))
    return agreed


def _mirrored(Q: Floats) -> Floats:
    """Return rotations (f, 3, 3) of the mirrored object with the same images.

    diag(1, 1, -1) Q diag(1, 1, -1) takes S diag(1, 1, -1) to the mirrored depth.
    """
    mirror = np.array([1.0, 1.0, -1.0])
    turned: Floats = mirror[:, None] * Q * mirror
    return turned
