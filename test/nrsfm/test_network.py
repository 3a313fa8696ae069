# SPDX-License-Identifier: Apache-2.0
"""The network against the paper's equations, written out with Kronecker products and loops."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.nrsfm.network import (
    PAPER_WIDTHS,
    Architecture,
    Network,
    coherence,
    complete,
    decode,
    encode,
    forward,
    initialise,
    reconstruct,
    recover,
    unwhiten,
    weight_shapes,
    whiten,
    whitening,
    whitening_network,
)

I3 = np.eye(3)
EVERY_ARCHITECTURE = [
    Architecture((12, 7, 5), threshold, recovery, camera)
    for threshold, recovery, camera in itertools.product(
        ("relu", "block"), ("learned", "closed_form"), ("orthonormal", "free")
    )
]
some = settings(max_examples=25, deadline=None)
seeds = st.integers(0, 2**32 - 1)
widths = st.lists(st.integers(1, 6), min_size=1, max_size=4).map(tuple)
points = st.integers(3, 7)
whitened = st.sampled_from([0.0, 0.5, 1.0])


def random_network(architecture: Architecture, p: int, seed: int = 0) -> Network:
    """Return a float64 network of which every array, biases and whitening included, is random."""
    rng = np.random.default_rng(seed)
    net = initialise(architecture, p, rng, paper_initialisation=True).map(lambda w: w.astype(float))
    Q, _ = np.linalg.qr(rng.standard_normal((p, p)))
    variance = rng.uniform(0.2, 2, p)
    return dataclasses.replace(net, L=(Q * variance) @ Q.T, L_inverse=(Q / variance) @ Q.T)


def replace_camera(net: Network, camera: str) -> Network:
    """Return `net` with another option for its camera."""
    return dataclasses.replace(
        net, architecture=dataclasses.replace(net.architecture, camera=camera)
    )


def tall(net: Network) -> np.ndarray:
    """Return D_1 (3p, k_1)."""
    D = np.empty((3 * net.p, net.D[0].shape[2]))
    for i, r, j in np.ndindex(net.D[0].shape):
        D[3 * i + r, j] = net.D[0][i, r, j]
    return D


def wide(net: Network) -> np.ndarray:
    """Return D_1# (p, 3k_1)."""
    D = np.empty((net.p, 3 * net.D[0].shape[2]))
    for i, r, j in np.ndindex(net.D[0].shape):
        D[i, 3 * j + r] = net.D[0][i, r, j]
    return D


def stacked(Psi: np.ndarray) -> np.ndarray:
    """Return the paper's (3k, 2) form of a stored block code (2, 3, k)."""
    k = Psi.shape[2]
    rows = np.empty((3 * k, 2))
    for c, r, j in np.ndindex(Psi.shape):
        rows[3 * j + r, c] = Psi[c, r, j]
    return rows


def stored(rows: np.ndarray) -> np.ndarray:
    """Return a block code (2, 3, k) of the paper's form (3k, 2)."""
    return rows.reshape(-1, 3, 2).transpose(2, 1, 0)


def relu_threshold(V: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.maximum(V - np.kron(b[:, None], np.ones((3, 2))), 0)


def block_threshold(V: np.ndarray, b: np.ndarray) -> np.ndarray:
    result = np.zeros_like(V)
    for j, threshold in enumerate(b):
        block = V[3 * j : 3 * j + 3]
        norm = np.linalg.norm(block)
        result[3 * j : 3 * j + 3] = max(norm - threshold, 0) / norm * block
    return result


@some
@given(widths, points, seeds, st.sampled_from(["relu", "block"]), whitened)
def test_every_encoder_layer_is_the_papers(
    widths: tuple[int, ...], p: int, seed: int, threshold: str, whitening: float
) -> None:
    net = random_network(Architecture(widths, threshold, whitening=whitening), p, seed)
    W = np.random.default_rng(seed + 1).standard_normal((p, 2))
    h = {"relu": relu_threshold, "block": block_threshold}[threshold]
    Psi = h(wide(net).T @ (net.L @ W if whitening else W), net.b[0])
    for layers in range(1, len(widths) + 1):
        if layers > 1:
            if np.linalg.norm(Psi) < 1e-6:
                return  # all is silent from here on: 0 / 0 in the explicit form
            Psi = h(np.kron(net.D[layers - 1], I3).T @ Psi, net.b[layers - 1])
        # The norm of a block is smoothed by 1e-6, so that it has a gradient at zero.
        atol = 1e-5 if threshold == "block" else 1e-9
        np.testing.assert_allclose(stacked(encode(net, W)[layers - 1]), Psi, atol=atol)


@some
@given(widths, points, seeds, whitened)
def test_every_decoder_layer_is_the_papers(
    widths: tuple[int, ...], p: int, seed: int, whitening: float
) -> None:
    net = random_network(Architecture(widths, whitening=whitening), p, seed)
    psi = np.random.default_rng(seed + 1).uniform(-1, 1, widths[-1])
    expected = psi
    for i in range(len(widths) - 1, 0, -1):
        expected = np.maximum(net.D[i] @ expected - net.b_[i], 0)
    s = tall(net) @ expected - net.b_[0].ravel()
    S = np.linalg.inv(net.L) @ s.reshape(p, 3) if whitening else s.reshape(p, 3)
    np.testing.assert_allclose(decode(net, psi)[0], S, atol=1e-9)


@some
@given(st.integers(1, 6), points, seeds)
def test_both_forms_of_the_first_dictionary_are_one(k: int, p: int, seed: int) -> None:
    net = random_network(Architecture((k,), whitening=0.0), p, seed)
    psi = np.random.default_rng(seed + 1).standard_normal(k)
    S = wide(net) @ np.kron(psi[:, None], I3)
    np.testing.assert_allclose(decode(net, psi)[0] + net.b_[0], S, atol=1e-9)
    np.testing.assert_allclose((tall(net) @ psi).reshape(p, 3), S, atol=1e-9)


def test_a_batch_is_its_frames() -> None:
    for architecture in EVERY_ARCHITECTURE:
        net = random_network(architecture, 6)
        W = np.random.default_rng(1).standard_normal((4, 3, 6, 2))
        S, M = forward(net, W)
        assert S.shape == (4, 3, 6, 3) and M.shape == (4, 3, 3, 2)
        for place in np.ndindex(4, 3):
            one_S, one_M = forward(net, W[place])
            np.testing.assert_allclose(S[place], one_S, atol=1e-9)
            np.testing.assert_allclose(M[place], one_M, atol=1e-9)


@some
@given(st.integers(1, 8), seeds, st.sampled_from(["orthonormal", "free"]))
def test_closed_form_recovers_what_a_rank_one_code_is_made_of(
    k: int, seed: int, camera: str
) -> None:
    rng = np.random.default_rng(seed)
    psi, M = rng.uniform(0, 1, k), np.linalg.qr(rng.standard_normal((3, 2)))[0]
    psi[rng.random(k) < 0.3] = 0
    psi[0] += 0.1
    net = random_network(Architecture((k,), recovery="closed_form", camera=camera), 4)
    found_psi, found_M = recover(net, stored(np.kron(psi[:, None], M)))
    np.testing.assert_allclose(found_psi, psi, atol=1e-6)
    np.testing.assert_allclose(found_M, M, atol=1e-6)


@pytest.mark.parametrize("camera", ["orthonormal", "free"])
def test_learned_recovery_is_two_linear_maps(camera: str) -> None:
    k = 5
    net = random_network(Architecture((k,), camera=camera), 4)
    Psi = np.random.default_rng(1).uniform(0, 1, (2, 3, k))
    psi, M = np.zeros(k), np.zeros((3, 2))
    for c, r, j in np.ndindex(Psi.shape):
        psi += Psi[c, r, j] * net.code_head[(3 * c + r) * k + j]
        M[r, c] += Psi[c, r, j] * net.camera_head[j, 0]
    if camera == "orthonormal":
        U, _, Vt = np.linalg.svd(M, full_matrices=False)
        M = U @ Vt
    found_psi, found_M = recover(net, Psi)
    np.testing.assert_allclose(found_psi, psi, atol=1e-9)
    np.testing.assert_allclose(found_M, M, atol=1e-6)


@pytest.mark.parametrize("architecture", EVERY_ARCHITECTURE, ids=str)
def test_torch_and_numpy_agree(architecture: Architecture) -> None:
    net = initialise(architecture, 17, np.random.default_rng(0))
    W = np.random.default_rng(1).standard_normal((100, 17, 2)).astype(np.float32) / 2
    S, M = forward(net, W)
    torch_S, torch_M = forward(net.map(torch.from_numpy), torch.from_numpy(W))
    assert S.dtype == M.dtype == np.float32 and torch_S.dtype == torch_M.dtype == torch.float32
    assert np.abs(S).max() > 0.01
    np.testing.assert_allclose(torch_S.numpy(), S, atol=1e-5)
    # Where the rows of the raw camera are nearly parallel, its polar factor magnifies rounding.
    _, raw = recover(replace_camera(net, "free"), encode(net, W)[-1])
    sound = np.linalg.cond(raw) < 10
    assert sound.mean() > 0.5
    np.testing.assert_allclose(torch_M.numpy()[sound], M[sound], atol=1e-5)

    double = net.map(lambda w: w.astype(float))
    S, M = forward(double, W.astype(float))
    torch_S, torch_M = forward(double.map(torch.from_numpy), torch.from_numpy(W.astype(float)))
    np.testing.assert_allclose(torch_S.numpy(), S, atol=1e-9)
    np.testing.assert_allclose(torch_M.numpy(), M, atol=1e-9)


def test_the_net_of_the_paper_gives_an_orthonormal_camera_from_the_start() -> None:
    for paper_initialisation in (True, False):  # without them the raw camera is of size 0.01
        rng = np.random.default_rng(1)
        net = initialise(
            Architecture(PAPER_WIDTHS), 31, rng, paper_initialisation=paper_initialisation
        )
        W = 0.3 * rng.standard_normal((500, 31, 2)).astype(np.float32)
        _, M = forward(net, W)
        np.testing.assert_allclose(M.swapaxes(1, 2) @ M, np.tile(np.eye(2), (500, 1, 1)), atol=1e-3)


def turned_in_plane(architecture: Architecture, seed: int) -> tuple[float, float]:
    """Return how far shape and camera are from (S, M Q) when the image W becomes W Q."""
    rng = np.random.default_rng(seed)
    net = initialise(architecture, 7, rng).map(lambda w: w.astype(float))
    W, Q = rng.standard_normal((7, 2)), np.linalg.qr(rng.standard_normal((2, 2)))[0]
    (S, M), (turned_S, turned_M) = forward(net, W), forward(net, W @ Q)
    assume(np.linalg.norm(S) > 1e-3)  # random weights may silence the last layer
    shape_change = np.linalg.norm(turned_S - S) / np.linalg.norm(S)
    return float(shape_change), float(np.linalg.norm(turned_M - M @ Q))


@some
@given(seeds)
def test_exact_threshold_and_closed_form_follow_a_turn_of_the_image(seed: int) -> None:
    shape, camera = turned_in_plane(Architecture((9, 6), "block", "closed_form"), seed)
    assert shape < 1e-6 and camera < 1e-4


def test_the_relaxations_do_not_follow_a_turn_of_the_image() -> None:
    assert turned_in_plane(Architecture((9, 6), "relu", "closed_form"), 0)[0] > 0.01
    assert turned_in_plane(Architecture((9, 6), "block", "learned"), 0)[0] > 0.01


@some
@given(widths, points, seeds)
def test_coherence_is_the_largest_cosine_of_two_atoms(
    widths: tuple[int, ...], p: int, seed: int
) -> None:
    net = random_network(Architecture(widths), p, seed)
    net.D[-1][..., 0] *= seed % 3  # now and then an atom of norm zero
    atoms = net.D[-1].reshape(-1, widths[-1]).T
    largest = 0.0
    for i, j in itertools.combinations(range(len(atoms)), 2):
        norms = np.linalg.norm(atoms[i]) * np.linalg.norm(atoms[j])
        largest = max(largest, abs(atoms[i] @ atoms[j]) / norms if norms else 0)
    assert coherence(net) == pytest.approx(largest, abs=1e-9)


@some
@given(widths, points, st.booleans())
def test_initialise_makes_every_weight(
    widths: tuple[int, ...], p: int, paper_initialisation: bool
) -> None:
    architecture = Architecture(widths)
    rng = np.random.default_rng(0)
    weights = dict(
        initialise(architecture, p, rng, paper_initialisation=paper_initialisation).named_weights()
    )
    assert {name: w.shape for name, w in weights.items()} == weight_shapes(architecture, p)
    for name, weight in weights.items():
        assert weight.dtype == np.float32
        if name.startswith("L"):  # not whitened yet
            np.testing.assert_array_equal(weight, np.eye(p))
            continue
        assert np.any(weight) != (name.startswith("b") and not paper_initialisation)
    again = initialise(
        architecture, p, np.random.default_rng(0), paper_initialisation=paper_initialisation
    )
    assert all(np.array_equal(w, weights[name]) for name, w in again.named_weights())


@pytest.mark.parametrize(
    ("paper_initialisation", "fans"),
    [
        (False, {"D.0": 90 + 50, "D.1": 50 + 40, "code_head": 240 + 40}),
        (True, {"D.0": 3 * (30 + 50), "D.1": 50 + 40, "code_head": 6 * (40 + 40), "b.0": 100}),
    ],
    ids=["matrices", "convolutions"],
)
def test_glorot_takes_the_fans_of_what_a_weight_is_applied_as(
    paper_initialisation: bool, fans: dict[str, int]
) -> None:
    rng = np.random.default_rng(0)
    weights = dict(
        initialise(
            Architecture((50, 40)), 30, rng, paper_initialisation=paper_initialisation
        ).named_weights()
    )
    for name, fan in fans.items():
        limit = (6 / fan) ** 0.5
        assert 0.9 * limit < np.abs(weights[name]).max() <= limit
        assert np.std(weights[name]) == pytest.approx(limit / 3**0.5, rel=0.1)


def test_a_network_survives_its_names() -> None:
    net = random_network(Architecture((4, 3)), 5)
    again = Network.from_named_weights(net.architecture, dict(net.named_weights()))
    assert all(
        a is b for (_, a), (_, b) in zip(net.named_weights(), again.named_weights(), strict=True)
    )
    weights = dict(net.named_weights())
    del weights["b_.1"]
    with pytest.raises(KeyError, match=r"b_\.1"):
        Network.from_named_weights(net.architecture, weights)


def test_a_network_has_a_dictionary() -> None:
    with pytest.raises(ValueError, match="widths is empty"):
        Architecture(widths=())


def moment_of(seed: int, p: int) -> np.ndarray:
    A = np.random.default_rng(seed).standard_normal((p, 3 * p))
    return A @ A.T * np.outer(*[np.geomspace(1, 10, p)] * 2)


@some
@given(seeds, points)
def test_whitening_makes_all_directions_vary_alike(seed: int, p: int) -> None:
    moment = moment_of(seed, p)
    L, L_inverse = (array.astype(float) for array in whitening(moment, 1.0, 1e-8))
    np.testing.assert_allclose(L @ L_inverse, np.eye(p), atol=1e-3)
    size = np.trace(moment)
    np.testing.assert_allclose(L @ moment @ L.T / size, np.eye(p) / p, atol=1e-3)


@some
@given(seeds, points, st.floats(0, 1), st.floats(1e-6, 1))
def test_whitening_keeps_the_size_and_goes_part_of_the_way(
    seed: int, p: int, exponent: float, floor: float
) -> None:
    moment = moment_of(seed, p)
    L, L_inverse = whitening(moment, exponent, floor)
    np.testing.assert_allclose(L @ L_inverse, np.eye(p), atol=1e-2)
    assert np.trace(L @ moment @ L.T) == pytest.approx(np.trace(moment), rel=1e-4)
    largest, smallest = np.linalg.eigvalsh(moment)[[-1, 0]]
    ratio = largest / max(smallest, floor * largest)
    assert np.linalg.cond(L) == pytest.approx(ratio ** (exponent / 2), rel=1e-3)


def test_no_whitening_is_none() -> None:
    np.testing.assert_allclose(whitening(moment_of(0, 5), 0.0, 1e-4)[0], np.eye(5), atol=1e-6)


def test_whitening_of_centred_points_is_finite() -> None:
    W = np.random.default_rng(0).standard_normal((100, 6, 2))
    W -= W.mean(1, keepdims=True)
    L, L_inverse = whitening(np.einsum("fic,fjc->ij", W, W) / 100, 1.0, 1e-4)
    assert np.isfinite(L).all() and np.isfinite(L_inverse).all()
    np.testing.assert_allclose(L @ L_inverse, np.eye(6), atol=1e-3)


def test_a_network_of_the_whitening_alone_whitens_and_fills_in() -> None:
    p = 6
    moment = moment_of(0, p)
    net = whitening_network(moment)
    np.testing.assert_array_equal(net.L, whitening(moment, 1.0, 1e-3)[0])
    points = np.random.default_rng(0).standard_normal((2, p, 2)).astype(np.float32)
    np.testing.assert_allclose(unwhiten(net, whiten(net, points)), points, atol=1e-4)
    mask = np.ones((2, p, 1), np.float32)
    mask[0, 1] = 0
    filled, complete_mask = complete(net, points * mask, mask)
    assert complete_mask.all() and filled[0, 1].any()


def test_training_learns_everything_but_the_whitening() -> None:
    net = random_network(Architecture((4, 3)), 5)
    assert {n for n, _ in net.named_weights()} - {n for n, _ in net.trainable_weights()} == {
        "L",
        "L_inverse",
    }


@some
@given(points, seeds, st.sampled_from([1, 2]))
def test_missing_points_go_where_the_whitened_norm_is_least(p: int, seed: int, d: int) -> None:
    net = random_network(Architecture((4,), whitening=1.0), p, seed)
    rng = np.random.default_rng(seed)
    points, mask = rng.standard_normal((3, p, d)) + 5, (rng.random((3, p, 1)) < 0.6) * 1.0
    mask[0], mask[1] = 1, np.arange(p)[:, None] == 0
    filled, whole = complete(net, points, mask)
    assert (whole == 1).all()
    np.testing.assert_allclose(filled[0], points[0], atol=1e-6)
    for X, W, m in zip(filled, points, mask[..., 0] > 0, strict=True):
        np.testing.assert_allclose(X[m], W[m], atol=1e-6)
        if not m.any():
            continue
        # Over the missing points and the translation, which the columns of B move.
        B = np.c_[np.eye(p)[:, ~m], np.ones(p)]
        visible = np.where(m[:, None], W, 0)
        least = visible - B @ np.linalg.lstsq(net.L @ B, net.L @ visible, rcond=None)[0]
        np.testing.assert_allclose(X - X[m][0], least - least[m][0], atol=1e-2)
    tensors = net.map(torch.from_numpy)
    again, _ = complete(tensors, torch.from_numpy(points), torch.from_numpy(mask))
    np.testing.assert_allclose(again, filled, atol=1e-8)


def test_without_whitening_missing_points_stay_as_they_are() -> None:
    net = random_network(Architecture((4,), whitening=0.0), 5)
    points, mask = np.ones((2, 5, 2)), np.tile([[1.0], [0], [1], [1], [0]], (2, 1, 1))
    assert complete(net, points, mask)[0] is points and complete(net, points, mask)[1] is mask


def test_a_free_camera_gives_its_size_to_the_shape() -> None:
    net = random_network(Architecture((8, 5), camera="free"), 6)
    W = np.random.default_rng(0).standard_normal((4, 6, 2))
    (S, M), (shape, camera) = forward(net, W), reconstruct(net, W)
    np.testing.assert_allclose(
        camera.swapaxes(1, 2) @ camera, np.tile(np.eye(2), (4, 1, 1)), atol=1e-9
    )
    size = np.linalg.norm(M, axis=(1, 2)) / 2**0.5
    np.testing.assert_allclose(shape, S * size[:, None, None])
