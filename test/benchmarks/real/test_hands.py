# SPDX-License-Identifier: Apache-2.0
"""The benchmark of hands trains with the front of the layout, unless told otherwise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.real import hands


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_the_front_is_a_loss_of_its_own(weight: float, monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).standard_normal((60, 21, 2)).astype(np.float32)
    monkeypatch.setattr(hands, "collection", lambda folder, name: points)
    model, _ = hands.train(Path("unused"), ["kinivi"], 4, 0, weight)
    losses = model.provenance.get("layout_loss", {"handedness_weight": 0.0})
    assert losses["handedness_weight"] == weight
    assert not losses.get("bone_length_weight")
