"""The command line of a training carries every option of the request."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.commands.train import arguments
from deep_nrsfm_ros.configuration import override
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import COCO17
from deep_nrsfm_ros.model_files.model_file import Model, save_model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.record import keep_record
from deep_nrsfm_ros.training.request import TrainingOptions, TrainingRequest, layouts


def request(recipe: Recipe | None = None, **options: Any) -> TrainingRequest:
    return TrainingRequest(
        dataclasses.replace(TrainingOptions(), **options),
        recipe or Recipe(),
        topic="/camera/keypoints",
        source_layout="coco17",
        target_layout="human17",
        start="",
        min_confidence=0.25,
        output=Path("folder"),
    )


def test_the_training_command_understands_every_word(tmp_path: Path) -> None:
    recipe = Recipe(
        **{
            field.name: {
                int: lambda old: old + 1,
                float: lambda old: old + 0.25,
                bool: lambda old: not old,
                str: lambda _: "exponential",
            }[type(field.default)](field.default)
            for field in dataclasses.fields(Recipe)
        }
    )
    curation = Curation(min_visible=7, min_change=0.25, outlier_threshold=3.5)
    wanted = request(recipe, bags=(str(tmp_path), "second bag"), name="mine", threads=3)
    limits = Limits(minutes=2.5, patience=0.25, keep_best=False)
    layout_loss = LayoutLossWeights(
        bone_length_weight=1.5, handedness_weight=0.5, depth_penalty=0.25
    )
    wanted = dataclasses.replace(wanted, curation=curation, limits=limits, layout_loss=layout_loss)
    given = arguments().parse_args(wanted.arguments())
    assert given.bag == [tmp_path, Path("second bag")]
    assert (given.topic, given.keypoint_layout) == ("/camera/keypoints", "coco17")
    assert given.start == ""
    assert (given.object, given.name, given.threads) == ("human17", "mine", 3)
    assert (given.output, given.min_confidence) == (Path("folder"), 0.25)
    assert given.mapping == "" and (given.image_width, given.image_height) == (0, 0)
    assert given.json_progress
    assert override(Recipe(), given) == recipe
    assert override(Curation(), given) == curation
    assert override(Limits(), given) == limits
    assert override(LayoutLossWeights(), given) == layout_loss


def test_what_the_lifter_knows_of_the_messages_goes_along() -> None:
    wanted = dataclasses.replace(
        request(), input_type="cats.yaml", image_width=640, image_height=480
    )
    given = arguments().parse_args(wanted.arguments())
    assert (given.mapping, given.image_width, given.image_height) == ("cats.yaml", 640, 480)


@pytest.mark.parametrize("name", ["", ".", "../up", "a/b", "-x", "a b", "x" * 101])
def test_a_name_that_is_no_plain_file_name_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=r"train\.name"):
        request(bags=(str(tmp_path),), name=name).check()


def test_bags_must_be_named_and_exist(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"train\.bags"):
        request().check()
    with pytest.raises(ValueError, match="nowhere"):
        request(bags=(str(tmp_path), str(tmp_path / "nowhere"))).check()
    request(bags=(str(tmp_path),)).check()


MODEL = Path("present.safetensors")


@pytest.mark.parametrize(
    ("options", "heard", "start", "expected"),
    [
        ({}, "model", "", (str(MODEL), str(MODEL))),
        ({}, "coco17", "", ("coco17", str(MODEL))),
        ({}, "model", "old.safetensors", (str(MODEL), "old.safetensors")),
        ({}, "coco17", "old.safetensors", ("coco17", "old.safetensors")),
        ({"object": "dog.yaml"}, "model", "", ("dog.yaml", "dog.yaml")),
        ({"object": "dog.yaml"}, "coco17", "", ("coco17", "dog.yaml")),
        ({"object": "dog.yaml"}, "model", "old.safetensors", ("dog.yaml", "dog.yaml")),
        (
            {"object": "human17", "keypoint_layout": "body25"},
            *("model", ""),
            ("body25", "human17"),
        ),
        ({"keypoint_layout": "body25"}, "coco17", "", ("body25", str(MODEL))),
        ({"object": "numbered"}, "coco17", "", ("", "numbered")),
    ],
)
def test_layouts_are_what_was_said_or_what_the_lifter_hears_and_has(
    options: dict[str, Any], heard: str, start: str, expected: tuple[str, str]
) -> None:
    assert layouts(TrainingOptions(**options), heard, MODEL, start) == expected


def save(path: Path, layout: KeypointLayout) -> Path:
    network = initialise(Architecture(widths=(4,)), len(layout), np.random.default_rng(0))
    frame = np.eye(3, dtype=np.float32)
    save_model(path, Model("m", network, layout, Normaliser(), frame))
    return path


def test_layouts_and_start_are_checked_before_anything_starts(tmp_path: Path) -> None:
    wanted = request(bags=(str(tmp_path),))
    assert wanted.check() == ""
    assert (
        "'coco17' names no handedness"
        in dataclasses.replace(wanted, target_layout="coco17").check()
    )
    numbered = dataclasses.replace(wanted, target_layout="numbered", source_layout="")
    assert "'numbered' names no handedness" in numbered.check()
    coco = save(tmp_path / "coco.safetensors", COCO17)
    points = save(tmp_path / "points.safetensors", KeypointLayout.numbered(5))
    assert dataclasses.replace(wanted, start=str(coco)).check() == ""
    mistakes: tuple[tuple[dict[str, Any], str], ...] = (
        ({"target_layout": "horse"}, "train.object is 'horse'; name a preset"),
        ({"source_layout": "horse"}, "train.keypoint_layout is 'horse'; name a preset"),
        ({"target_layout": "cmu31"}, "share 0 keypoints"),
        ({"target_layout": str(tmp_path / "a.yaml")}, "a.yaml: cannot be read"),
        ({"target_layout": "numbered"}, "empty train.keypoint_layout"),
        ({"start": str(points)}, "knows 0 of the 17 keypoints"),
        ({"start": str(tmp_path / "gone.safetensors")}, "cannot read model"),
    )
    for changes, complaint in mistakes:
        with pytest.raises(ValueError, match=complaint):
            dataclasses.replace(wanted, **changes).check()


def test_resuming_keeps_to_what_was_asked_and_tells_what_differs(tmp_path: Path) -> None:
    wanted = dataclasses.replace(request(resume=True, name="mine", threads=2), output=tmp_path)
    with pytest.raises(ValueError, match=r"no unfinished training of 'mine'.*\(unfinished: none\)"):
        wanted.check()
    asked = {"bag": [tmp_path / "bag"], "topic": "/camera/keypoints", "steps": 77}
    with keep_record(tmp_path, "mine", asked, resume=False) as checkpoint:
        with pytest.raises(ValueError, match="under way in another process: wait"):
            wanted.check()
        checkpoint.touch()
    said = wanted.check()
    assert "bag was" in said and "steps was 77, is 30000 now; it keeps to" in said
    assert "topic was" not in said
    given = arguments().parse_args(wanted.arguments())
    assert (given.resume, given.name, given.output) == (True, "mine", tmp_path)
    assert given.threads == 2 and not given.bag and "steps" not in given
    with pytest.raises(ValueError, match=r"of 'other' in .* \(unfinished: mine\)"):
        dataclasses.replace(wanted, options=TrainingOptions(resume=True, name="other")).check()


def test_a_checkpoint_without_a_record_goes_on_with_the_parameters(tmp_path: Path) -> None:
    (tmp_path / ".mine.checkpoint").touch()
    wanted = dataclasses.replace(request(resume=True, name="mine"), output=tmp_path)
    with pytest.raises(ValueError, match=r"train\.bags"):
        wanted.check()
    options = dataclasses.replace(wanted.options, bags=(str(tmp_path),))
    wanted = dataclasses.replace(wanted, options=options)
    assert wanted.check() == ""
    given = arguments().parse_args(wanted.arguments())
    assert given.resume and given.bag == [tmp_path] and given.steps == 30000
