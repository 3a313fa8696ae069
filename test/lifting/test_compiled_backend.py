# SPDX-License-Identifier: Apache-2.0
"""The compiled kernel against the same sums in NumPy."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.kernel import AVAILABLE, _kernel
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.compiled_backend import CompiledBackend
from deep_nrsfm_ros.lifting.history import Context, StateLayout
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.numpy_backend import NumpyBackend
from deep_nrsfm_ros.lifting.options import HistoryOptions, LiftingOptions
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser

pytestmark = [
    pytest.mark.skipif(
        not AVAILABLE and not shutil.which("cc") and not shutil.which("gcc"), reason="no C compiler"
    ),
    pytest.mark.usefixtures("vectors"),
]
NUMBERED = KeypointLayout("five", tuple("abcde"))
MORE_THAN_A_BLOCK = 7  # objects, of those that the kernel takes together, at four or five turns
ONE_LINE = np.outer(np.arange(17), [3, 4]).astype(np.float32)


def model(
    seed: int, layout: KeypointLayout, widths: tuple[int, ...], whitening: float, scale: str
) -> Model:
    """Return a model of random weights, those of the biases included."""
    rng, p = np.random.default_rng(seed), len(layout)
    network = initialise(
        Architecture(widths, whitening=whitening), p, rng, paper_initialisation=True
    )
    A = np.eye(p) + 0.1 * rng.standard_normal((p, p))
    L = (A @ A.T).astype(np.float32)
    network = dataclasses.replace(network, L=L, L_inverse=np.linalg.inv(L))
    frame = np.linalg.qr(rng.standard_normal((3, 3)))[0].astype(np.float32)
    B = rng.standard_normal((3 * p, 3 * p))
    covariance = (0.01 * np.eye(3 * p) + 0.003 * B @ B.T / p).astype(np.float32)
    b = len(layout.bone_indices())
    lengths, spread = rng.uniform(0.01, 0.2, (2, b))
    together = np.c_[np.eye(b), rng.standard_normal((b, 3))]
    together /= np.linalg.norm(together, axis=1, keepdims=True)
    return Model(
        "random",
        network,
        layout,
        Normaliser(scale),
        frame,
        error_covariance=covariance,
        bone_lengths=np.stack((lengths, spread), 1).astype(np.float32),
        bone_correlation=(together @ together.T).astype(np.float32),
    )


def objects(
    rng: np.random.Generator, n: int, p: int, missing: float, perspective: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return points (n, p, 2) and confidence (n, p) of random objects with a share of gaps."""
    points = rng.standard_normal((n, p, 2)).astype(np.float32) * (0.2 if perspective else 1)
    confidence = rng.uniform(0.2, 1.2, (n, p)).astype(np.float32)
    confidence[rng.random((n, p)) < missing] = 0
    return points, confidence


PERTURBATIONS = 3  # draws; one alone may by chance change less than rounding does


def difference(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Return the largest difference of numbers, or of truth values."""
    return float(np.abs(np.subtract(a, b, dtype=np.float64)).max())


def in_last_digits(
    backend: NumpyBackend,
    points: NDArray[np.float32],
    confidence: NDArray[np.float32],
    perspective: bool,
    context: Context | None = None,
) -> list[tuple[Sequence[NDArray[Any]], NDArray[Any]]]:
    """Return what a backend finds for points that differ in their last digits, and its states."""
    rng = np.random.default_rng(0)
    found: list[tuple[Sequence[NDArray[Any]], NDArray[Any]]] = []
    for _ in range(PERTURBATIONS):
        near = points + 1e-6 * rng.standard_normal(points.shape).astype(np.float32)
        again = context and context._replace(states=context.states.copy())
        arrays, _ = backend(near, confidence, perspective, again)
        found.append((arrays, again.states if again else np.empty(0)))
    return found


# The vectors are the same for all examples of a test.
each_vectors = [HealthCheck.function_scoped_fixture]


@settings(max_examples=60, deadline=None, suppress_health_check=each_vectors)
@given(
    seed=st.integers(0, 2**32 - 1),
    layout=st.sampled_from([HUMAN17, NUMBERED]),
    widths=st.lists(st.integers(12, 40), min_size=1, max_size=4).map(tuple),
    whitening=st.sampled_from([0.0, 1.0]),
    scale=st.sampled_from(["rms", "none"]),
    options=st.builds(
        LiftingOptions,
        correction=st.sampled_from(["bones", "learned", "back_projection", "none"]),
        noise=st.sampled_from([0.01, 0.1]),
        refill=st.integers(0, 3),
        test_time_rotations=st.integers(1, 5),
        test_time_mirror=st.booleans(),
        min_visible=st.integers(3, 5),
        leave_out_wrong=st.booleans(),
        reference_length=st.sampled_from([0.0, 2.0]),
    ),
    missing=st.sampled_from([0.0, 0.3, 0.7, 1.0]),
    perspective=st.booleans(),
)
def test_lifts_as_numpy_does(
    seed: int,
    layout: KeypointLayout,
    widths: tuple[int, ...],
    whitening: float,
    scale: str,
    options: LiftingOptions,
    missing: float,
    perspective: bool,
) -> None:
    lifter = Lifter(model(seed, layout, widths, whitening, scale), options)
    rng, p = np.random.default_rng(seed), len(layout)
    points, confidence = objects(rng, MORE_THAN_A_BLOCK, p, missing, perspective)
    assert isinstance(lifter.backend, CompiledBackend)
    arrays, lost = lifter.backend(points, confidence, perspective)
    by_numpy = NumpyBackend(lifter.constants)
    expected, lost_too = by_numpy(points, confidence, perspective)
    np.testing.assert_array_equal(lost, lost_too)

    nearby = cache(partial(in_last_digits, by_numpy, points, confidence, perspective))
    for field, (ours, numpy) in enumerate(zip(arrays, expected, strict=True)):
        for i in np.flatnonzero(~lost):
            error, close = difference(ours[i], numpy[i]), 1e-4 * np.abs(numpy[i]).max() + 1e-6
            if not error <= close:  # where these digits matter, no more can be asked
                unsure = max(difference(near[field][i], numpy[i]) for near, _ in nearby())
                assert error <= close + 10 * unsure


@settings(max_examples=20, deadline=None, suppress_health_check=each_vectors)
@given(
    seed=st.integers(0, 2**32 - 1),
    layout=st.sampled_from([HUMAN17, NUMBERED]),
    options=st.builds(
        LiftingOptions,
        correction=st.sampled_from(["bones", "bones", "learned", "none"]),
        refill=st.integers(0, 2),
        test_time_rotations=st.integers(1, 3),
    ),
    remembers=st.sampled_from([HistoryOptions(), HistoryOptions(shape_time=0, bones_time=0)]),
    missing=st.sampled_from([0.0, 0.3]),
    perspective=st.booleans(),
    gravity=st.booleans(),
)
def test_remembers_as_numpy_does(
    seed: int,
    layout: KeypointLayout,
    options: LiftingOptions,
    remembers: HistoryOptions,
    missing: float,
    perspective: bool,
    gravity: bool,
) -> None:
    made = model(seed, layout, (30, 20, 12), 1.0, "rms")
    if len(made.bone_lengths):
        # As real ones are: lengths within a tenth of the mean.
        lengths = made.bone_lengths.mean() * np.ones_like(made.bone_lengths) * [1, 0.1]
        made = dataclasses.replace(made, bone_lengths=lengths.astype(np.float32))
    lifter = Lifter(made, options, history=remembers)
    by_numpy = NumpyBackend(lifter.constants)
    rng, p, n = np.random.default_rng(seed), len(layout), MORE_THAN_A_BLOCK
    own = StateLayout(p, len(layout.bone_indices()) if options.correction == "bones" else 0)
    state = np.full((n + 2, own.size), np.nan)
    points, confidence = objects(rng, n, p, 0.0, perspective)
    views = Rotation.random(n, random_state=seed).as_matrix()
    up = np.array([0.0, -0.6, 0.8]) if gravity else None
    time = 0.0
    for step in (0.0, 0.04, 0.04, 0.2, -0.1, 0.0, 0.3, 0.7, 0.04, -5.0, 0.04):
        time += step
        points = points + 0.02 * rng.standard_normal(points.shape).astype(np.float32)
        shown = confidence * (rng.random((n, p)) >= missing)
        rows = rng.permutation(n + 2)[:n].astype(np.int32) - 1
        context = Context(state.copy(), rows, time, up, views if perspective else None)
        arrays, lost = lifter.backend(points, shown, perspective, context)
        before = context._replace(states=state.copy())
        expected, _ = by_numpy(points, shown, perspective, context._replace(states=state))

        nearby = cache(partial(in_last_digits, by_numpy, points, shown, perspective, before))
        for field, (ours, numpy) in enumerate(zip(arrays, expected, strict=True)):
            close = 1e-3 * np.abs(numpy[~lost]).max(initial=0) + 1e-6
            for i in np.flatnonzero(~lost):
                error = difference(ours[i], numpy[i])
                if not error <= close:
                    unsure = max(difference(near[field][i], numpy[i]) for near, _ in nearby())
                    assert error <= close + 10 * unsure
        np.testing.assert_array_equal(np.isnan(context.states), np.isnan(state))
        known = ~np.isnan(state)
        error = np.abs(context.states - state)[known].max(initial=0)
        if not error <= 2e-3:
            unsure = max(np.abs(near - state)[known].max() for _, near in nearby())
            assert error <= 2e-3 + 10 * unsure


@settings(max_examples=30, deadline=None, suppress_health_check=each_vectors)
@given(
    seed=st.integers(0, 2**32 - 1),
    layout=st.sampled_from([HUMAN17, NUMBERED]),
    n=st.integers(2, 30),
    first=st.sampled_from([0.0, np.nan, np.inf]),
    options=st.builds(
        LiftingOptions,
        refill=st.integers(0, 2),
        test_time_rotations=st.integers(1, 5),
        test_time_mirror=st.booleans(),
    ),
    perspective=st.booleans(),
)
def test_an_object_comes_out_the_same_in_any_company(
    seed: int,
    layout: KeypointLayout,
    n: int,
    first: float,
    options: LiftingOptions,
    perspective: bool,
) -> None:
    lifter = Lifter(model(seed, layout, (30, 20, 12), 1.0, "rms"), options)
    rng = np.random.default_rng(seed)
    points, confidence = objects(rng, n, len(layout), 0.2, perspective)
    confidence[rng.random(n) < 0.5] = 1  # some without gaps
    points[0, 0] = first
    together = lifter.lift(points, confidence, perspective=perspective)
    for i in range(n):
        alone = lifter.lift(points[i : i + 1], confidence[i : i + 1], perspective=perspective)
        for ours, theirs in zip(alone, together, strict=True):
            np.testing.assert_array_equal(ours[0], theirs[i])


@pytest.mark.parametrize("shown", [0, 1, 2])
def test_what_cannot_be_lifted_is_nan(shown: int) -> None:
    lifter = Lifter(model(0, HUMAN17, (12, 6), 1.0, "rms"))
    points = np.stack([ONE_LINE, 50 * np.random.default_rng(0).standard_normal((17, 2))])
    confidence = np.ones((2, 17), np.float32)
    whole = lifter(points[1:].astype(np.float32), confidence[1:])
    confidence[0, shown:] = 0 if shown else 1  # nothing hidden: all on one line
    lifted = lifter(points.astype(np.float32), confidence)
    for both, alone in zip(lifted, whole, strict=True):
        np.testing.assert_array_equal(both[1], alone[0])
    assert np.isnan(lifted.shapes[0]).all() and not lifted.confidence[0].any()


@pytest.mark.parametrize(
    "options", [("block",), ("relu", "closed_form"), ("relu", "learned", "free")]
)
def test_other_options_of_the_network_are_left_to_numpy(options: tuple[Any, ...]) -> None:
    network = initialise(Architecture((12, 6), *options), 17, np.random.default_rng(0))
    random = dataclasses.replace(model(0, HUMAN17, (12, 6), 0.0, "rms"), network=network)
    assert isinstance(Lifter(random).backend, NumpyBackend)


def test_arrays_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="not those of a plan"):
        _kernel.plan(np.zeros(40, np.int32), np.zeros(9, np.float32), np.zeros(9))
    with pytest.raises(TypeError, match="header must be a C-contiguous array of int32"):
        _kernel.plan(b"", b"", b"")
    kernel = CompiledBackend(Lifter(model(0, HUMAN17, (12, 6), 1.0, "rms")).constants)
    with pytest.raises(ValueError, match="do not fit"):
        kernel(np.zeros((2, 16, 2), np.float32), np.ones((2, 17), np.float32), False)
