# SPDX-License-Identifier: Apache-2.0
"""A training that starts from a model starts as good as it, and ends better on new data."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.geometry import reprojection_error
from deep_nrsfm_ros.nrsfm.network import Architecture, Network, forward, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import Preset, Recipe
from deep_nrsfm_ros.training.fine_tuning import check_fixed_options, inherit, start_from
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.loop import Callbacks, train
from deep_nrsfm_ros.training.progress import Progress
from deep_nrsfm_ros.training.setup import Setup
from deep_nrsfm_ros.training.trainer import Trainer

RECIPE = Recipe(steps=100, batch=64, learning_rate=1e-3, start_share=0.0)
LIGHT = "light"  # a keypoint that no model knows


@pytest.fixture(scope="module")
def source(trained: Trainer, figure: Any) -> Model:
    return finish(trained, "source", figure.layout, "old data")


@pytest.fixture(scope="module")
def stretched(figure: Any) -> np.ndarray:
    """Points (1000, 12, 2) of a figure of other proportions than the model was trained on."""
    return (
        (figure.shapes[:1000] * np.array([1.4, 1, 0.7], np.float32)) @ figure.cameras[:1000]
    ).astype("f4")


def tuned(
    source: Model,
    layout: KeypointLayout,
    points: np.ndarray,
    steps: int = 100,
    recipe: Recipe = RECIPE,
) -> Trainer:
    preset = Preset(source.network.architecture, source.normaliser, recipe)
    calls = iter(range(10**6))
    return train(
        np.ascontiguousarray(points),
        np.ones(points.shape[:2], bool),
        preset,
        Setup(start=start_from(source, layout)),
        Callbacks(should_stop=lambda: next(calls) >= steps),
    )


def error(net: Network, points: np.ndarray) -> float:
    """Return the mean reprojection error of the network alone."""
    points = points - points.mean(1, keepdims=True)
    W = Normaliser().encode(points, np.ones((*points.shape[:2], 1), np.float32)).W
    S, M = forward(net, W)
    return float(reprojection_error(W, S @ M, np.ones(W.shape[:2], bool)).mean())


def learned(trainer: Trainer) -> Network:
    return trainer.net.map(lambda w: w.numpy())


def test_with_the_same_keypoints_it_starts_as_good_as_its_source(
    source: Model, figure: Any, stretched: np.ndarray
) -> None:
    start = tuned(source, figure.layout, stretched, steps=0)
    for (name, weight), (_, old) in zip(
        start.net.named_weights(), source.network.named_weights(), strict=True
    ):
        np.testing.assert_array_equal(weight.numpy(), old, err_msg=name)
    on_new_data = Trainer(start.frames, start.preset, 0, Setup(source.network))
    assert start.measure() == on_new_data.measure()


def test_it_ends_better_on_the_new_data_than_its_source(
    source: Model, figure: Any, stretched: np.ndarray
) -> None:
    before, after = (tuned(source, figure.layout, stretched, steps) for steps in (0, 100))
    assert sum(after.measure()) < 0.7 * sum(before.measure())
    assert error(learned(after), stretched) < 0.7 * error(source.network, stretched)
    fresh = train(stretched, np.ones(stretched.shape[:2], bool), after.preset)
    assert sum(after.measure()) < sum(fresh.measure())


def test_the_result_is_the_mean_of_start_and_trained_weights(
    source: Model, figure: Any, stretched: np.ndarray
) -> None:
    shares = (0.0, 0.25, 1.0)
    recipes = [dataclasses.replace(RECIPE, start_share=share) for share in shares]
    trained, mixed, same = (
        tuned(source, figure.layout, stretched, 3, recipe).weights for recipe in recipes
    )
    assert not np.allclose(trained, same)
    np.testing.assert_allclose(mixed, 0.75 * trained + 0.25 * same, atol=1e-6)
    start = tuned(source, figure.layout, stretched, 0)
    np.testing.assert_array_equal(same, start.weights)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_figures_end_with_the_trained_weights_and_a_sentence_gives_those_of_the_mean(
    source: Model, figure: Any, stretched: np.ndarray, share: float
) -> None:
    reports: list[Progress] = []
    said: list[str] = []
    recipe = dataclasses.replace(RECIPE, start_share=share, steps=20)
    visible = np.ones(stretched.shape[:2], bool)
    setup = Setup(start=start_from(source, figure.layout))
    callbacks = Callbacks(on_progress=reports.append, on_message=said.append)
    preset = Preset(source.network.architecture, source.normaliser, recipe)
    trainer = train(stretched, visible, preset, setup, callbacks)
    last, model = reports[-1], trainer.measure()
    assert ((last.loss, last.cycle_error) == model) == (share == 0)
    before, after = (f"{math.hypot(*each):.3f}" for each in ((last.loss, last.cycle_error), model))
    means = [text for text in said if "the mean of its start" in text]
    assert len(means) == (share > 0)
    assert all(f"combined is {after} " in text and f"was {before} " in text for text in means)


def test_a_start_with_other_keypoints_has_no_share_in_the_result(
    source: Model, figure: Any
) -> None:
    layout = KeypointLayout("part", figure.layout.keypoints[:8])
    points = figure.points[:200, :8]
    trained, mixed = (
        tuned(source, layout, points, 3, dataclasses.replace(RECIPE, start_share=share)).weights
        for share in (0.0, 0.5)
    )
    np.testing.assert_array_equal(trained, mixed)


def test_the_order_of_the_keypoints_does_not_matter(source: Model, figure: Any) -> None:
    order = np.random.default_rng(0).permutation(12)
    layout = KeypointLayout("other", tuple(figure.layout.keypoints[i] for i in order))
    net, points = start_from(source, layout), figure.points[:20]
    S, M = forward(source.network, points)
    shuffled, camera = forward(net, points[:, order])
    np.testing.assert_allclose(shuffled, S[:, order], atol=1e-4)
    np.testing.assert_allclose(camera, M, atol=1e-4)
    np.testing.assert_allclose(net.L @ net.L_inverse, np.eye(12), atol=1e-3)


@pytest.mark.parametrize("kept", [8, 12])
def test_other_keypoints_are_matched_by_name_and_new_ones_learned(
    source: Model, figure: Any, kept: int
) -> None:
    names = (LIGHT, *figure.layout.keypoints[12 - kept :])
    layout = KeypointLayout("other", names)
    light = figure.points[:, :1] * 0.5 + figure.points[:, 3:4] * 0.5  # fixed to two of the points
    points = np.concatenate([light, figure.points[:, 12 - kept :]], 1)
    net = start_from(source, layout)
    np.testing.assert_array_equal(net.D[0][1:], source.network.D[0][12 - kept :])
    assert not net.D[0][0].any() and not net.b_[0][0].any()
    start, end = (tuned(source, layout, points, steps) for steps in (0, 100))
    assert not np.array_equal(start.net.L.numpy(), np.eye(kept + 1))  # whitened by the new data
    fresh = train(points, np.ones(points.shape[:2], bool), end.preset)
    assert sum(end.measure()) < 0.6 * sum(start.measure())
    assert sum(end.measure()) < 0.7 * sum(fresh.measure())


def test_a_network_that_is_not_whitened_is_taken_as_it_is(figure: Any) -> None:
    architecture = Architecture(widths=(8, 4), whitening=0.0)
    network = initialise(architecture, 12, np.random.default_rng(0))
    frame = np.eye(3, dtype=np.float32)
    plain = Model("plain", network, figure.layout, Normaliser(), frame)
    net = tuned(plain, figure.layout, figure.points, steps=0).net
    np.testing.assert_array_equal(net.L.numpy(), np.eye(12))


def test_strangers_are_refused(source: Model, figure: Any) -> None:
    three = KeypointLayout("stranger", (*figure.layout.keypoints[:3], "a", "b"))
    with pytest.raises(ValueError, match="'source' and layout 'stranger' share 3 keypoints"):
        start_from(source, three)


@pytest.mark.parametrize(
    ("part", "changes", "complaint"),
    [
        ("architecture", {"widths": (64, 32)}, r"widths is \(64, 32\); model 'source'"),
        ("architecture", {"whitening": 0.5}, "whitening is 0.5; .* has 1.0: leave"),
        ("normaliser", {"scale": "none"}, "scale is none"),
        ("recipe", {"steps": 5}, ""),
    ],
)
def test_what_the_model_has_fixed_cannot_be_chosen_anew(
    source: Model, part: str, changes: dict[str, Any], complaint: str
) -> None:
    preset = Preset(source.network.architecture, source.normaliser, RECIPE)
    check_fixed_options(source, preset)
    preset = preset._replace(**{part: dataclasses.replace(getattr(preset, part), **changes)})
    if complaint:
        with pytest.raises(ValueError, match=complaint):
            check_fixed_options(source, preset)
    else:
        check_fixed_options(source, preset)


def test_it_inherits_its_origin_and_the_axes_that_it_cannot_find(
    source: Model, figure: Any
) -> None:
    mirrored = np.diag([1, 1, -1]).astype(np.float32)
    start = dataclasses.replace(source, object_frame=mirrored)
    trainer = tuned(source, figure.layout, figure.points, steps=0)
    nameless = KeypointLayout("nameless", figure.layout.keypoints)
    found, unknown = (
        inherit(finish(trainer, "new", layout, "new data"), start)
        for layout in (figure.layout, nameless)
    )
    assert found.provenance["from"] == {"model": "source", "data": "old data"}
    assert found.provenance["data"] == "new data"
    np.testing.assert_allclose(found.object_frame, source.object_frame, atol=0.1)
    np.testing.assert_array_equal(unknown.object_frame, mirrored)


def test_bones_of_many_people_are_kept_by_a_training_on_few_views(
    source: Model, figure: Any
) -> None:
    names = figure.layout.keypoints
    layout = dataclasses.replace(figure.layout, edges=tuple((names[0], n) for n in names[1:5]))
    lengths = np.full((len(layout.bone_indices()), 2), 0.25, np.float32)
    correlation = np.eye(len(lengths), dtype=np.float32)
    people = dataclasses.replace(
        source, layout=layout, bone_lengths=lengths, bone_correlation=correlation
    )
    one = dataclasses.replace(people, bone_correlation=np.zeros((0, 0), np.float32))
    trainer = tuned(source, figure.layout, figure.points, steps=1)
    trained = finish(trainer, "new", layout, "new data")
    kept = inherit(trained, people)
    np.testing.assert_array_equal(kept.bone_lengths, lengths)
    np.testing.assert_array_equal(kept.bone_correlation, correlation)
    np.testing.assert_array_equal(kept.error_covariance, trained.error_covariance)
    assert kept.provenance["from"]["bones"] == "kept"
    nameless = finish(trainer, "new", figure.layout, "new data")  # it has no edges
    for model, own in ((inherit(trained, one), trained), (inherit(nameless, people), nameless)):
        np.testing.assert_array_equal(model.bone_lengths, own.bone_lengths)
        assert "bones" not in model.provenance["from"]


def test_errors_of_keypoints_that_no_frame_shows_are_those_that_the_start_knows(
    source: Model, figure: Any
) -> None:
    points = np.ascontiguousarray(figure.points[:300])
    for hidden, share, kept in ((0, 0.6, False), (4, 0.6, True), (4, 0.0, False)):
        recipe = dataclasses.replace(RECIPE, steps=2, start_share=share)
        preset = Preset(source.network.architecture, source.normaliser, recipe)
        visible = np.ones(points.shape[:2], bool)
        visible[:, :hidden] = False
        trainer = train(points, visible, preset, Setup(start_from(source, figure.layout)))
        trained = finish(trainer, "new", figure.layout, "data")
        rare = list(figure.layout.keypoints[:hidden])
        assert trained.provenance.get("rarely_shown", []) == rare
        model = inherit(trained, source)
        is_same = np.array_equal(model.error_covariance, source.error_covariance)
        assert is_same == kept == ("error_covariance" in model.provenance["from"])


def test_no_steps_keep_the_network_and_learn_the_last_step_from_other_people(
    source: Model, figure: Any
) -> None:
    recipe = dataclasses.replace(RECIPE, steps=0)
    preset = Preset(source.network.architecture, source.normaliser, recipe)
    visible = np.ones(figure.points.shape[:2], bool)
    trainer = train(figure.points, visible, preset, Setup(start_from(source, figure.layout)))
    assert trainer.step == 0 and trainer.progress == 0
    people = Dataset(figure.points[::2].copy(), visible[::2], figure.layout, "people")
    model = inherit(finish(trainer, "new", figure.layout, "data", people), source)
    for (name, kept), (_, given) in zip(
        model.network.named_weights(), source.network.named_weights(), strict=True
    ):
        np.testing.assert_array_equal(kept, given, err_msg=name)
    assert model.provenance["last_step"] == {"data": "people", "frames": len(people)}
    assert model.provenance["from"]["recipe"] == source.provenance["recipe"]
    assert model.bone_correlation.shape == (len(model.bone_lengths),) * 2
    assert not np.array_equal(model.error_covariance, source.error_covariance)


def test_a_checkpoint_is_not_taken_on_by_a_training_that_starts_elsewhere(
    source: Model, figure: Any, stretched: np.ndarray
) -> None:
    trainer = tuned(source, figure.layout, stretched, steps=2)
    fresh = Trainer(trainer.frames, trainer.preset, 0)
    with pytest.raises(ValueError, match="checkpoint is of other data or another model"):
        fresh.restore(trainer.state())
    again = Trainer(trainer.frames, trainer.preset, 0, Setup(start_from(source, figure.layout)))
    again.restore(trainer.state())
    assert again.step == 2
