# SPDX-License-Identifier: Apache-2.0
"""What others set and say: parameters are accepted or refused, a training is understood or not."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.parameter import Parameter

from deep_nrsfm_ros.configuration import options
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.options import InputOptions
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
from test.node.conftest import own_domain

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


@pytest.fixture
def lifter(bench: Bench, tmp_path: Path) -> Iterator[LifterNode]:
    """A lifter with the model `thing`, in a folder that holds a link out of it."""
    save_model(tmp_path / "thing.safetensors", bench.model)
    (tmp_path / "link.safetensors").symlink_to("/etc/passwd")
    settings = ("model:=thing", f"models_dir:={tmp_path}", f"bags_dir:={tmp_path}")
    arguments = ["--ros-args", *(word for text in settings for word in ("-p", text))]
    with own_domain() as domain:
        rclpy.init(args=arguments, domain_id=domain)
        try:
            node = LifterNode()
            yield node
            node.close()
        finally:
            rclpy.try_shutdown()


def test_parameters_are_accepted_or_refused_and_leave_no_trace(
    bench: Bench, fuzz: Fuzz, lifter: LifterNode, tmp_path: Path
) -> None:
    """Set and set back on a lifter, and read as a request of a training."""
    sandbox = PathSandbox(tmp_path, tmp_path, ["thing"])
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
        # A client cannot send half of a surrogate pair: a message is UTF-8.
        words = [word.encode(errors="replace").decode() for word in words]
        return words if isinstance(default, tuple) else words[0]

    start = lifter.get_parameters([name for name, _ in defaults])

    def one(spoiler: Spoiler) -> str:
        chosen = spoiler.choices(defaults, k=spoiler.choice((1, 1, 2, 5)))
        changes = [Parameter(name, value=value(spoiler, default)) for name, default in chosen]
        before = lifter.get_parameters([change.name for change in changes])
        result = lifter.set_parameters_atomically(changes)
        assert result.successful != bool(result.reason)
        assert "internal error" not in result.reason, result.reason
        if not result.successful:
            assert lifter.get_parameters([p.name for p in before]) == before
            return "refused"
        try:
            sandboxed(parameter_bridge.read(lifter, TrainingOptions, "train."), sandbox)
        except (ValueError, OSError) as refusal:
            assert str(refusal)
        assert lifter.set_parameters_atomically(before).successful
        return "accepted"

    fuzz("parameters", one)
    assert lifter.get_parameters([parameter.name for parameter in start]) == start
