# SPDX-License-Identifier: Apache-2.0
"""One pass of the network, compiled and in NumPy, against torch and ONNX Runtime."""

from __future__ import annotations

import tempfile
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from benchmarks.speed.plain_torch import PlainNetwork
from benchmarks.speed.timing import interleaved, print_and_write, require_one_thread, speed_parser
from benchmarks.table import Table, bars
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.model_files.folders import model_folders
from deep_nrsfm_ros.model_files.model_file import Model, find_model, load_model
from deep_nrsfm_ros.nrsfm.network import Network, forward, initialise
from deep_nrsfm_ros.nrsfm.recipe import PRESETS

BATCHES = (1, 100)
OURS = "ours, compiled"
ONNX = "ONNX Runtime"
LEGEND = {
    "p50 us": "median time of a call, one thread",
    "ratio": f"to {OURS}; above 1 is slower",
    OURS: "one pass as the lifter makes it, with normalisation, checks and confidence; without "
    "test-time rotations and correction",
    "NumPy": "our code on arrays, the pass alone; the lifter uses it where there was no compiler",
    "torch eager, torch.jit": "our code on tensors, without gradient; the same traced",
    "torch eager, convolutions": "each layer as the paper writes it, the camera from an SVD",
    ONNX: "our code, exported by torch.onnx; install with `pip install '.[speed]'`",
    "Lifter": "the whole call, with three test-time rotations and the correction",
    "paper": "the paper's 12 dictionaries with random weights; default: the model cmu31; human: "
    "the model of that name, whose dictionaries are wider",
}
Call = Callable[[], object]


class _Module(nn.Module):
    """Our network as a torch module."""

    def __init__(self, net: Network) -> None:
        super().__init__()
        self.net = net.map(torch.from_numpy)

    def forward(self, W: Tensor) -> tuple[Tensor, Tensor]:
        S, M = forward(self.net, W)
        return S, M


def passes(net: Network, W: NDArray[np.float32]) -> dict[str, Call]:
    """Return name -> function that computes shapes and cameras of W (b, p, 2)."""
    x, ours, convolutions = torch.from_numpy(W), _Module(net).eval(), PlainNetwork(net).eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch.jit is deprecated but the fastest in torch
        traced: Any = torch.jit.freeze(torch.jit.trace(ours, (x,)))
    calls: dict[str, Call] = {
        "NumPy": lambda: forward(net, W),
        "torch eager": lambda: ours(x),
        "torch eager, convolutions": lambda: convolutions(x),
        "torch.jit": lambda: traced(x),
    }
    if session := _onnx_session(ours, x):
        calls[ONNX] = lambda: session.run(None, {"W": W})
    return calls


def _onnx_session(module: nn.Module, x: Tensor) -> Any:
    """Return an ONNX Runtime session of the module, None if it is not installed."""
    try:
        import onnxruntime
        import onnxscript  # noqa: F401  needed by the exporter
    except ModuleNotFoundError:
        return None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings of the exporter
        path = Path(folder) / "network.onnx"
        torch.onnx.export(module, (x,), path, dynamo=True, input_names=["W"], verbose=False)
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def models() -> dict[str, Model]:
    """Return architecture -> model to time."""
    folders = model_folders(Path("models"))
    default, people = (load_model(find_model(name, folders)) for name in ("cmu31", "human"))
    architecture, normaliser, _ = PRESETS["paper"]
    p = len(default.layout)
    paper = initialise(architecture, p, np.random.default_rng(0))
    return {
        "default": default,
        "human": people,
        "paper": Model("paper", paper, default.layout, normaliser, default.object_frame),
    }


@torch.no_grad()
def benchmark(args: Namespace) -> Iterator[Table]:
    """Time the passes and the lifters, interleaved; yield the table."""
    rounds, seconds = (1, 0.005) if args.quick else (5, 0.4)
    table = Table(
        "forward_pass",
        "One pass of the network, and the whole Lifter",
        ("network", "batch", "by"),
        ("p50 us", "ratio"),
        LEGEND,
        bars("ratio"),
    )
    rng = np.random.default_rng(0)
    for name, model in models().items():
        for batch in BATCHES:
            W = rng.standard_normal((batch, len(model.layout), 2)).astype(np.float32)
            W -= W.mean(1, keepdims=True)
            confidence = np.ones(W.shape[:2], np.float32)
            single_pass = Lifter(model, LiftingOptions(test_time_rotations=1, correction="none"))
            contenders = {OURS: _call(single_pass, W, confidence), **passes(model.network, W)}
            contenders["Lifter"] = _call(Lifter(model), W, confidence)
            p50 = {
                n: 1e6 * np.median(t) for n, t in interleaved(contenders, rounds, seconds).items()
            }
            for by, us in p50.items():
                figures = {"p50 us": float(us), "ratio": float(us / p50[OURS])}
                table.add((name, str(batch), by), figures)
            if ONNX not in p50:
                table.add((name, str(batch), f"{ONNX} (not installed)"), {"p50 us": np.nan})
    yield table


def _call(lifter: Lifter, W: NDArray[np.float32], confidence: NDArray[np.float32]) -> Call:
    return lambda: lifter.lift(W, confidence)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    args = speed_parser(__doc__).parse_args(argv)
    torch.set_num_threads(1)
    print_and_write(benchmark(args), args.output)


if __name__ == "__main__":
    require_one_thread()
    main()
