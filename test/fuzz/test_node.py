"""What others set and say: parameters are accepted or refused, a training is understood or not."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from rclpy.parameter import Parameter

from deep_nrsfm_ros.configuration import options
from deep_nrsfm_ros.data import bags
from deep_nrsfm_ros.data.bags import frames
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.decoding import POINT_CLOUD
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.messages.pipeline import Pipeline
from deep_nrsfm_ros.model_files.model_file import save_model
from deep_nrsfm_ros.model_files.path_sandbox import PathSandbox
from deep_nrsfm_ros.node import parameter_bridge
from deep_nrsfm_ros.node.lifter import LifterNode
from deep_nrsfm_ros.node.parameter_bridge import parameter_name
from deep_nrsfm_ros.nrsfm.recipe import Recipe
from deep_nrsfm_ros.training.job import parse_progress
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.record import read_record, record_file
from deep_nrsfm_ros.training.request import TrainingOptions, sandboxed
from test.fuzz.conftest import Bench, Fuzz, Spoiler

PATHS = ("thing", "link", "link.safetensors", "/etc/passwd", "~", "~x/y.yaml", "coco17", "model",
         "thing.safetensors", "../" * 9, "numbered", "a.yaml", "x" * 5000)  # fmt: skip


def test_what_a_training_says_and_leaves_is_understood_or_not(fuzz: Fuzz, tmp_path: Path) -> None:
    line = b'{"state": "training", "step": 3, "steps": 9, "loss": 0.5, "seconds_left": 7, "a": [1]}'

    def one(spoiler: Spoiler) -> str:
        text = spoiler.spoil_bytes(line)
        text = text if spoiler.random() < 0.9 else b"[" * spoiler.randrange(60000)
        record_file(tmp_path, "mine").write_bytes(text)
        progress = parse_progress(text.decode(errors="replace"))
        record = read_record(tmp_path, "mine")
        assert record is None or str(record) and record.advice
        return "progress" if progress else "words"

    fuzz("training", one)


def test_parameters_are_accepted_or_refused_and_leave_no_trace(
    bench: Bench, fuzz: Fuzz, tmp_path: Path
) -> None:
    """As the lifter considers them, and as it makes a training request of them."""
    save_model(tmp_path / "thing.safetensors", bench.model)
    (tmp_path / "link.safetensors").symlink_to("/etc/passwd")
    inputs = InputOptions(model="thing", models_dir=str(tmp_path), bags_dir=str(tmp_path))
    stub: Any = SimpleNamespace(get_parameter_or=lambda name, default: default)
    stub._sandbox = PathSandbox(tmp_path, tmp_path, ["thing"])
    stub._pipeline = Pipeline(bench.model, None, inputs, LiftingOptions(), SmoothingOptions())
    stub._build_pipeline = lambda changes: LifterNode._build_pipeline(stub, changes)
    stub._chosen = None
    stub._assemble = lambda *given: LifterNode._assemble(stub, *given)
    stub._layout_so_far = lambda model: LifterNode._layout_so_far(stub, model)
    stub._training_parameters = lambda changes: LifterNode._training_parameters(stub, changes)
    p = len(bench.layout)
    points = np.random.default_rng(0).uniform(50, 600, (1, p, 2))
    valid = bags._ENCODERS[POINT_CLOUD](next(frames(points, np.ones((1, p)))))
    expected = bench.lift(stub._pipeline, valid, POINT_CLOUD)
    known: list[tuple[type[Any], str]] = [(c, "") for c in (InputOptions, LiftingOptions)]
    known += [(c, "train.") for c in (TrainingOptions, Recipe, Limits, Curation)]
    known += [(SmoothingOptions, "smoothing.")]
    defaults = [
        (parameter_name(f, prefix), f.default) for c, prefix in known for f, _, _ in options(c)
    ]

    def value(spoiler: Spoiler, default: Any) -> Any:
        if isinstance(default, bool):
            return spoiler.random() < 0.5
        if isinstance(default, int):
            return max(-(2**63), min(spoiler.choice(spoiler.sizes), 2**63 - 1))
        if isinstance(default, float):  # of dynamic type
            return spoiler.choice((*spoiler.numbers, 0.5, 3, -1, True, "x", ["x"]))
        bits = (*spoiler.words, *PATHS)
        words = [
            spoiler.choice(("", "/")).join(spoiler.choices(bits, k=spoiler.choice((1, 1, 2, 3))))
            for _ in range(spoiler.randrange(1, 4))
        ]
        return words if isinstance(default, tuple) else words[0]

    def one(spoiler: Spoiler) -> str:
        chosen = spoiler.choices(defaults, k=spoiler.choice((1, 1, 2, 5)))
        changes = [Parameter(name, value=value(spoiler, default)) for name, default in chosen]
        result = LifterNode._validate_parameters(stub, changes)
        assert result.successful != bool(result.reason)
        assert "internal error" not in result.reason, result.reason
        given = {change.name: change.value for change in changes}
        stub.get_parameter_or = lambda name, default: (
            Parameter(name, value=given[name]) if name in given else default
        )
        try:
            sandboxed(parameter_bridge.read(stub, TrainingOptions, "train."), stub._sandbox)
        except (ValueError, OSError) as refusal:
            assert str(refusal)
        finally:
            stub.get_parameter_or = lambda name, default: default
        if spoiler.random() < 0.02:
            again = bench.lift(stub._pipeline, valid, POINT_CLOUD)
            for old, new in zip(expected, again, strict=True):
                np.testing.assert_array_equal(old, new)
        return "accepted" if result.successful else "refused"

    fuzz("parameters", one)
