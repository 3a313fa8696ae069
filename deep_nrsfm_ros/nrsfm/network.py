"""The network: section "Deep Non-Rigid Structure from Motion" of the paper, top to bottom.

Symbols are named in the legend of this package. Everything here is written on operations that
NumPy and torch share: the trainer runs it on tensors, the lifter on arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.configuration import option
from deep_nrsfm_ros.nrsfm.geometry import Array, polar

PAPER_WIDTHS = (125, 114, 104, 93, 83, 72, 62, 51, 41, 30, 20, 10)
"""The paper's 12 dictionaries, linspace(125, 10, 12)."""
WIDE_WIDTHS = (256, 128, 64, 48)
"""Four wide dictionaries: the default; they do not collapse under the cycle loss."""


@dataclass(frozen=True)
class Architecture:
    """Network architecture."""

    widths: tuple[int, ...] = option(
        WIDE_WIDTHS, "atoms k_1 ... k_n of each dictionary, first to last", low=1, high=4096
    )
    threshold: str = option(
        "relu",
        "block threshold: its ReLU relaxation, or the exact soft threshold of each block's norm",
        choices=("relu", "block"),
    )
    recovery: str = option(
        "learned",
        "code and camera from the last block code: learned linear maps, or the closed form",
        choices=("learned", "closed_form"),
    )
    camera: str = option(
        "orthonormal",
        "camera of the network: its orthonormal factor, or free and held by the loss",
        choices=("orthonormal", "free"),
    )
    whitening: float = option(
        1.0,
        "exponent of the keypoints' whitening: 1 makes the network care as much for the small "
        "ways in which the points vary as for the large ones, 0 is the paper's network",
        low=0.0,
        high=1.0,
    )
    whitening_floor: float = option(
        1e-2,
        "variance below which a direction counts as noise, relative to the largest",
        low=1e-8,
        high=1.0,
    )

    def __post_init__(self) -> None:
        """Refuse a network without a dictionary."""
        if not self.widths:
            raise ValueError("widths is empty; give the width of at least one dictionary")

    @property
    def is_default_variant(self) -> bool:
        """Tell whether it is of the kind that is written out by hand: its gradient, the kernel."""
        usual = type(self)
        ours = self.threshold, self.recovery, self.camera
        return ours == (usual.threshold, usual.recovery, usual.camera)


@dataclass(frozen=True)
class Network:
    """Weights of the multi-layer block-sparse dictionary; shapes in the package's legend."""

    architecture: Architecture
    D: tuple[Array, ...]
    b: tuple[Array, ...]
    b_: tuple[Array, ...]  # b_[0] (p, 3) is the bias of S itself, b_[i] (k_i) that of psi_i
    code_head: Array  # (6 k_n, k_n): psi_n from the entries of Psi_n
    camera_head: Array  # (k_n, 1): M as a linear combination of the blocks of Psi_n
    L: Array  # (p, p) whitening of the points, fixed before training; see `whitening`
    L_inverse: Array  # (p, p)

    @property
    def p(self) -> int:
        """Return the number of keypoints."""
        return int(self.D[0].shape[0])

    def named(self) -> Iterator[tuple[str, Array]]:
        """Yield every array under a stable name, e.g. ("D.1", ...)."""
        for name, group in (("D", self.D), ("b", self.b), ("b_", self.b_)):
            yield from ((f"{name}.{i}", weight) for i, weight in enumerate(group))
        for name in _SINGLE:
            yield name, getattr(self, name)

    def learned(self) -> Iterator[tuple[str, Array]]:
        """Yield what training changes: everything but the whitening."""
        return ((name, weight) for name, weight in self.named() if not name.startswith("L"))

    def map(self, function: Callable[[Array], Array]) -> Network:
        """Return the network with `function` applied to every weight, e.g. torch.from_numpy."""
        return self.from_named(self.architecture, {k: function(w) for k, w in self.named()})

    @classmethod
    def from_named(cls, architecture: Architecture, weights: dict[str, Array]) -> Network:
        """Rebuild a network from what `named` yields; raise KeyError for a missing weight."""
        layers = range(len(architecture.widths))
        D, b, b_ = (tuple(weights[f"{k}.{i}"] for i in layers) for k in ("D", "b", "b_"))
        return cls(architecture, D, b, b_, *(weights[name] for name in _SINGLE))


_SINGLE = ("code_head", "camera_head", "L", "L_inverse")


def weight_shapes(architecture: Architecture, p: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of every array of a network for p keypoints."""
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
    """Return a float32 network of Glorot-uniform dictionaries and heads, not yet whitened.

    Thresholds and biases start at zero. `paper_initialisation` starts as the authors' release: it
    draws them too, which silences 20-40 % of the narrowest layer from the start, and its fans
    are those of the convolutions ("Variation of implementation").
    """
    weights = {}
    for name, shape in weight_shapes(architecture, p).items():
        fan = _convolution_fan(name, shape) if paper_initialisation else _matrix_fan(shape)
        limit = 0.0 if name.startswith("b") and not paper_initialisation else (6 / fan) ** 0.5
        weights[name] = rng.uniform(-limit, limit, shape).astype(np.float32)
    weights |= {name: np.eye(p, dtype=np.float32) for name in ("L", "L_inverse")}
    return Network.from_named(architecture, weights)


def _matrix_fan(shape: tuple[int, ...]) -> int:
    """Return inputs + outputs of a weight as the matrix that it is applied as."""
    return sum(shape) if len(shape) < 3 else 3 * shape[0] + shape[2]


def _convolution_fan(name: str, shape: tuple[int, ...]) -> int:
    """Return (input + output channels) x kernel size of a weight as a convolution kernel."""
    if name == "D.0":
        return 3 * (shape[0] + shape[2])
    if name == "code_head":
        return 6 * (shape[1] + shape[1])
    return 2 * int(np.prod(shape)) if name.startswith("b") else sum(shape)


def whitening(
    moment: NDArray[np.float64], exponent: float, floor: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return L and its inverse (p, p) for the second moment E[W W^T] (p, p) of the points.

    W = S M implies L W = (L S) M for any L, so a network may learn the shapes L S instead. With
    L = moment^(-exponent / 2) the limbs no longer drown the toes and the nose, which tell the
    front of a body from its back: that keeps depth from coming out mirrored in the poses whose
    mirror image looks like another pose. Scaled to keep the RMS.
    """
    variance, U = np.linalg.eigh(moment)
    root = np.maximum(variance, floor * variance[-1]) ** (-exponent / 2)
    root *= np.sqrt(variance.clip(0).sum() / (root * root * variance.clip(0)).sum())
    return ((U * root) @ U.T).astype(np.float32), ((U / root) @ U.T).astype(np.float32)


def whiten(net: Network, X: Array) -> Array:
    """Return L X for points X (..., p, d): differences as the network weighs them."""
    return _symmetric_product(net.L, X) if net.architecture.whitening else X


def unwhiten(net: Network, X: Array) -> Array:
    """Return L^-1 X, the inverse of `whiten`."""
    return _symmetric_product(net.L_inverse, X) if net.architecture.whitening else X


def complete(net: Network, points: Array, mask: Array) -> tuple[Array, Array]:
    """Fill the missing of points (n, p, d), mask (n, p, 1) 1 or 0; return points and mask.

    They go where ||L C X||_F is least, C taking the mean off: where a Gaussian of the keypoints'
    second moment expects them, given those seen. Zeros would not do, since L spreads every point
    over all others. A network without whitening takes zeros, so all stays as it is.
    """
    if not net.architecture.whitening or mask.all():
        return points, mask
    rows = mask * (net.L @ net.L_inverse) + (1 - mask) * filling(net)
    return _solve(rows, mask * points), mask * 0 + 1


def filling(net: Network) -> Array:
    """Return P (p, p), of which the rows of missing points, times all points, are to be zero."""
    P = net.L @ net.L
    sums = P.sum(-1)
    # Least over the translation as well, which takes one direction out of P.
    P = P - sums[:, None] * sums / sums.sum()
    # So that a frame without a visible point has an answer too.
    return P + 1e-6 * P.trace() * (net.L @ net.L_inverse)


def _solve(A: Array, B: Array) -> Array:
    """Return A^-1 B in the library that they are of."""
    if isinstance(A, np.ndarray):
        return np.linalg.solve(A, B)
    from torch.linalg import solve

    return solve(A, B)


def _symmetric_product(A: Array, X: Array) -> Array:
    """Return A X for a symmetric A (p, p), as X^T A: one matrix product for the whole batch."""
    return _product(X.swapaxes(-1, -2), A).swapaxes(-1, -2)


def _product(X: Array, A: Array) -> Array:
    """Return X A for X (..., k): one product of all rows, where NumPy would make one a matrix."""
    return (X.reshape(-1, X.shape[-1]) @ A).reshape(*X.shape[:-1], A.shape[-1])


def forward(net: Network, W: Array) -> tuple[Array, Array]:
    """Return shape S (..., p, 3) and camera M (..., 3, 2) of the keypoints W (..., p, 2)."""
    psi, M = recover(net, encode(net, W)[-1])
    return decode(net, psi)[0], M


def reconstruct(net: Network, W: Array) -> tuple[Array, Array]:
    """Return `forward` with an orthonormal M; S takes over the size of a free camera."""
    S, M = forward(net, W)
    if net.architecture.camera == "orthonormal":
        return S, M
    size = ((M * M).sum((-2, -1))[..., None, None] / 2) ** 0.5
    return S * size, polar(M.swapaxes(-1, -2)).swapaxes(-1, -2)


def encode(net: Network, W: Array) -> list[Array]:
    """Return the block codes Psi_1 ... Psi_n (..., 2, 3, k_i): one block-ISTA step a layer.

    "Encoder", on L W: Psi_1 = h((D_1#)^T W - b_1), Psi_i = h((D_i (x) I_3)^T Psi_i-1 - b_i).
    """
    threshold = _THRESHOLDS[net.architecture.threshold]
    p, _, k = net.D[0].shape
    W = whiten(net, W)
    V = _product(W.swapaxes(-1, -2), net.D[0].reshape(p, 3 * k)).reshape(*W.shape[:-2], 2, 3, k)
    Psi = [threshold(V, net.b[0])]
    for D, b in zip(net.D[1:], net.b[1:], strict=True):
        Psi.append(threshold(_product(Psi[-1], D), b))
    return Psi


def _relu(X: Array) -> Array:
    """Put max(X, 0) in place of X, and return it: a second array would take as long to fill."""
    return np.maximum(X, 0, out=X) if isinstance(X, np.ndarray) else X.relu_()


def _relu_threshold(V: Array, b: Array) -> Array:
    """Put relu(V - b (x) 1_3x2) in place of V: the paper's relaxation (eq. "singleBISTA")."""
    V -= b
    return _relu(V)


def _block_threshold(V: Array, b: Array) -> Array:
    """Return h_b(||V_j||_F) / ||V_j||_F V_j for each block j, the exact proximal step."""
    norm = ((V * V).sum((-3, -2))[..., None, None, :] + 1e-12) ** 0.5
    return V * (_relu(norm - b) / norm)


_THRESHOLDS = {"relu": _relu_threshold, "block": _block_threshold}


def recover(net: Network, Psi: Array) -> tuple[Array, Array]:
    """Return code psi_n (..., k_n) and camera M (..., 3, 2): "Code and camera recovery"."""
    if net.architecture.recovery == "closed_form":
        psi, rows = _leading_factors(Psi)
    else:
        psi = Psi.reshape(*Psi.shape[:-3], 6 * Psi.shape[-1]) @ net.code_head
        rows = _product(Psi, net.camera_head)[..., 0]
    if net.architecture.camera == "orthonormal":
        rows = polar(rows)
    return psi, rows.swapaxes(-1, -2)


def _leading_factors(Psi: Array, iterations: int = 6) -> tuple[Array, Array]:
    """Return psi (..., k) and M^T (..., 2, 3) of the rank-one Psi = psi (x) M.

    Power iteration on the k x 6 reshape. It starts at the sum of the blocks, which for a
    non-negative code is the camera itself up to scale, and so settles the sign as well.
    """
    X = Psi.reshape(*Psi.shape[:-3], 6, Psi.shape[-1])
    m = X.sum(-1)[..., None]
    for _ in range(iterations):
        m = X @ (X.swapaxes(-1, -2) @ m)
        m = m / ((m * m).sum(-2)[..., None] + 1e-12) ** 0.5
    # M^T M = I means ||M||_F^2 = 2: the unit factor m is M / sqrt(2).
    psi = (X.swapaxes(-1, -2) @ m)[..., 0] * 0.5**0.5
    return psi, (m * 2**0.5).reshape(*Psi.shape[:-3], 2, 3)


def decode(net: Network, psi: Array) -> tuple[Array, list[Array]]:
    """Return S (..., p, 3) and the codes psi_1 ... psi_n (..., k_i) from the last of them.

    "Decoder", with the encoder's dictionaries: psi_i-1 = relu(D_i psi_i - b'_i-1),
    s = D_1 psi_1 - b'_0. The last bias is not in the paper but in its authors' release; it is
    the mean shape, negative and whitened.
    """
    codes = [psi]
    for D, b in zip(net.D[:0:-1], net.b_[:0:-1], strict=True):
        codes.insert(0, _relu(codes[0] @ D.swapaxes(-1, -2) - b))
    p, _, k = net.D[0].shape
    s = codes[0] @ net.D[0].reshape(3 * p, k).swapaxes(-1, -2)
    S = s.reshape(*psi.shape[:-1], p, 3) - net.b_[0]
    return unwhiten(net, S), codes


def coherence(net: Network) -> float:
    """Return the mutual coherence of the final dictionary: max |cos| between two atoms.

    "Coherence as guide" in the paper. Atoms of norm zero count as orthogonal to all.
    """
    D = np.asarray(net.D[-1], np.float64).reshape(-1, net.D[-1].shape[-1])
    D = D / np.maximum(np.linalg.norm(D, axis=0), 1e-12)
    G = np.abs(D.T @ D)
    np.fill_diagonal(G, 0)
    return float(G.max())
