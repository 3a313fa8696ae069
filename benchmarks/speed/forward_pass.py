"""One pass of the network: compiled and in NumPy, against torch and ONNX Runtime."""

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
from benchmarks.speed.timing import arguments, by_turns, on_one_thread, show
from benchmarks.table import Table, bars
from deep_nrsfm_ros.lifting.lifter import Lifter, LiftingOptions
from deep_nrsfm_ros.model_files.folders import model_folders
from deep_nrsfm_ros.model_files.model_file import Model, find_model, load_model
from deep_nrsfm_ros.nrsfm.network import Network, forward, initialise
from deep_nrsfm_ros.nrsfm.recipe import PRESETS

BATCHES = (1, 100)
OURS = "ours, compiled"
ONNX = "ONNX Runtime"
LEGEND = {
    "p50 us": "median of a call, one thread",
    "ratio": f"to {OURS}: above 1 is slower than ours",
    OURS: "one pass as the lifter makes it, which normalises, checks and rates its result as well: "
    "the whole Lifter but for further turns and the correction",
    "NumPy": "our code on arrays, the pass alone: the lifter's way where nothing could be compiled",
    "torch eager, torch.jit": "our code on tensors, without gradient; traced",
    "torch eager, convolutions": "each layer as the paper writes it, the camera by an SVD",
    ONNX: "our code, exported by torch.onnx; `pip install '.[speed]'` brings it",
    "Lifter": "the whole call, with the three turns of the input and the correction",
    "paper": "the paper's 12 dictionaries with random weights; default: the model cmu31",
}
Call = Callable[[], object]


class _Module(nn.Module):
    """Our code as a module of torch."""

    def __init__(self, net: Network) -> None:
        super().__init__()
        self.net = net.map(torch.from_numpy)

    def forward(self, W: Tensor) -> tuple[Tensor, Tensor]:
        S, M = forward(self.net, W)
        return S, M


def passes(net: Network, W: NDArray[np.float32]) -> dict[str, Call]:
    """Return what computes the same: shapes and cameras of W (b, p, 2); ONNX if it is there."""
    x, ours, convolutions = torch.from_numpy(W), _Module(net).eval(), PlainNetwork(net).eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch.jit is on its way out; still the fastest in torch
        traced: Any = torch.jit.freeze(torch.jit.trace(ours, (x,)))
    found: dict[str, Call] = {
        "NumPy": lambda: forward(net, W),
        "torch eager": lambda: ours(x),
        "torch eager, convolutions": lambda: convolutions(x),
        "torch.jit": lambda: traced(x),
    }
    if session := _onnx_session(ours, x):
        found[ONNX] = lambda: session.run(None, {"W": W})
    return found


def _onnx_session(module: nn.Module, x: Tensor) -> Any:
    """Return the module in ONNX Runtime, None where that is not installed."""
    try:
        import onnxruntime
        import onnxscript  # noqa: F401  the exporter's
    except ModuleNotFoundError:
        return None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter about itself
        path = Path(folder) / "network.onnx"
        torch.onnx.export(module, (x,), path, dynamo=True, input_names=["W"], verbose=False)
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def models() -> dict[str, Model]:
    """Return the models that are timed, by the name of their architecture."""
    default = load_model(find_model("cmu31", model_folders(Path("models"))))
    architecture, normaliser, _ = PRESETS["paper"]
    p = len(default.layout)
    paper = initialise(architecture, p, np.random.default_rng(0))
    return {
        "default": default,
        "paper": Model("paper", paper, default.layout, normaliser, default.object_frame),
    }


@torch.no_grad()
def benchmark(given: Namespace) -> Iterator[Table]:
    """Time the passes and the lifters, in turns."""
    rounds, seconds = (1, 0.005) if given.quick else (5, 0.4)
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
            sure = np.ones(W.shape[:2], np.float32)
            once = Lifter(model, LiftingOptions(test_time_rotations=1, correction="none"))
            contenders = {OURS: _call(once, W, sure), **passes(model.network, W)}
            contenders["Lifter"] = _call(Lifter(model), W, sure)
            p50 = {n: 1e6 * np.median(t) for n, t in by_turns(contenders, rounds, seconds).items()}
            for by, us in p50.items():
                figures = {"p50 us": float(us), "ratio": float(us / p50[OURS])}
                table.add((name, str(batch), by), figures)
            if ONNX not in p50:
                table.add((name, str(batch), f"{ONNX} (not installed)"), {"p50 us": np.nan})
    yield table


def _call(lifter: Lifter, W: NDArray[np.float32], sure: NDArray[np.float32]) -> Call:
    return lambda: lifter.lift(W, sure)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    given = arguments(__doc__).parse_args(argv)
    torch.set_num_threads(1)
    show(benchmark(given), given.output)


if __name__ == "__main__":
    on_one_thread()
    main()
