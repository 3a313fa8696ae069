# SPDX-License-Identifier: Apache-2.0
"""Nobody but the owner makes the lifter read or write outside of the owner's folders."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deep_nrsfm_ros.model_files.model_file import ModelFileError
from deep_nrsfm_ros.model_files.path_sandbox import PathSandbox, PathSandboxError
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.request import TrainingOptions, limited, sandboxed

OUTSIDE = ("/etc/passwd.safetensors", "/etc/door.yaml", "../outside/secret.safetensors",
           "../outside/door.yaml", "link/secret.safetensors", "link/door.yaml",
           "leaves.safetensors", "leaves.yaml", "models/../../outside/door.yaml",
           "~/door.yaml", "~nobody_here/door.yaml", "a\0b.yaml")  # fmt: skip


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two folders with what belongs there, links that leave them, and a folder outside."""
    models, bags, outside = (tmp_path / name for name in ("models", "bags", "outside"))
    for folder in (models, bags, outside):
        folder.mkdir()
        (folder / "door.yaml").touch()
        (folder / "secret.safetensors").touch()
        (folder / "a_bag").mkdir()
        (folder / "a_bag" / "a_bag.db3").touch()
    for folder in (models, bags):
        (folder / "link").symlink_to(outside)
        (folder / "leaves.safetensors").symlink_to(outside / "secret.safetensors")
        (folder / "leaves.yaml").symlink_to(outside / "door.yaml")
    (bags / "half_a_bag").mkdir()
    (bags / "half_a_bag" / "a_bag.db3").symlink_to(outside / "a_bag" / "a_bag.db3")
    (bags / "stays").symlink_to(bags / "a_bag")
    (models / ".mine.checkpoint").symlink_to(outside / "checkpoint")
    monkeypatch.setenv("HOME", str(outside))
    return tmp_path


@pytest.fixture
def sandbox(places: Path) -> PathSandbox:
    return PathSandbox(places / "models", places / "bags")


@pytest.mark.parametrize("word", OUTSIDE)
def test_paths_that_lead_outside_are_refused_with_the_mend(sandbox: PathSandbox, word: str) -> None:
    asked: list[Callable[[], object]] = [lambda: sandbox.recording("train.bags", word)]
    if "safetensors" in word:
        asked += [
            lambda: sandbox.model("model", word),
            lambda: sandbox.layout("train.object", word),
        ]
    else:
        asked += [lambda: sandbox.layout("keypoint_layout", word)]
    for ask in asked:
        with pytest.raises(PathSandboxError) as refusal:
            ask()
        assert "is no path" in str(refusal.value) or "put it there, or start the lifter with" in (
            str(refusal.value)
        )


def test_a_name_that_climbs_is_no_model(sandbox: PathSandbox) -> None:
    for word in ("../outside/secret", "/etc/passwd", "link/secret", "leaves"):
        with pytest.raises((PathSandboxError, ModelFileError)):
            sandbox.model("model", word)


def test_a_bag_may_not_hold_a_link_that_leaves(sandbox: PathSandbox, places: Path) -> None:
    with pytest.raises(PathSandboxError, match="half_a_bag, in which a_bag.db3"):
        sandbox.recording("train.bags", "half_a_bag")
    assert sandbox.recording("train.bags", "stays") == str(places / "bags" / "a_bag")
    (places / "bags" / "recordings").mkdir()
    (places / "bags" / "half_a_bag").rename(places / "bags" / "recordings" / "half_a_bag")
    with pytest.raises(PathSandboxError, match="recordings, in which a_bag.db3"):
        sandbox.recording("train.inputs", "recordings")


def test_what_is_inside_is_found_by_name_and_by_path(sandbox: PathSandbox, places: Path) -> None:
    secret = places / "models" / "secret.safetensors"
    for word in ("secret", "secret.safetensors", str(secret), "../models/./secret.safetensors"):
        assert sandbox.model("model", word) == secret
    assert sandbox.layout("train.object", "door.yaml") == str(places / "models" / "door.yaml")
    (places / "models" / "door.yaml").unlink()
    assert sandbox.layout("train.object", "door.yaml") == str(places / "bags" / "door.yaml")
    assert sandbox.recording("train.bags", str(places / "models" / "a_bag")).endswith(
        "models/a_bag"
    )
    assert sandbox.layout("keypoint_layout", "coco17") == "coco17"
    with pytest.raises(ModelFileError, match="there is no model file"):
        sandbox.model("model", "gone.safetensors")


def test_what_comes_with_the_package_may_be_named(sandbox: PathSandbox) -> None:
    human = sandbox.model("model", "human")
    assert human.is_file() and sandbox.model("model", str(human)) == human
    hand = human.parents[1] / "config" / "layouts" / "hand.yaml"
    assert sandbox.layout("train.object", str(hand)) == str(hand)


def test_what_the_owner_names_at_the_start_may_be_anywhere(
    places: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(places)
    words = ("outside/door.yaml", str(places / "outside" / "a_bag"), "outside/secret.safetensors")
    sandbox = PathSandbox(places / "models", places / "bags", words)
    assert sandbox.layout("train.object", words[0]) == str(places / words[0])
    assert sandbox.recording("train.bags", words[1]) == words[1]
    assert sandbox.model("model", words[2]).is_file()
    # A bag that the working folder lacks is one of bags_dir.
    sandbox = PathSandbox(places / "models", places / "bags", ("a_bag",))
    assert sandbox.recording("train.bags", "a_bag") == str(places / "bags" / "a_bag")
    with pytest.raises(PathSandboxError):
        sandbox.recording("train.bags", "/etc")


def test_nothing_is_written_through_a_link_that_leaves(sandbox: PathSandbox) -> None:
    with pytest.raises(PathSandboxError, match=r"train\.name names .*\.mine\.checkpoint"):
        sandboxed(TrainingOptions(name="mine"), sandbox)
    with pytest.raises(ValueError, match=r"train\.name is '\.\./up'"):
        sandboxed(TrainingOptions(name="../up"), sandbox)
    assert sandboxed(TrainingOptions(name="other"), sandbox).name == "other"


@given(word=st.one_of(st.text(), st.lists(st.sampled_from(
    ["..", ".", "/", "a_bag", "link", "~", "models", "é", " ", "a.yaml", "b.safetensors"]
)).map("/".join)))  # fmt: skip
def test_no_word_leads_outside(tmp_path_factory: pytest.TempPathFactory, word: str) -> None:
    root = tmp_path_factory.getbasetemp()
    folders = root / "m", root / "b"
    sandbox = PathSandbox(*folders)
    inside = [os.path.realpath(folder) for folder in folders]
    for ask in (sandbox.recording, sandbox.layout, sandbox.model):
        try:
            found = ask("option", word)
        except (ValueError, OSError):
            continue
        if found != word:  # a layout that is no path stays as it is, for find_layout to refuse
            assert any(Path(found).is_relative_to(folder) for folder in inside)
        else:
            assert Path(word).suffix not in (".yaml", ".yml", ".safetensors")


def test_the_owners_limit_of_time_holds() -> None:
    assert limited(Limits(minutes=7), 0).minutes == 7
    assert limited(Limits(minutes=0), 60).minutes == 60
    assert limited(Limits(minutes=7), 60).minutes == 7
    with pytest.raises(ValueError, match="allows at most 60"):
        limited(Limits(minutes=61), 60)
