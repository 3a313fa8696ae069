# SPDX-License-Identifier: Apache-2.0
"""The network: section 3 of the paper, from the block codes to the shape and the camera.

Read from the top: `forward` = `encode` (2D keypoints to block codes), `recover` (block code to code
and camera), `decode` (code to shape). What is ours, the whitening of the keypoints, follows.

The package's docstring is the legend of the symbols. Every function uses only operations that NumPy
and torch share: the trainer calls it with tensors, the lifter with arrays. Shapes on the lines omit
the batch dimensions: (p, 2) stands for (..., p, 2).

Source: Kong and Lucey, "Deep Non-Rigid Structure from Motion", ICCV 2019, arXiv 1902.10840. The
docstrings name the paper's equations by their labels in its LaTeX source, e.g. eq:singleBISTA.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.nrsfm.geometry import Array, polar

PAPER_WIDTHS = (125, 114, 104, 93, 83, 72, 62, 51, 41, 30, 20, 10)
"""Widths k_1 ... k_12 of the paper's 12 dictionaries: linspace(125, 10, 12)."""
WIDE_WIDTHS = (256, 128, 64, 48)
"""Default widths: four wide dictionaries, which do not collapse under the cycle loss."""
_FULL_WHITENING_FLOOR = 1e-3  # variance of noise, relative to the largest, without a network


@dataclass(frozen=True)
@described
class Architecture:
    """Network architecture."""

    widths: tuple[int, ...] = option(
        WIDE_WIDTHS, "atoms k_1 ... k_n of each dictionary, first to last", low=1, high=4096
    )
    threshold: str = option(
        "relu",
        "threshold of the block codes: relu = ReLU of each entry minus its block's threshold (the "
        "paper's relaxation), block = exact soft threshold of each block's norm",
        choices=("relu", "block"),
    )
    recovery: str = option(
        "learned",
        "how code and camera are computed from the last block code: learned = two linear maps "
        "(the paper), closed_form = its best rank-one factors",
        choices=("learned", "closed_form"),
    )
    camera: str = option(
        "orthonormal",
        "camera of the network: orthonormal = M^T M = I by construction, free = any 3 x 2 matrix, "
        "whose spectral norm the loss penalises",
        choices=("orthonormal", "free"),
    )
    whitening: float = option(
        1.0,
        "exponent of the whitening of the keypoints: 0 = off (the paper's network), 1 = full; "
        "with 1 small variations of the shape count as much as large ones",
        low=0.0,
        high=1.0,
    )
    whitening_floor: float = option(
        1e-2,
        "variance, relative to the largest, below which the whitening takes a direction for "
        "noise; 0.01 typical",
        low=1e-8,
        high=1.0,
    )

    def __post_init__(self) -> None:
        """Raise ValueError for a network without a dictionary."""
        if not self.widths:
            raise ValueError("widths is empty; give the width of at least one dictionary")

    @property
    def is_default_variant(self) -> bool:
        """Return whether threshold, recovery and camera are the defaults, as the kernel needs."""
        default = type(self)
        variant = self.threshold, self.recovery, self.camera
        return variant == (default.threshold, default.recovery, default.camera)


@dataclass(frozen=True)
class Network:
    """The weights of a network with n dictionaries for p keypoints.

    Attributes:
        architecture: widths k_1 ... k_n and variants.
        D: dictionaries; D[0] (p, 3, k_1), D[i] (k_i, k_i+1). Encoder and decoder share them.
        b: thresholds of the encoder; b[i] (k_i+1), one for each block.
        b_: biases of the decoder; b_[0] (p, 3) of the shape, b_[i] (k_i) of the code psi_i.
        code_head: (6 k_n, k_n), from the entries of Psi_n to psi_n.
        camera_head: (k_n, 1), from the blocks of Psi_n to M^T.
        L: (p, p) whitening, fixed before the training; see `whitening`.
        L_inverse: (p, p) its inverse.
    """

    architecture: Architecture
    D: tuple[Array, ...]
    b: tuple[Array, ...]
    b_: tuple[Array, ...]
    code_head: Array
    camera_head: Array
    L: Array
    L_inverse: Array

    @property
    def p(self) -> int:
        """Return the number of keypoints."""
        return int(self.D[0].shape[0])

    def named_weights(self) -> Iterator[tuple[str, Array]]:
        """Yield every weight with its name in files, e.g. ("D.1", D[1]) or ("L", L)."""
        for name, group in (("D", self.D), ("b", self.b), ("b_", self.b_)):
            yield from ((f"{name}.{i}", weight) for i, weight in enumerate(group))
        for name in _SINGLE:
            yield name, getattr(self, name)

    def trainable_weights(self) -> Iterator[tuple[str, Array]]:
        """Yield the weights that training changes: all but the whitening."""
        return ((name, w) for name, w in self.named_weights() if not name.startswith("L"))

    def map(self, function: Callable[[Array], Array]) -> Network:
        """Return a network with `function` applied to every weight, e.g. torch.from_numpy."""
        weights = {name: function(w) for name, w in self.named_weights()}
        return self.from_named_weights(self.architecture, weights)

    @classmethod
    def from_named_weights(cls, architecture: Architecture, weights: dict[str, Array]) -> Network:
        """Return the network of named weights, the inverse of `named_weights`.

        Raises:
            KeyError: a weight is missing.
        """
        layers = range(len(architecture.widths))
        D, b, b_ = (tuple(weights[f"{k}.{i}"] for i in layers) for k in ("D", "b", "b_"))
        return cls(architecture, D, b, b_, *(weights[name] for name in _SINGLE))


_SINGLE = ("code_head", "camera_head", "L", "L_inverse")


def forward(net: Network, W: Array) -> tuple[Array, Array]:
    """Return shape and camera of 2D keypoints: the whole network.

    Args:
        net: the network's weights.
        W: (..., p, 2) centred keypoints in units of the object, e.g. from `normalise`.

    Returns:
        S (..., p, 3) in the units of W, and M (..., 3, 2) with W ~ S M.

    Source: eq:proj, W = S M.
    """
    Psi_n = encode(net, W)[-1]  # (2, 3, k_n)
    psi_n, M = recover(net, Psi_n)  # (k_n), (3, 2)
    S, _ = decode(net, psi_n)  # (p, 3)
    return S, M


def reconstruct(net: Network, W: Array) -> tuple[Array, Array]:
    """Return `forward`, but always with an orthonormal camera.

    The scale of a free camera becomes the scale of the shape.

    Args:
        net: the network's weights.
        W: (..., p, 2) as for `forward`.

    Returns:
        S (..., p, 3), and M (..., 3, 2) with M^T M = I.
    """
    S, M = forward(net, W)
    if net.architecture.camera == "orthonormal":
        return S, M
    size = ((M * M).sum((-2, -1))[..., None, None] / 2) ** 0.5  # (1, 1)
    return S * size, polar(M.swapaxes(-1, -2)).swapaxes(-1, -2)


def encode(net: Network, W: Array) -> list[Array]:
    """Return the block codes of 2D keypoints: one step of block ISTA for each dictionary.

    Psi_1 = h((D_1#)^T L W - b_1), Psi_i = h((D_i (x) I_3)^T Psi_i-1 - b_i).

    Args:
        net: the network's weights.
        W: (..., p, 2) as for `forward`.

    Returns:
        Psi_1 ... Psi_n, of shape (..., 2, 3, k_i), as the legend of the package stores them.

    Source: section "Block ISTA and DNNs solution", "Encoder"; eq:mlbsc_w.
    """
    h = _THRESHOLDS[net.architecture.threshold]
    p, _, k_1 = net.D[0].shape
    W = whiten(net, W)  # (p, 2)
    D_sharp = net.D[0].reshape(p, 3 * k_1)  # (p, 3 k_1)
    V = _product(W.swapaxes(-1, -2), D_sharp)  # (2, 3 k_1)
    Psi = [h(V.reshape(*W.shape[:-2], 2, 3, k_1), net.b[0])]  # (2, 3, k_1)
    for D, b in zip(net.D[1:], net.b[1:], strict=True):
        Psi.append(h(_product(Psi[-1], D), b))  # (2, 3, k_i)
    return Psi


def recover(net: Network, Psi: Array) -> tuple[Array, Array]:
    """Return code and camera of the last block code, Psi_n = psi_n (x) M.

    Args:
        net: the network's weights.
        Psi: (..., 2, 3, k_n).

    Returns:
        psi_n (..., k_n), and M (..., 3, 2).

    Source: section "Code and camera recovery"; the orthonormal M is that of "Loss function".
    """
    if net.architecture.recovery == "closed_form":
        psi, M_T = _leading_factors(Psi)  # (k_n), (2, 3)
    else:
        psi = Psi.reshape(*Psi.shape[:-3], 6 * Psi.shape[-1]) @ net.code_head  # (k_n)
        M_T = _product(Psi, net.camera_head)[..., 0]  # (2, 3)
    if net.architecture.camera == "orthonormal":
        M_T = polar(M_T)
    return psi, M_T.swapaxes(-1, -2)


def decode(net: Network, psi: Array) -> tuple[Array, list[Array]]:
    """Return the shape of a code, through the encoder's dictionaries.

    psi_i-1 = relu(D_i psi_i - b'_i-1), s = D_1 psi_1 - b'_0, S = L^-1 s reshaped to (p, 3).

    Args:
        net: the network's weights.
        psi: (..., k_n) the last code.

    Returns:
        S (..., p, 3), and the codes psi_1 ... psi_n, of shape (..., k_i).

    Source: section "Decoder"; eq:mlsc. The bias b'_0 is not in the paper but in the authors'
    release: it is the mean shape, negative and whitened.
    """
    codes = [psi]
    for D, b in zip(net.D[:0:-1], net.b_[:0:-1], strict=True):
        codes.insert(0, _relu(codes[0] @ D.swapaxes(-1, -2) - b))  # (k_i-1)
    p, _, k_1 = net.D[0].shape
    s = codes[0] @ net.D[0].reshape(3 * p, k_1).swapaxes(-1, -2)  # (3 p)
    S = s.reshape(*psi.shape[:-1], p, 3) - net.b_[0]  # (p, 3), whitened
    return unwhiten(net, S), codes


def _relu(X: Array) -> Array:
    """Write max(X, 0) into X and return it; a new array would cost as much as the product."""
    return np.maximum(X, 0, out=X) if isinstance(X, np.ndarray) else X.relu_()


def _relu_threshold(V: Array, b: Array) -> Array:
    """Write relu(V - b (x) 1_3x2) into V (..., 2, 3, k) and return it. Source: eq:singleBISTA."""
    V -= b
    return _relu(V)


def _block_threshold(V: Array, b: Array) -> Array:
    """Return the block soft threshold max(1 - b_j / ||V_j||_F, 0) V_j of V (..., 2, 3, k).

    Source: the exact proximal step, in the text before eq:singleBISTA.
    """
    norm = ((V * V).sum((-3, -2))[..., None, None, :] + 1e-12) ** 0.5  # (1, 1, k)
    return V * (_relu(norm - b) / norm)


_THRESHOLDS = {"relu": _relu_threshold, "block": _block_threshold}


def _leading_factors(Psi: Array, iterations: int = 6) -> tuple[Array, Array]:
    """Return psi (..., k) and M^T (..., 2, 3) of the best rank-one Psi = psi (x) M.

    Power iteration on the 6 x k matrix of Psi. It starts at the sum of the blocks: for a
    non-negative code that is the camera up to scale, which settles the sign as well.
    """
    X = Psi.reshape(*Psi.shape[:-3], 6, Psi.shape[-1])  # (6, k)
    m = X.sum(-1)[..., None]  # (6, 1)
    for _ in range(iterations):
        m = X @ (X.swapaxes(-1, -2) @ m)
        m = m / ((m * m).sum(-2)[..., None] + 1e-12) ** 0.5
    # M^T M = I means ||M||_F^2 = 2, so the unit vector m is M / sqrt(2).
    psi = (X.swapaxes(-1, -2) @ m)[..., 0] * 0.5**0.5  # (k)
    return psi, (m * 2**0.5).reshape(*Psi.shape[:-3], 2, 3)


def _product(X: Array, A: Array) -> Array:
    """Return X A for X (..., k) and A (k, l): one product of all rows, which NumPy would split."""
    return (X.reshape(-1, X.shape[-1]) @ A).reshape(*X.shape[:-1], A.shape[-1])


# --- Whitening of the keypoints: ours, not in the paper ------------------------------------------


def whitening(
    moment: NDArray[np.float64], exponent: float, floor: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the whitening L of the keypoints and its inverse.

    W = S M implies L W = (L S) M for any L, so that a network may learn the shapes L S. With
    L = moment^(-exponent / 2) large movements of the limbs no longer hide small ones of toes and
    nose, which tell the front of a body from its back. That keeps depth from being mirrored in
    poses whose mirror image looks like another pose. L is scaled to keep the RMS of the points.

    Args:
        moment: (p, p) second moment E[W W^T] of the centred keypoints.
        exponent: 0 = identity, 1 = full whitening.
        floor: variances below this share of the largest count as this share; 0.01 typical.

    Returns:
        L and L^-1, both (p, p) and symmetric.
    """
    variance, U = np.linalg.eigh(moment)
    root = np.maximum(variance, floor * variance[-1]) ** (-exponent / 2)
    root *= np.sqrt(variance.clip(0).sum() / (root * root * variance.clip(0)).sum())
    return ((U * root) @ U.T).astype(np.float32), ((U / root) @ U.T).astype(np.float32)


def whitening_network(moment: NDArray[np.float64]) -> Network:
    """Return a network of which only the full whitening is used, to complete and whiten keypoints.

    Args:
        moment: (p, p) second moment E[W W^T] of the normalised keypoints.
    """
    L, L_inverse = whitening(moment, 1.0, _FULL_WHITENING_FLOOR)
    net = initialise(Architecture(widths=(1,)), len(moment), np.random.default_rng(0))
    return replace(net, L=L, L_inverse=L_inverse)


def whiten(net: Network, X: Array) -> Array:
    """Return L X for points X (..., p, d)."""
    return _symmetric_product(net.L, X) if net.architecture.whitening else X


def unwhiten(net: Network, X: Array) -> Array:
    """Return L^-1 X for points X (..., p, d), the inverse of `whiten`."""
    return _symmetric_product(net.L_inverse, X) if net.architecture.whitening else X


def complete(net: Network, points: Array, mask: Array) -> tuple[Array, Array]:
    """Fill in missing points where the network expects them.

    The points X that are filled in minimise ||L C X||_F, where C subtracts the mean: the expected
    points, given the visible ones, of a Gaussian with the second moment of the training data.
    Zeros would not do, because L spreads every point over all others. A network without whitening
    takes zeros and leaves its input unchanged.

    Args:
        net: the network's weights.
        points: (n, p, d).
        mask: (n, p, 1), 1 = visible, 0 = missing.

    Returns:
        Points (n, p, d) and mask (n, p, 1), which is 1 wherever a point is visible or filled in.
    """
    if not net.architecture.whitening or mask.all():
        return points, mask
    identity = net.L @ net.L_inverse  # in the library, type and place of the weights
    rows = mask * identity + (1 - mask) * completion_matrix(net)  # (n, p, p)
    return _solve(rows, mask * points), mask * 0 + 1


def completion_matrix(net: Network) -> Array:
    """Return the matrix P (p, p) of the condition (P X)_i = 0 for every missing point i.

    P is the gradient of ||L C X||_F^2 / 2, with C chosen for each frame so that the
    translation is optimal too. A small multiple of the identity makes the solution unique, so that
    a frame without a visible point has one.
    """
    P = net.L @ net.L
    sums = P.sum(-1)
    P = P - sums[:, None] * sums / sums.sum()
    return P + 1e-6 * P.trace() * (net.L @ net.L_inverse)


def point_precision(net: Network) -> NDArray[np.float64]:
    """Return the inverse second moment (p, p) of the points, in units of their RMS radius.

    The inverse of its part of some missing points is their covariance given the visible ones, with
    any translation of them all: the Gaussian of `complete`, whatever the exponent of the whitening.
    Without whitening all points vary alike. A small multiple of the identity makes every part
    invertible.
    """
    p, exponent = net.p, net.architecture.whitening
    root, U = np.linalg.eigh(np.asarray(net.L, np.float64))
    # Without whitening the roots are 1, whatever the exponent.
    P = (U * np.maximum(root, 1e-9) ** (2 / (exponent or 1))) @ U.T
    sums = P.sum(-1)
    P -= sums[:, None] * sums / sums.sum()
    P *= np.linalg.pinv(P).trace() / p
    precision: NDArray[np.float64] = P + 1e-6 * P.trace() * np.eye(p)
    return precision


def _solve(A: Array, B: Array) -> Array:
    """Return A^-1 B, for arrays or for tensors."""
    if isinstance(A, np.ndarray):
        return np.linalg.solve(A, B)
    from torch.linalg import solve

    return solve(A, B)


def _symmetric_product(A: Array, X: Array) -> Array:
    """Return A X for a symmetric A (p, p), as (X^T A)^T: one product for the whole batch."""
    return _product(X.swapaxes(-1, -2), A).swapaxes(-1, -2)


# --- Initial weights and their quality -----------------------------------------------------------


def weight_shapes(architecture: Architecture, p: int) -> dict[str, tuple[int, ...]]:
    """Return name and shape of every weight of a network for p keypoints."""
    k = architecture.widths
    shapes: dict[str, tuple[int, ...]] = {}
    for i, width in enumerate(k):
        shapes[f"D.{i}"] = (k[i - 1], width) if i else (p, 3, width)
        shapes[f"b.{i}"] = (width,)
        shapes[f"b_.{i}"] = (k[i - 1],) if i else (p, 3)
    shapes |= {"code_head": (6 * k[-1], k[-1]), "camera_head": (k[-1], 1)}
    return shapes | {"L": (p, p), "L_inverse": (p, p)}


def initialise(
    architecture: Architecture,
    p: int,
    rng: np.random.Generator,
    *,
    paper_initialisation: bool = False,
) -> Network:
    """Return a network with random weights and without whitening (L = I).

    Dictionaries and heads are Glorot-uniform, thresholds and biases zero.

    Args:
        architecture: widths and variants.
        p: number of keypoints, 4 or more.
        rng: source of the random weights.
        paper_initialisation: initialise as the authors' release. It draws thresholds and biases
            too, which silences 20-40 % of the narrowest layer from the start, and takes the fans
            of the equivalent convolutions.

    Returns:
        A network of float32 arrays.

    Source: section "Variation of implementation" for the convolutions.
    """
    weights = {}
    for name, shape in weight_shapes(architecture, p).items():
        fan = _convolution_fan(name, shape) if paper_initialisation else _matrix_fan(shape)
        limit = 0.0 if name.startswith("b") and not paper_initialisation else (6 / fan) ** 0.5
        weights[name] = rng.uniform(-limit, limit, shape).astype(np.float32)
    weights |= {name: np.eye(p, dtype=np.float32) for name in ("L", "L_inverse")}
    return Network.from_named_weights(architecture, weights)


def _matrix_fan(shape: tuple[int, ...]) -> int:
    """Return inputs + outputs of a weight, as the matrix that it is applied as."""
    return sum(shape) if len(shape) < 3 else 3 * shape[0] + shape[2]


def _convolution_fan(name: str, shape: tuple[int, ...]) -> int:
    """Return (input + output channels) x kernel size of a weight, as a convolution kernel."""
    if name == "D.0":
        return 3 * (shape[0] + shape[2])
    if name == "code_head":
        return 6 * (shape[1] + shape[1])
    return 2 * int(np.prod(shape)) if name.startswith("b") else sum(shape)


def coherence(net: Network) -> float:
    """Return the mutual coherence of the final dictionary.

    Returns:
        The largest magnitude of the cosine of two atoms, a number in [0, 1]; a low one indicates a
        good model. Atoms of norm zero count as orthogonal to all others.

    Source: section "Coherence as guide".
    """
    D = np.asarray(net.D[-1], np.float64).reshape(-1, net.D[-1].shape[-1])  # (k_n-1, k_n)
    D = D / np.maximum(np.linalg.norm(D, axis=0), 1e-12)
    G = np.abs(D.T @ D)  # (k_n, k_n)
    np.fill_diagonal(G, 0)
    return float(G.max())
