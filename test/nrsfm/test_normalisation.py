# SPDX-License-Identifier: Apache-2.0
"""Normalisation: there and back, and blind to what must not matter."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.nrsfm.network import Architecture, complete, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser, normalise

some = settings(max_examples=30, deadline=None)
seeds = st.integers(0, 2**32 - 1)
scales = st.sampled_from(["rms", "none"])


def observed(seed: int, n: int = 5, p: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, p, 2) and a mask (n, p, 1) of at least two visible points."""
    rng = np.random.default_rng(seed)
    mask = (rng.random((n, p, 1)) < 0.6).astype(float)
    mask[:, :2] = 1
    return rng.uniform(-300, 900, (n, p, 2)), mask


@some
@given(seeds, scales)
def test_round_trip(seed: int, scale: str) -> None:
    points, mask = observed(seed)
    normalised = Normaliser(scale).encode(points, mask)
    back = Normaliser.decode(normalised.W, normalised)
    np.testing.assert_allclose(back * mask, points * mask, atol=1e-9)


@some
@given(seeds, st.floats(-1e4, 1e4), st.floats(1e-2, 1e3))
def test_place_and_size_do_not_matter(seed: int, shift: float, factor: float) -> None:
    points, mask = observed(seed)
    for scale in ("rms", "none"):
        W = Normaliser(scale).encode(points, mask).W
        moved = Normaliser(scale).encode(points + [shift, -shift], mask).W
        np.testing.assert_allclose(moved, W, atol=1e-7)
    larger = Normaliser("rms").encode(factor * points, mask)
    np.testing.assert_allclose(larger.W, Normaliser("rms").encode(points, mask).W, atol=1e-6)
    larger = Normaliser("none").encode(factor * points, mask)
    np.testing.assert_allclose(larger.W, factor * Normaliser("none").encode(points, mask).W)


@some
@given(seeds, scales)
def test_a_mask_is_the_same_as_deleting_the_points(seed: int, scale: str) -> None:
    points, mask = observed(seed)
    masked = Normaliser(scale).encode(points, mask)
    for i in range(len(points)):
        seen = mask[i, :, 0] > 0
        alone = Normaliser(scale).encode(points[i : i + 1, seen], np.ones((1, seen.sum(), 1)))
        np.testing.assert_allclose(masked.W[i, seen], alone.W[0], atol=1e-9)
        np.testing.assert_allclose(masked.origin[i], points[i, seen].mean(0, keepdims=True))
        np.testing.assert_allclose(masked.unit[i], alone.unit[0])
        assert (masked.W[i, ~seen] == 0).all()
        assert masked.gain[i].item() == pytest.approx(points.shape[1] / seen.sum())
        assert alone.gain.item() == 1


def test_rms_radius_of_a_full_view_is_half() -> None:
    points, _ = observed(0)
    W = Normaliser("rms").encode(points, np.ones((*points.shape[:2], 1))).W
    np.testing.assert_allclose((W**2).sum(2).mean(1) ** 0.5, 0.5)


@pytest.mark.parametrize("scale", ["rms", "none"])
def test_nothing_visible_is_zero_and_finite(scale: str) -> None:
    points, mask = observed(0)
    mask[1] = 0
    for array in (points, points.astype(np.float32)):
        normalised = Normaliser(scale).encode(array, mask.astype(array.dtype))
        assert (normalised.W[1] == 0).all() and normalised.W[0].any()
        assert all(np.isfinite(values).all() for values in normalised)


@some
@given(seeds, scales)
def test_numpy_and_torch_agree(seed: int, scale: str) -> None:
    points, mask = observed(seed)
    mask[0] = 0
    arrays = Normaliser(scale).encode(points, mask)
    tensors = Normaliser(scale).encode(torch.from_numpy(points), torch.from_numpy(mask))
    for array, tensor in zip(arrays, tensors, strict=True):
        assert array.shape == tensor.shape
        np.testing.assert_allclose(tensor.numpy(), array, atol=1e-12)


@pytest.mark.parametrize("whitening", [0.0, 1.0])
def test_what_the_network_sees_is_completed_first(whitening: float) -> None:
    rng = np.random.default_rng(0)
    net = initialise(Architecture((4,), whitening=whitening), 6, rng)
    A = rng.standard_normal((6, 6))
    L = (np.eye(6) + A @ A.T).astype(np.float32)
    net = dataclasses.replace(net, L=L, L_inverse=np.linalg.inv(L))
    points = rng.standard_normal((5, 6, 2)).astype(np.float32)
    mask = (np.arange(6) != 3)[None, :, None].repeat(5, 0).astype(np.float32)
    seen = normalise(net, Normaliser(), points, mask)
    for found, expected in zip(
        seen, Normaliser().encode(*complete(net, points, mask)), strict=True
    ):
        np.testing.assert_array_equal(found, expected)
    assert (np.abs(seen.W[:, 3]).max() > 0.01) == bool(whitening)
