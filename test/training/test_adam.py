# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import torch

import deep_nrsfm_ros
from deep_nrsfm_ros.training.adam import Adam

LEARN = """
import sys
import numpy as np
from deep_nrsfm_ros.nrsfm.network import Architecture
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import Preset, Recipe
from deep_nrsfm_ros.training.loop import train

points = np.random.default_rng(0).standard_normal((50, 8, 2)).astype(np.float32)
preset = Preset(Architecture(widths=(8, 4)), Normaliser(), Recipe(steps=3, batch=8, seeds=1))
train(points, np.ones((50, 8), bool), preset)
assert "torch" in sys.modules and "torch._dynamo" not in sys.modules
"""


def test_it_computes_what_torch_computes_also_after_a_restart() -> None:
    generator = torch.Generator().manual_seed(0)
    ours = torch.randn(1000, generator=generator)
    theirs = ours.clone().requires_grad_()
    adam, reference = Adam(ours), torch.optim.Adam([theirs], fused=True)
    for step in range(20):
        rate, gradient = 0.01 / (step + 1), torch.randn(1000, generator=generator)
        if step == 10:
            again = Adam(ours)
            again.restore({name: value.clone() for name, value in adam.moments.items()})
            adam = again
        adam.update(gradient, rate)
        reference.param_groups[0]["lr"], theirs.grad = rate, gradient
        reference.step()
        torch.testing.assert_close(ours, theirs.detach(), rtol=0, atol=0)
    assert adam.learning_rate == rate and adam.moments["step"] == 20


def test_a_training_does_not_import_the_compiler_of_torch() -> None:
    root = str(Path(deep_nrsfm_ros.__file__).parents[1])
    command = [sys.executable, "-c", LEARN]
    subprocess.run(command, check=True, timeout=120, env=os.environ | {"PYTHONPATH": root})
