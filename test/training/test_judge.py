# SPDX-License-Identifier: Apache-2.0
"""The judge: a worse model is doubted with its reason, a better one is not; no label is used."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.held_out import Split, split
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HAND21, HUMAN25
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.sanity import Finding
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.network import initialise
from deep_nrsfm_ros.training.data_check import SourceFinding
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.judge import (
    Figures,
    Judge,
    _fronts_in_words,
    judge,
    percent,
    rank,
    standings,
    worse_figures,
)
from deep_nrsfm_ros.training.learned_frames import LEARNED_FRAMES, frame_marks, marks_in_words
from deep_nrsfm_ros.training.trainer import Trainer

GOOD = Figures(
    image_error=0.05,
    bone_variation=0.04,
    mirrored_share=0.0,
    front_disagreement=0.0,
    opposed=0.0,
    side_difference=0.1,
    flatness=0.8,
    difference=0.0,
)


def with_bones(layout: KeypointLayout) -> KeypointLayout:
    names = layout.keypoints
    return dataclasses.replace(layout, edges=tuple((names[0], name) for name in names[1:6]))


@pytest.fixture(scope="module")
def frames(figure: Any) -> Split:
    points = figure.points[:600]
    visible = np.ones(points.shape[:2], bool)
    return split(Dataset(points, visible, with_bones(figure.layout), "test"), 0.1)


@pytest.fixture(scope="module")
def good(figure: Any, trained: Trainer) -> Model:
    model = finish(trained, "good", with_bones(figure.layout), "test")
    # As if it had learned other frames: it is the model at hand in most of the tests.
    provenance = {k: v for k, v in model.provenance.items() if k != LEARNED_FRAMES}
    return dataclasses.replace(model, provenance=provenance)


@pytest.fixture(scope="module")
def bad(good: Model) -> Model:
    network = initialise(good.network.architecture, len(good.layout), np.random.default_rng(0))
    return dataclasses.replace(good, name="bad", network=network)


def test_a_bad_model_is_doubted_and_told_what_would_help(
    frames: Split, good: Model, bad: Model
) -> None:
    judgement = judge(frames, bad, good)
    assert "Judged beside model 'good' on 60 held-out frames" in judgement.reason
    assert (
        "are mirrored against their neighbours" in judgement.reason
        and "(good: 0 %)" in judgement.reason
    )
    assert "would help" in judgement.reason and "--from" in judgement.reason
    assert str(judgement).startswith("the new model is doubtful: ")
    record = judgement.record()
    assert record["doubtful"] and record["rival"] == "good"
    assert record["figures"]["image_error"] > record["rival_figures"]["image_error"]


def test_time_would_help_a_model_whose_factorisations_were_cut_short(
    frames: Split, good: Model, bad: Model
) -> None:
    hurried = dataclasses.replace(
        bad, provenance=bad.provenance | {"factorisation_needs_minutes": 2.5}
    )
    advice = "more time (--minutes 2.5, train.minutes, or no limit), more views"
    assert advice in judge(frames, hurried, good).reason
    assert "more time" not in judge(frames, bad, good).reason


def test_a_model_as_good_is_not_doubted_nor_is_one_that_replaces_a_bad_one(
    frames: Split, good: Model, bad: Model
) -> None:
    for rival in (good, bad):
        judgement = judge(frames, good, rival)
        assert not judgement.doubtful and judgement.rival == rival.name
        verdict = "as_good" if rival is good else "better"
        assert judgement.record()["verdict"] == judgement.verdict == verdict
        than = "as good as" if rival is good else "better than"
        assert str(judgement).startswith(f"the new model is {than} model {rival.name!r}")
        assert "on 60 held-out frames, later ones that the new model was not trained on" in str(
            judgement
        )
        assert f"({rival.name}: " in str(judgement) and len(str(judgement)) < 520
        assert not judgement.record()["doubtful"]


def knowing(model: Model, data: Dataset) -> Model:
    """Return a model that has learned the frames of a dataset, as its provenance says."""
    marks = marks_in_words(frame_marks(data.points, data.visible))
    return dataclasses.replace(model, provenance=model.provenance | {LEARNED_FRAMES: marks})


def looser(model: Model, times: float) -> Model:
    """Return a model of the same shapes whose image error is larger by noise in its weights."""
    noise = np.random.default_rng(0)
    network = model.network.map(
        lambda w: w + np.float32(times * w.std()) * noise.normal(size=w.shape).astype(np.float32)
    )
    return dataclasses.replace(model, name="looser", network=network)


def test_a_model_is_not_doubtful_because_the_rival_has_learned_the_held_out_frames(
    frames: Split, good: Model, bad: Model
) -> None:
    new = looser(good, 0.02)
    assert judge(frames, new, good).doubtful
    rival = knowing(good, frames.held_out)
    judgement = judge(frames, new, rival)
    assert judgement.verdict == "unknown" and not judgement.doubtful
    assert str(judgement).startswith("the new model cannot be compared with model 'good', which ")
    said = (
        "Model 'good' was trained on these frames, so it is at an advantage; add a later recording"
    )
    assert said in str(judgement)
    assert judgement.record()["rival_has_learned_the_frames"]
    hopeless = judge(frames, bad, rival)
    assert hopeless.doubtful and said in str(hopeless)
    places = standings(frames, [new, bad], rival)
    assert [each.model.name for each in places] == ["good", "looser", "bad"]
    shown = {each.model.name: each for each in places}
    assert shown["looser"].verdict == "unknown" and shown["bad"].verdict == "doubtful"
    assert shown["good"].has_learned and not shown["looser"].has_learned


def test_files_of_the_same_names_are_said_where_the_frames_are_others(
    frames: Split, good: Model
) -> None:
    data = dataclasses.replace(frames.training, source="file cam0.npz; file cam1.npz")
    rival = dataclasses.replace(good, provenance=good.provenance | {"data": "file cam1.npz; bag x"})
    said = "model 'good' was trained on a file cam1.npz: if it has learned other frames"
    assert said in judge(Split(data, frames.held_out), looser(good, 0.02), rival).reason
    assert "if it has learned" not in judge(frames, looser(good, 0.02), rival).reason


def test_held_out_frames_that_the_rival_has_learned_do_not_count(
    frames: Split, good: Model
) -> None:
    known = frames.held_out[np.arange(30)]
    parts = Dataset(
        frames.held_out.points,
        frames.held_out.visible,
        frames.held_out.layout,
        "test",
        sequence_starts=np.array([0, 30]),
    )
    split_frames = Split(frames.training, parts)
    judgement = judge(split_frames, looser(good, 0.02), knowing(good, known))
    assert judgement.doubtful  # on the others the rival has no advantage
    assert "on 30 held-out frames" in judgement.reason
    assert "(not on 30 others, which model 'good' was trained on)" in judgement.reason


def test_the_error_on_new_frames_stands_beside_that_on_learned_ones(
    frames: Split, good: Model, bad: Model
) -> None:
    judgement = judge(frames, good, None)
    learned = judgement.figures.learned_image_error
    assert learned == pytest.approx(judgement.figures.image_error, rel=0.3)
    assert f", {percent(learned)} on the frames of its training" in str(judgement)
    nothing_held_out = judge(Split(frames.training, frames.training), good, None)
    assert math.isnan(nothing_held_out.figures.learned_image_error)
    assert "on the frames of its training, bone" not in str(nothing_held_out)


def test_a_model_that_fits_badly_is_not_silently_alone(
    frames: Split, good: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    from deep_nrsfm_ros.training import judge as module

    residual = judge(frames, good, None).figures.image_error
    monkeypatch.setattr(module, "LARGE_IMAGE_ERROR", residual * 0.9)
    judgement = judge(frames, good, None)
    assert judgement.verdict == "alone" and judgement.record()["fits_badly"]
    assert "fits new frames badly: an image error of" in str(judgement)
    assert "more views" in str(judgement)
    monkeypatch.setattr(module, "LARGE_LEARNED_IMAGE_ERROR", residual * 0.5)
    nothing_held_out = judge(Split(frames.training, frames.training), good, None)
    assert "fits the frames of its training badly" in str(nothing_held_out)


def test_a_front_alone_is_weak_evidence(
    frames: Split, good: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    from deep_nrsfm_ros.training import judge as module

    monkeypatch.setattr(module, "MIN_TESTED", 1.1)  # no frame has enough neighbours
    alone = judge(frames, good, None)
    assert not alone.doubtful and math.isnan(alone.figures.mirrored_share)
    headline = (
        "the new model has no other to compare with, and only the front that its layout names "
        "tells of mirrored frames, which is weak evidence: "
    )
    assert str(alone).startswith(headline)
    assert "weak evidence: too few" not in str(judge(frames, good, good))


def test_mirrored_frames_are_seen_without_another_model(
    frames: Split, good: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    from deep_nrsfm_ros.training import judge as module

    alone = judge(frames, good, None)
    assert not alone.doubtful and alone.verdict == "alone"
    assert str(alone).startswith("the new model has no other to compare with: nothing shows")
    lift = module._lift

    def half_mirrored(model: Model, data: Dataset, options: LiftingOptions) -> Any:
        S, residual, visible = lift(model, data, options)
        far = data.points[:, 4, 0] > np.quantile(data.points[:, 4, 0], 0.7)
        S[far] *= [1, 1, -1]
        return S, residual, visible

    monkeypatch.setattr(module, "_lift", half_mirrored)
    mirrored = judge(frames, good, None)
    assert mirrored.figures.mirrored_share == pytest.approx(0.3, abs=0.05)
    assert "of its frames are mirrored" in mirrored.reason


def test_figures_follow_names_not_places(frames: Split, good: Model) -> None:
    shuffled = np.random.default_rng(0).permutation(len(good.layout))
    layout = dataclasses.replace(
        frames.held_out.layout,
        keypoints=tuple(frames.held_out.layout.keypoints[i] for i in shuffled),
    )
    other = Split(
        *(
            Dataset(part.points[:, shuffled], part.visible[:, shuffled], layout, "test")
            for part in frames
        )
    )
    expected, found = Judge(frames).figures(good), Judge(other).figures(good)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


def test_a_rival_of_another_object_is_none(frames: Split, good: Model) -> None:
    names = tuple(f"other_{i}" for i in range(len(good.layout)))
    stranger = dataclasses.replace(good, layout=KeypointLayout("other", names))
    judgement = judge(frames, good, stranger)
    assert judgement.rival == "" and not judgement.doubtful
    lost = judge(frames, stranger, None)  # the training that made it is not lost by it
    assert "keypoints" in lost.reason and lost.record()["figures"] == {}


@pytest.mark.parametrize(
    ("change", "worse"),
    [
        ({}, []),
        ({"image_error": 0.051}, []),  # alike
        ({"image_error": 0.053}, ["misfit"]),
        ({"image_error": 0.04, "bone_variation": 0.049}, []),
        ({"image_error": 0.04, "bone_variation": 0.053}, ["misfit"]),
        ({"image_error": 0.0, "bone_variation": 0.11}, ["bone_variation", "misfit"]),
        ({"mirrored_share": 0.01}, ["mirrored_share"]),
        ({"mirrored_share": math.nan, "front_disagreement": math.nan}, []),
        ({"bone_variation": math.nan}, []),
        ({"front_disagreement": 0.2, "opposed": 0.3}, ["front_disagreement"]),
        ({"image_error": 0.01, "opposed": 0.06}, ["opposed"]),
        ({"image_error": 0.09, "opposed": 0.3, "bone_variation": 0.01}, []),  # the other is folded
        ({"image_error": 0.01, "opposed": 0.04}, []),
        ({"image_error": 0.01, "turned": 0.006}, ["turned"]),  # no frame of a start should be
        ({"image_error": 0.01, "turned": 0.004}, []),
        ({"image_error": 0.01, "turned": 0.006, "bone_variation": 0.01}, ["turned"]),
        ({"side_difference": 9.0, "flatness": 0.0, "difference": 9.0}, []),
    ],
)
def test_the_rule(change: dict[str, float], worse: list[str]) -> None:
    assert worse_figures(GOOD._replace(**change), GOOD) == worse


@pytest.mark.parametrize(
    ("change", "worse"),
    [
        ({"opposed": 1.0, "bone_variation": 0.01}, ["opposed"]),  # steady bones do not tell whose
        ({"opposed": 0.5, "bone_variation": 0.01}, []),
        ({"opposed": 1.0, "mirrored_share": 0.0}, ["opposed"]),  # its neighbours are mirrored, too
        ({"opposed": 1.0, "front_disagreement": 0.2}, ["opposed"]),
        ({"opposed": 1.0, "turned": 1.0, "bone_variation": 0.01}, ["turned"]),
        ({"opposed": 0.0, "turned": 1.0, "bone_variation": 0.01}, ["turned"]),
    ],
)
def test_a_model_that_lifts_nearly_all_frames_to_the_mirror_image_is_never_better(
    change: dict[str, float], worse: list[str]
) -> None:
    at_hand = GOOD._replace(image_error=0.5, mirrored_share=0.3, front_disagreement=0.3)
    both = {"mirrored_share": 0.3, "front_disagreement": 0.3}
    assert worse_figures(GOOD._replace(**both | change), at_hand) == worse
    if "turned" in change:  # whatever else is said of the start
        assert worse_figures(GOOD._replace(**change), at_hand) == worse


def test_faults_of_the_data_make_a_model_doubtful(frames: Split, good: Model) -> None:
    upside_down = Finding("orientation", "98% of the people are upside down: y must point down")
    found = [SourceFinding("walk.npy", upside_down), SourceFinding("", Finding("stamps", "no"))]
    judgement, sound = judge(frames, good, good, found), judge(frames, good, good)
    assert judgement.doubtful and not judge(frames, good, good, found[1:]).doubtful
    fault = f"walk.npy: {upside_down}"
    assert str(judgement).startswith(
        f"the new model is doubtful: its data looks wrong: {fault}. Mend it and train again. Judged"
    )
    assert "would help" not in str(judgement)  # more frames of such data would not
    assert judgement.record()["faults"] == [fault]
    assert judgement.figures == sound.figures
    assert sound.shown in judgement.reason and "bone lengths vary by" in sound.shown
    # Whoever has read the warning needs no remedy any more.
    assert judgement.brief == (
        "the new model is doubtful: its data looks wrong: walk.npy: 98% of the people are upside "
        f"down. Mend it as the warnings say, and train again. {sound.shown}"
    )
    assert sound.brief == str(sound)


def test_the_mirror_image_of_a_mirrored_model_is_no_fault() -> None:
    turned = GOOD._replace(front_disagreement=0.9)
    assert worse_figures(GOOD._replace(opposed=0.95), turned) == []
    assert worse_figures(GOOD._replace(opposed=0.95), GOOD) == ["opposed"]
    assert worse_figures(GOOD._replace(mirrored_share=0.2), None) == ["mirrored_share"]
    assert worse_figures(GOOD._replace(mirrored_share=0.04), None) == []


def test_few_opposed_frames_do_not_change_the_order() -> None:
    assert rank(GOOD._replace(opposed=0.04), GOOD) == rank(GOOD._replace(), GOOD)
    assert rank(GOOD._replace(opposed=0.06), GOOD) > rank(GOOD._replace(), GOOD)


def test_models_that_are_better_come_before_the_one_at_hand() -> None:
    assert rank(GOOD._replace(image_error=0.051), GOOD) < rank(GOOD, GOOD)
    assert rank(GOOD._replace(image_error=0.053), GOOD) > rank(GOOD, GOOD)


def test_frames_that_a_training_has_turned_are_seen_beside_its_start_alone(
    frames: Split, good: Model
) -> None:
    tuned = dataclasses.replace(good, provenance=good.provenance | {"from": {"model": "good"}})
    comparison, other = Judge(frames), dataclasses.replace(good, name="other")
    assert comparison.figures(tuned, good).turned == 0
    mirrored = dataclasses.replace(good, object_frame=-good.object_frame, name="good")
    assert comparison.figures(tuned, mirrored).turned == 1
    assert math.isnan(comparison.figures(tuned, other).turned)
    assert math.isnan(comparison.figures(good, good).turned)


@pytest.mark.parametrize(("turned", "counted"), [(1, 0), (2, 2)])
def test_a_single_frame_that_is_turned_does_not_count(
    frames: Split, good: Model, monkeypatch: pytest.MonkeyPatch, turned: int, counted: int
) -> None:
    comparison = Judge(Split(frames.training, frames.held_out[:100]))
    lift = comparison._lift

    def some_mirrored(model: Model, **options: bool) -> Any:
        S, residual, visible = lift(model, **options)
        if model.name == "tuned" and options.get("corrected"):
            S = S.copy()
            S[:turned, :, 2] *= -1
        return S, residual, visible

    monkeypatch.setattr(comparison, "_lift", some_mirrored)
    tuned = dataclasses.replace(good, name="tuned")
    sound = np.isfinite(lift(good, corrected=True)[1]).sum()
    assert comparison._opposed(tuned, good, corrected=True) * sound == pytest.approx(counted)


def test_frames_that_the_start_mirrors_may_turn() -> None:
    start = GOOD._replace(mirrored_share=0.019)
    tuned = start._replace(mirrored_share=0.009, turned=0.013)
    assert worse_figures(tuned, start) == []
    assert worse_figures(tuned._replace(turned=0.016), start) == ["turned"]


def test_one_figure_of_wrong_sides_may_rise_where_the_other_was_as_high() -> None:
    start = GOOD._replace(mirrored_share=0.017, front_disagreement=0.0)
    assert worse_figures(start._replace(mirrored_share=0.0, front_disagreement=0.015), start) == []
    worse = start._replace(mirrored_share=0.0, front_disagreement=0.023)
    assert worse_figures(worse, start) == ["front_disagreement"]


def test_standings_have_the_best_first_and_doubtful_ones_last(
    frames: Split, good: Model, bad: Model
) -> None:
    names = tuple(f"other_{i}" for i in range(len(good.layout)))
    stranger = dataclasses.replace(good, layout=KeypointLayout("other", names))
    found = standings(frames, [bad, stranger], good)
    assert [(each.model.name, each.verdict) for each in found] == [
        ("good", "at hand"),
        ("bad", "doubtful"),
    ]
    same = dataclasses.replace(good, name="same")
    assert [each.verdict for each in standings(frames, [same], good)] == ["as_good", "at hand"]
    alone = standings(frames, [bad, good], None)
    assert [each.model.name for each in alone] == ["good", "bad"]
    assert found[0].rank < found[1].rank


def test_a_judgement_on_the_frames_of_the_training_says_so(frames: Split, good: Model) -> None:
    few = frames.training[:40]
    judgement = judge(Split(few, few), good, None)
    assert "on the 40 frames of its training, as none were held out: " in str(judgement)


def test_the_figures_are_named_and_short(frames: Split, good: Model, bad: Model) -> None:
    text = str(judge(frames, good, bad))
    assert "image error of the network before the correction " in text
    assert "bone lengths vary by " in text and "frames that look mirrored 0 % (bad: " in text
    assert "image error and bones together are smaller" in text
    figures = dict(zip(("new", "old"), map(Judge(frames).figures, (good, bad)), strict=True))
    new, old = (percent(each.misfit) for each in figures.values())
    assert f"misfit, the root of their summed squares, {new} (bad: {old})" in text
    assert not re.search(r"\d\.\d\d", text)


@pytest.mark.parametrize(
    ("share", "text"), [(0.0, "0 %"), (0.0004, "0 %"), (0.0123, "1.2 %"), (0.0996, "10 %")]
)
def test_a_percentage_has_two_digits(share: float, text: str) -> None:
    assert percent(share) == text


def test_the_whole_may_be_mirrored_where_a_layout_names_no_handedness(
    frames: Split, good: Model
) -> None:
    nameless = dataclasses.replace(frames.training.layout, handedness=())
    parts = [dataclasses.replace(part, layout=nameless) for part in frames]
    model = dataclasses.replace(good, layout=nameless)
    text = str(judge(Split(*parts), model, None))
    assert text.startswith(
        "the new model has no other to compare with, and may be mirrored as a whole"
    )
    assert "These figures say nothing of depth" in text and "may be a mirror image" in text
    assert "replay FILE --model good --html look.html" in text and "handedness" in text
    assert "if it is one, lift with mirrored (lift --mirrored, the lifter's parameter" in text
    assert "mirror image" not in str(judge(Split(*parts), model, good))  # its start knows the side


def test_a_handedness_against_the_names_is_said_again_at_the_end(
    frames: Split, good: Model
) -> None:
    names = ("right_wing", "left_wing", *good.layout.keypoints[2:])
    four = ("right_wing", "left_wing", names[2], names[3])
    layout = dataclasses.replace(
        good.layout, name="bird", keypoints=names, edges=(), handedness=(four,), reference=None
    )
    parts = [dataclasses.replace(part, layout=layout) for part in frames]
    model = dataclasses.replace(good, layout=layout)
    judgement = judge(Split(*parts), model, None)
    text = str(judgement)
    assert "its handedness has left: right_wing and right: left_wing" in text
    assert "left: right_wing" not in judgement.brief and "its handedness con" in judgement.brief


def test_frames_of_few_keypoints_do_not_tell_a_side(
    frames: Split, good: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    from deep_nrsfm_ros.training import judge as module

    monkeypatch.setattr(module, "MIN_SEEN_SHARE", 0.5)  # of 12 keypoints
    mirrored = dataclasses.replace(good, object_frame=-good.object_frame, name="other")
    for shown, opposed in ((12, 1), (6, 1), (5, 0)):
        some = frames.training[:40]
        visible = np.zeros_like(some.visible)
        visible[:, :shown] = True
        few = dataclasses.replace(some, visible=visible)
        assert Judge(Split(few, few)).figures(good, mirrored).opposed == opposed, shown


def test_keypoints_that_are_rarely_shown_are_named_as_guessed(frames: Split, good: Model) -> None:
    rare = {"rarely_shown": [f"k{i}" for i in range(5)]}
    model = dataclasses.replace(good, provenance=good.provenance | rare)
    assert "Rarely shown: k0, k1, k2 and 2 more (only guessed)" in str(judge(frames, model, good))


def test_a_front_that_only_the_fours_of_the_layout_doubt_is_theirs(
    frames: Split, good: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = frames.training.layout.keypoints
    four = (names[0], names[1], names[2], names[3])
    other = dataclasses.replace(frames.training.layout, handedness=(four,))
    parts = [dataclasses.replace(part, layout=other) for part in frames]
    from deep_nrsfm_ros.training import judge as module

    monkeypatch.setattr(module, "_front_disagreement", lambda *_: 0.17)
    monkeypatch.setattr(module.Judge, "fronts", lambda self, model: [(four, 0.17)])
    reason = judge(Split(*parts), good, None).reason
    assert f"{names[3]} lies behind {names[0]}, {names[1]} and {names[2]} in 17 %" in reason
    assert "four may not always hold" in reason and "several, which vote" in reason
    assert "more views" not in reason


def test_several_fours_of_the_package_are_not_blamed(good: Model) -> None:
    for layout, is_blamed in (
        (HUMAN25, False),
        (dataclasses.replace(HUMAN25, name="mine"), True),
        (dataclasses.replace(HUMAN25, handedness=HUMAN25.handedness[1:]), True),
        (HAND21, False),
    ):
        model = dataclasses.replace(good, layout=layout)
        said = _fronts_in_words([(four, 0.4) for four in layout.handedness], model)
        advice = "in 40 %; more steps (--steps 30000, train.steps), more views, "
        assert ("animal" in said, advice in said) == (is_blamed, not is_blamed)
        assert "several" not in said


def test_few_steps_from_random_weights_are_a_first_look(
    frames: Split, good: Model, bad: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    from deep_nrsfm_ros.training import judge as module

    monkeypatch.setattr(module, "worse_figures", lambda *_, **__: [])
    alone = judge(frames, dataclasses.replace(bad, provenance={"step": 20}), None)
    assert alone.is_first_look and alone.record()["first_look"]
    assert str(alone).startswith(
        "the new model is a first look, and has no other to compare with: 20 steps from random "
        f"weights leave an image error of {percent(alone.figures.image_error)}; 30000 steps are "
        "usual"
    )
    assert good.provenance["step"] < 2000 and not judge(frames, good, None).is_first_look
    for other in ({"step": 2000}, {"step": 20, "from": {"model": "human"}}, {}):
        later = judge(frames, dataclasses.replace(bad, provenance=other), None)
        assert not later.is_first_look and "first_look" not in later.record()


def test_hands_of_both_sides_are_doubtful(
    frames: Split, good: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    from deep_nrsfm_ros.training import judge as module

    monkeypatch.setattr(module, "mixed_sides", lambda data, least: f"mixed above {least}")
    judgement = judge(frames, good, good)
    said = "its data looks wrong: mixed above 0.3. Mend it and train again. Judged beside model"
    assert judgement.reason.startswith(said)
    assert judgement.doubtful and judgement.faults == ("mixed above 0.3",)
    assert judgement.verdict == "doubtful"
