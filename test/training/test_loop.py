# SPDX-License-Identifier: Apache-2.0
"""Training learns a non-rigid object from 2D alone, and stops, goes on and fails as it should."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.nrsfm.geometry import align
from deep_nrsfm_ros.nrsfm.handedness import votes
from deep_nrsfm_ros.nrsfm.metrics import shape_errors
from deep_nrsfm_ros.nrsfm.network import Architecture
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import Preset, Recipe
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.learning_rate import learning_rate
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.loop import Callbacks, train
from deep_nrsfm_ros.training.mirror import TOLERATED, MirrorCheck
from deep_nrsfm_ros.training.progress import Progress
from deep_nrsfm_ros.training.trainer import Trainer
from test.fixtures.training_options import by_dataclass

SMALL = Preset(
    Architecture(widths=(8, 4)),
    Normaliser(),
    Recipe(steps=12, batch=16, added_noise=0.1, mask=0.2, seeds=1),
)
SCREENED = {"steps": 40, "seeds": 3, "screening": 4}
FRAMES = 200
"""Of the object's frames: steps, stops and checkpoints do not depend on how many there are."""


def small(**changes: Any) -> Preset:
    return SMALL._replace(recipe=dataclasses.replace(SMALL.recipe, **changes))


def run(figure: Any, preset: Preset = SMALL, **how: Any) -> Trainer:
    points = figure.points[:FRAMES]
    return train(points, np.ones(points.shape[:2], bool), preset, **by_dataclass(**how))


def stop_after(steps: int) -> Any:
    """Return a `should_stop` that lets a training take so many steps."""
    calls = iter(range(10**6))
    return lambda: next(calls) >= steps


def weights(trainer: Trainer) -> dict[str, np.ndarray]:
    return {name: w.numpy().copy() for name, w in trainer.net.named_weights()}


def assert_same(a: Trainer, b: Trainer) -> None:
    assert a.step == b.step
    for name, weight in weights(a).items():
        np.testing.assert_array_equal(weight, weights(b)[name], err_msg=name)


def test_a_low_rank_object_is_recovered(figure: Any, trained: Trainer) -> None:
    model = finish(trained, "figure", figure.layout, "test")
    confidence = np.ones(figure.points.shape[:2], np.float32)
    for correction, bound in (("none", 0.08), ("back_projection", 0.06), ("learned", 0.06)):
        lifter = Lifter(model, LiftingOptions(correction=correction))
        lifted = lifter(figure.points, confidence)
        errors = shape_errors(lifted.shapes, figure.shapes)
        assert errors.shape < bound
        assert errors.proper < bound and errors.mirrored < 0.01
    # The bound means something: the best single shape is far off, given the 3D truth.
    mean = align(figure.shapes, figure.shapes[:1]).aligned.mean(0)
    assert shape_errors(np.tile(mean, (len(figure.shapes), 1, 1)), figure.shapes).shape > 0.2
    # The right way round, and object axes x front, y left, z up.
    in_object_axes = lifted.shapes @ lifted.rotations
    assert (votes(in_object_axes, figure.layout) > 0).mean() > 0.99
    left, right, up, front = in_object_axes.mean(0)[:4]
    assert left[1] > 0 > right[1] and up[2] > 0 and front[0] > 0
    # And the cameras are those that took the pictures, up to one turn of the object axes.
    true = np.concatenate(
        [figure.cameras, np.cross(*figure.cameras.transpose(2, 0, 1))[..., None]], 2
    )
    off = lifted.rotations.swapaxes(1, 2) @ true.swapaxes(1, 2)
    U, _, Vt = np.linalg.svd(off.mean(0))
    angle = np.degrees(np.arccos(np.clip((np.einsum("fij,ij->f", off, U @ Vt) - 1) / 2, -1, 1)))
    assert np.median(angle) < 6


def test_the_result_says_how_it_came_about(figure: Any, trained: Trainer) -> None:
    model = finish(trained, "figure", figure.layout, "my data")
    assert model.provenance["data"] == "my data" and model.provenance["step"] == 800
    assert model.provenance["frames"] == 2000
    quality = model.quality
    assert 0 < quality["reprojection_error"] < 0.1 and 0 < quality["cycle_error"] < 0.1
    combined = np.hypot(quality["reprojection_error"], quality["cycle_error"])
    assert quality["combined"] == pytest.approx(combined, abs=1e-4)
    assert 0 < quality["coherence"] <= 1


@pytest.mark.parametrize("camera", ["orthonormal", "free"])
@pytest.mark.parametrize("recovery", ["learned", "closed_form"])
@pytest.mark.parametrize("threshold", ["relu", "block"])
def test_every_architecture_trains(figure: Any, threshold: str, recovery: str, camera: str) -> None:
    architecture = Architecture((16, 8), threshold, recovery, camera)
    recipe = Recipe(steps=80, batch=16, learning_rate=3e-2)
    data = figure.points[:64], np.ones((64, 12), bool)
    before = train(
        *data,
        Preset(architecture, Normaliser(), recipe),
        callbacks=Callbacks(should_stop=lambda: True),
    )
    after = train(*data, Preset(architecture, Normaliser(), recipe))
    assert sum(after.measure()) < 0.9 * sum(before.measure())


@pytest.mark.parametrize("stops", [1, 5, 11])
def test_going_on_from_a_checkpoint_is_as_if_it_had_never_stopped(
    figure: Any, tmp_path: Path, stops: int
) -> None:
    file = tmp_path / "checkpoint"
    stopped = run(figure, file=file, should_stop=stop_after(stops))
    assert stopped.step == stops and file.exists()
    assert_same(run(figure, file=file), run(figure))
    assert [f.name for f in tmp_path.iterdir()] == ["checkpoint"]


def test_checkpoints_are_written_on_the_way(figure: Any, tmp_path: Path) -> None:
    file = tmp_path / "checkpoint"
    run(figure, file=file, seconds=0.0)
    assert int(load_file(file)["step"]) == 12


def test_a_checkpoint_keeps_the_seed_that_was_chosen(figure: Any, tmp_path: Path) -> None:
    preset, file = small(**SCREENED, seed=7), tmp_path / "checkpoint"
    whole = run(figure, preset)
    # 3 x (4 steps and a look), one look after the screening, then 2 steps.
    stopped = run(figure, preset, file=file, should_stop=stop_after(3 * 5 + 1 + 2))
    assert 4 < stopped.step < 12 and stopped.seed == whole.seed
    assert_same(run(figure, preset, file=file), whole)


def test_stopping_returns_at_once(figure: Any) -> None:
    reports: list[Progress] = []
    trainer = run(figure, should_stop=lambda: True, on_progress=reports.append)
    assert trainer.step == 0
    assert [r.step for r in reports] == [0]
    model = finish(trainer, "early", figure.layout, "test")
    assert np.isfinite(Lifter(model)(figure.points[:5], np.ones((5, 12), np.float32)).shapes).all()


@pytest.mark.parametrize("stops", [2, 4, 6, 8, 11, 12])
def test_a_stopped_screening_keeps_the_best_so_far_and_goes_on(
    figure: Any, tmp_path: Path, stops: int
) -> None:
    preset, file = small(**SCREENED, seed=7), tmp_path / "checkpoint"
    stopped = run(figure, preset, file=file, should_stop=stop_after(stops))
    assert stopped.step == (stops if stops < 4 else 4) and not stopped.end_reason
    assert stopped.seed in range(21, 21 + max(stops // 4, 1))
    went_on = run(figure, preset, file=file)
    assert_same(went_on, run(figure, preset))
    assert went_on.end_reason


def test_a_crash_in_the_screening_loses_one_interval(figure: Any, tmp_path: Path) -> None:
    preset, file = small(**SCREENED), tmp_path / "checkpoint"
    steps = iter(range(10**6))

    def crash() -> bool:
        if next(steps) == 6:
            raise InterruptedError
        return False

    with pytest.raises(InterruptedError):
        run(figure, preset, file=file, seconds=0.0, should_stop=crash)
    saved = load_file(file)
    assert (int(saved["seed"]), int(saved["step"]), int(saved["leader.seed"])) == (1, 2, 0)
    assert_same(run(figure, preset, file=file), run(figure, preset))


def test_a_screening_of_other_seeds_is_refused(figure: Any, tmp_path: Path) -> None:
    file = tmp_path / "checkpoint"
    run(figure, small(**SCREENED), file=file, should_stop=stop_after(6))
    for other in (small(**SCREENED | {"seeds": 1}), small(**SCREENED, seed=5)):
        with pytest.raises(ValueError, match="other seeds"):
            run(figure, other, file=file)


def test_stopping_before_anything_is_learned_leaves_no_checkpoint(
    figure: Any, tmp_path: Path
) -> None:
    run(figure, file=tmp_path / "checkpoint", should_stop=lambda: True)
    assert not list(tmp_path.iterdir())


def test_screening_goes_on_with_the_lowest_cycle_error_and_mirrored_share(figure: Any) -> None:
    points = figure.points[:FRAMES]
    frames = FrameStore.of(points, np.ones(points.shape[:2], bool))
    chosen = set()
    for seed in (3, 6):
        preset = small(**SCREENED, seed=seed)
        cycle = {}
        for candidate in range(3 * seed, 3 * seed + 3):
            trainer = Trainer(frames, preset, candidate)
            for _ in range(4):
                trainer.advance()
            mirrored = MirrorCheck(frames, preset.normaliser, 1000).share(trainer.net)
            assert mirrored > TOLERATED  # or it would have no rivals
            cycle[candidate] = trainer.measure()[1] + mirrored
        best = min(cycle, key=lambda candidate: cycle[candidate])
        assert run(figure, preset).seed == best
        assert_same(run(figure, preset), run(figure, small(steps=40, seed=best)))
        chosen.add(best % 3)
    assert len(chosen) > 1


def test_screening_takes_a_tenth_of_a_short_training(figure: Any) -> None:
    seen: list[tuple[int, int]] = []
    for screening in (1000, 2):
        run(
            figure,
            small(steps=20, seeds=2, screening=screening),
            on_step=lambda trainer: seen.append((trainer.seed, trainer.step)),
        )
        assert [step for _, step in seen] == list(range(2, 21))
        assert len({seed for seed, _ in seen}) == 1
        seen.clear()


def test_the_same_seed_is_the_same_training_and_another_is_not(figure: Any) -> None:
    first = run(figure)
    assert_same(first, run(figure))
    other = weights(run(figure, small(seed=1)))
    assert any(not np.array_equal(w, other[name]) for name, w in weights(first).items())


def test_progress_ends_at_the_last_step(figure: Any) -> None:
    reports: list[Progress] = []
    trainer = run(figure, on_progress=reports.append)
    last = reports[-1]
    assert (last.step, last.steps, last.seed, last.seconds_left) == (12, 12, 0, 0)
    assert (last.loss, last.cycle_error) == trainer.measure()


def damage(kind: str, file: Path) -> None:
    if kind == "random":
        file.write_bytes(np.random.default_rng(0).bytes(5000))
    elif kind == "cut":
        file.write_bytes(file.read_bytes()[:-100])
    elif kind == "folder":
        file.unlink()
        file.mkdir()
    else:
        tensors = load_file(file)
        if kind == "stranger":
            tensors = {"weight": torch.ones(3)}
        elif kind == "other network":
            tensors["weights"] = torch.ones(8, 5)
        else:
            del tensors["weights"]
        save_file(tensors, file)


@pytest.mark.parametrize(
    "kind", ["random", "cut", "folder", "stranger", "other network", "no weights"]
)
def test_a_damaged_checkpoint_is_refused(figure: Any, tmp_path: Path, kind: str) -> None:
    file = tmp_path / "checkpoint"
    run(figure, file=file, should_stop=stop_after(3))
    damage(kind, file)
    with pytest.raises(ValueError, match="checkpoint"):
        run(figure, file=file)


@pytest.mark.parametrize("changes", [{"steps": 0}, {"mask": 0.95}, {"schedule": "linear"}])
def test_options_out_of_range_are_refused(figure: Any, changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(changes))):
        run(figure, small(**changes))


def test_data_without_anything_to_learn_from_are_refused(figure: Any) -> None:
    points, visible = figure.points[:50], np.ones((50, 12), bool)
    for nothing in (
        (points[:0], visible[:0]),
        (points, np.zeros_like(visible)),
        (points, visible & (np.arange(12) == 3)),
        (np.full_like(points, 7.1), visible),
    ):
        with pytest.raises(ValueError, match=rf"none of the {len(nothing[0])} frames"):
            train(nothing[0], nothing[1], SMALL)


def test_frames_without_extent_are_left_out(figure: Any) -> None:
    points = figure.points[:FRAMES].copy()
    visible = np.ones(points.shape[:2], bool)
    points[5:8] = 3.3
    visible[9, 1:] = False
    kept = np.delete(np.arange(len(points)), [5, 6, 7, 9])
    assert_same(train(points, visible, SMALL), train(points[kept], visible[kept], SMALL))


def test_what_a_missing_point_holds_does_not_matter(figure: Any) -> None:
    points = figure.points[:FRAMES]
    visible = np.random.default_rng(0).random(points.shape[:2]) < 0.7
    garbage = np.where(visible[..., None], points, np.nan)
    assert_same(train(garbage, visible, SMALL), train(points, visible, SMALL))


@pytest.fixture
def second_a_step(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Make the clock go by one second a step; return the learning rates used."""
    rates: list[float] = []
    advance = Trainer.advance

    def timed(trainer: Trainer) -> None:
        advance(trainer)
        rates.append(trainer.optimiser.learning_rate)

    monkeypatch.setattr(Trainer, "advance", timed)
    monkeypatch.setattr(time, "monotonic", lambda: float(len(rates)))
    return rates


def test_the_learning_rate_ends_with_the_time(figure: Any, second_a_step: list[float]) -> None:
    reports: list[Progress] = []
    trainer = run(figure, small(steps=1000), limits=Limits(minutes=0.5), on_progress=reports.append)
    assert (trainer.step, trainer.end_reason) == (30, "its time was up")
    cosine = Recipe(steps=30, learning_rate=SMALL.recipe.learning_rate)
    assert second_a_step == pytest.approx([learning_rate(cosine, step) for step in range(30)])
    early, last = reports[1], reports[-1]
    assert early.seconds_left == 30 - early.step > 0 == last.seconds_left
    assert {report.steps for report in reports} == {30}


def test_steps_may_end_before_the_time(figure: Any, second_a_step: list[float]) -> None:
    trainer = run(figure, limits=Limits(minutes=0.5))
    assert (trainer.step, trainer.end_reason) == (12, "all steps were taken")
    assert second_a_step == pytest.approx([learning_rate(SMALL.recipe, i) for i in range(12)])


def test_time_that_is_gone_stays_gone(
    figure: Any, tmp_path: Path, second_a_step: list[float]
) -> None:
    how = {"limits": Limits(minutes=0.5), "file": tmp_path / "checkpoint"}
    assert run(figure, small(steps=1000), **how, should_stop=stop_after(12)).step == 12
    assert run(figure, small(steps=1000), **how).step == 30


def test_the_screening_takes_a_tenth_of_the_time(figure: Any, second_a_step: list[float]) -> None:
    preset = small(steps=100_000, seeds=3, screening=1000, few_frames=0)
    seen: list[int] = []
    trainer = run(
        figure,
        preset,
        limits=Limits(minutes=1.05),
        on_step=lambda trainer: seen.append(trainer.step),
    )
    assert len(second_a_step) == 63 and seen[0] in (2, 3)
    assert trainer.step == 63 - 7 + seen[0]  # 6.3 s are over after the seventh step
    # There is no time so short that nothing is learned.
    assert run(figure, preset, limits=Limits(minutes=1e-9)).step == 1
