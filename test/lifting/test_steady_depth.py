# SPDX-License-Identifier: Apache-2.0
"""Depths over time: steady, on their rays, alike in C and in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.lifting.history import Memory, StateLayout
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.steady_depth import steady_depths
from deep_nrsfm_ros.nrsfm.geometry import align, centre

P = 8
needs_kernel = pytest.mark.skipif(not kernel.AVAILABLE, reason="there is no compiled kernel")


def objects(shapes: np.ndarray, rotations: np.ndarray | None = None) -> Lifted:
    """Return lifted objects of shapes (n, p, 3)."""
    n = len(shapes)
    if rotations is None:
        rotations = np.broadcast_to(np.eye(3), (n, 3, 3))
    ones = np.ones(n, np.float32)
    return Lifted(
        np.asarray(shapes, np.float32),
        np.array(rotations, np.float32),
        ones,
        np.zeros((n, 2), np.float32),
        ones,
        np.ones(shapes.shape[:2], np.float32),
        np.zeros(shapes.shape[:2], np.bool_),
    )


def walk(
    frames: np.ndarray, seconds: np.ndarray, cutoff: float = 0.5, names: tuple[str, ...] = ("a",)
) -> np.ndarray:
    """Return the steady shapes (f, n, p, 3) of frames (f, n, p, 3)."""
    memory = Memory(StateLayout(frames.shape[2], 0), cutoff)
    return np.array(
        [
            steady_depths(objects(S), memory, memory(names, float(second))).shapes
            for S, second in zip(frames, seconds, strict=True)
        ]
    )


def still(f: int = 60, distance: float = 4.0, noise: float = 0.05) -> tuple[np.ndarray, ...]:
    """Return a shape whose depths tremble, its frames (f, 1, p, 3) and their seconds."""
    rng = np.random.default_rng(0)
    S = rng.standard_normal((P, 3)) * 0.4 + [0, 0, distance]
    ratio = 1 + noise * rng.standard_normal((f, P, 1)) / max(distance, 1)
    frames = S * ratio if distance else S + np.array([0, 0, noise]) * rng.standard_normal((f, P, 1))
    return S, frames[:, None], np.arange(f) / 30


@pytest.mark.parametrize("distance", [4.0, 0.0])
def test_depths_are_steady_and_the_image_is_as_it_was(distance: float) -> None:
    S, frames, seconds = still(distance=distance)
    steady = walk(frames, seconds)
    change = np.abs(np.diff(steady[30:, 0, :, 2], axis=0)).mean()
    assert change < 0.5 * np.abs(np.diff(frames[30:, 0, :, 2], axis=0)).mean()
    for found, given_ in ((steady, frames), (frames, frames)):
        by = found[..., 2:] if distance else 1
        expected = given_[..., :2] / given_[..., 2:] if distance else given_[..., :2]
        np.testing.assert_allclose(found[..., :2] / by, expected, atol=1e-5)
    assert np.abs(steady[-1, 0] - S).max() < np.abs(frames[:, 0] - S).max()


def test_a_moving_object_is_followed() -> None:
    S, _, seconds = still()
    path = np.array([0, 0, 1.0]) * np.sin(2 * seconds)[:, None, None, None]
    frames = S + path
    assert np.abs(walk(frames, seconds) - frames)[5:].max() < 0.1
    slow = walk(frames, seconds, cutoff=0.2)
    np.testing.assert_array_equal(walk(frames, seconds, cutoff=0.0), frames.astype(np.float32))
    assert np.abs(slow - frames).max() > 0


def test_the_rotation_follows_the_points() -> None:
    rng = np.random.default_rng(1)
    S = rng.standard_normal((P, 3))
    memory = Memory(StateLayout(P, 0), 0.2)
    steady_depths(objects(S[None]), memory, memory(("a",), 0.0))
    angle = 0.1
    Q = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    found = steady_depths(objects((S @ Q.T)[None], Q[None]), memory, memory(("a",), 1 / 30))
    expected = align(centre(S[None]), centre(found.shapes.astype(float))).rotation[0]
    R = found.rotations[0].astype(float)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)
    assert np.linalg.norm(R - expected) < np.linalg.norm(Q - expected)


def test_who_was_away_or_is_new_begins_anew() -> None:
    S, frames, _ = still(4)
    memory = Memory(StateLayout(P, 0), 0.2)
    for frame, second, begins in zip(frames, (0.0, 5.0, 1.0, 1.0), (True,) * 4, strict=True):
        found = steady_depths(objects(frame), memory, memory(("a",), second))
        assert (found.shapes == frame.astype(np.float32)).all() == begins
    nobody = np.full((1, P, 3), np.nan)
    assert np.isnan(steady_depths(objects(nobody), memory, memory(("a",), 1.1)).shapes).all()
    unknown = steady_depths(objects(S[None]), memory, memory(("",), 1.2))
    np.testing.assert_array_equal(unknown.shapes, S[None].astype(np.float32))


@needs_kernel
@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_kernel_does_as_numpy_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, f = int(rng.integers(1, 4)), 12
    names = tuple("abc"[:n])
    frames = rng.standard_normal((f, n, P, 3)) * 0.3 + [0, 0, rng.choice([0.0, 0.5, 4.0])]
    frames = np.cumsum(frames * 0.1, 0) + frames[:1]
    frames[rng.random((f, n)) < 0.1] = np.nan
    seconds = np.cumsum(rng.choice([0.0, 0.03, 0.1, 0.7, -0.2, -3.0], f))
    compiled, plain = (Memory(StateLayout(P, 0), 0.3) for _ in range(2))
    for S, second in zip(frames, seconds, strict=True):
        rotations = np.linalg.qr(rng.standard_normal((n, 3, 3)))[0]
        lifted = objects(S, rotations)
        by_kernel = steady_depths(lifted, compiled, compiled(names, float(second)))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(kernel, "AVAILABLE", False)
            by_numpy = steady_depths(lifted, plain, plain(names, float(second)))
        np.testing.assert_allclose(by_kernel.shapes, by_numpy.shapes, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(by_kernel.rotations, by_numpy.rotations, atol=1e-4)
        np.testing.assert_allclose(compiled.depth_states, plain.depth_states, rtol=1e-4, atol=1e-5)
