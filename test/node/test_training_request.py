"""The command line of a training carries every option of the request."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from deep_nrsfm_ros.commands.train import arguments
from deep_nrsfm_ros.configuration import override
from deep_nrsfm_ros.node.training_request import TrainingOptions, TrainingRequest
from deep_nrsfm_ros.nrsfm.recipe import Recipe
from deep_nrsfm_ros.observations.curation import Curation


def request(recipe: Recipe | None = None, **options: object) -> TrainingRequest:
    return TrainingRequest(
        dataclasses.replace(TrainingOptions(), **options),
        recipe or Recipe(),
        topic="/camera/keypoints",
        source_layout="coco17",
        target_layout="human17",
        min_confidence=0.25,
        output=Path("folder"),
    )


def test_the_training_command_understands_every_word(tmp_path):
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
    curation = Curation(min_visible=7, thin=0.25, outliers=3.5)
    wanted = request(recipe, bags=(str(tmp_path), "second bag"), name="mine", threads=3)
    wanted = dataclasses.replace(wanted, curation=curation)
    given = arguments().parse_args(wanted.arguments())
    assert given.bag == [tmp_path, Path("second bag")]
    assert (given.topic, given.keypoint_layout) == ("/camera/keypoints", "coco17")
    assert (given.object, given.name, given.threads) == ("human17", "mine", 3)
    assert (given.output, given.min_confidence) == (Path("folder"), 0.25)
    assert given.json_progress
    assert override(Recipe(), given) == recipe
    assert override(Curation(), given) == curation


@pytest.mark.parametrize("name", ["", ".", "../up", "a/b", "-x", "a b", "x" * 101])
def test_a_name_that_is_no_plain_file_name_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match=r"train\.name"):
        request(bags=(str(tmp_path),), name=name).check()


def test_bags_must_be_named_and_exist(tmp_path):
    with pytest.raises(ValueError, match=r"train\.bags"):
        request().check()
    with pytest.raises(ValueError, match="nowhere"):
        request(bags=(str(tmp_path), str(tmp_path / "nowhere"))).check()
    request(bags=(str(tmp_path),)).check()
