# SPDX-License-Identifier: Apache-2.0
"""The benchmark of hands: the loss of the front, and the last step from virtual hands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.real import hands
from deep_nrsfm_ros.data.virtual_hands import virtual_hands
from deep_nrsfm_ros.model_files.model_file import load_model, save_model


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_the_front_is_a_loss_of_its_own(weight: float, monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).standard_normal((60, 21, 2)).astype(np.float32)
    monkeypatch.setattr(hands, "collection", lambda folder, name: points)
    options = hands.Options(steps=4, handedness_weight=weight, virtual_hands=0)
    model, _ = hands.train(Path("unused"), ["kinivi"], options)
    losses = model.provenance.get("layout_loss", {"handedness_weight": 0.0})
    assert losses["handedness_weight"] == weight
    assert not losses.get("bone_length_weight")


def test_the_last_step_learns_from_virtual_and_detected_hands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = np.random.default_rng(0).standard_normal((60, 21, 2)).astype(np.float32)
    monkeypatch.setattr(hands, "collection", lambda folder, name: points)
    options = hands.Options(steps=4, virtual_hands=0)
    detected, _ = hands.train(Path("unused"), ["kinivi"], options)
    file = tmp_path / "hands.safetensors"
    save_model(file, detected)
    options = hands.Options(virtual_hands=90, network_of=str(file))
    model, _ = hands.train(Path("unused"), ["kinivi"], options)
    np.testing.assert_array_equal(model.network.L, detected.network.L)
    for (_, weight), (_, kept) in zip(
        model.network.trainable_weights(), detected.network.trainable_weights(), strict=True
    ):
        np.testing.assert_array_equal(weight, kept)
    assert not np.allclose(model.bone_lengths, detected.bone_lengths, rtol=0.05)
    assert model.provenance["step"] == 4
    assert model.provenance["last_step"]["frames"] == 90 + 30
    assert "30 detected" in model.provenance["last_step"]["data"]


def test_a_hidden_keypoint_is_expected_where_the_model_lifts_it() -> None:
    model = load_model("hand21")
    virtual = virtual_hands(40, 5).points
    exact = hands.hidden_keypoint_error(model, virtual)
    assert 0 < exact < 30
    moved = virtual.copy()
    moved[:, ::4] += 50  # each fourth keypoint is elsewhere, so none is where the others tell
    assert hands.hidden_keypoint_error(model, moved) > 2 * exact
    assert hands.hidden_keypoint_error(model, 7 * virtual + 300) == pytest.approx(exact, rel=1e-3)
