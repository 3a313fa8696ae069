# SPDX-License-Identifier: Apache-2.0
"""Model files keep everything, are written whole or not at all, and damaged ones are refused."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import save_file
from safetensors.torch import save_file as save_tensors

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import CMU31, HUMAN17
from deep_nrsfm_ros.model_files.model_file import (
    MODEL_SUFFIX,
    Model,
    ModelFileError,
    find_model,
    load_model,
    save_model,
)
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser

some = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
MIRROR = np.diag([1, 1, -1]).astype(np.float32)


def model(
    layout: KeypointLayout = HUMAN17, architecture: Architecture | None = None, seed: int = 0
) -> Model:
    rng = np.random.default_rng(seed)
    architecture = architecture or Architecture(widths=(8, 4))
    network = initialise(architecture, len(layout), rng, paper_initialisation=True)
    provenance = {"data": "bags a, b", "frames": 5, "recipe": {"cycle": 2.0}}
    quality = {"cycle_error": 0.25, "coherence": 0.5}
    covariance = np.diag(rng.uniform(1, 2, 3 * len(layout))).astype(np.float32)
    bones = rng.uniform(0.1, 0.2, (len(layout.bone_indices()), 2)).astype(np.float32)
    return Model(
        "mine", network, layout, Normaliser("none"), MIRROR, provenance, quality, covariance, bones
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.safetensors"
    save_model(path, model())
    return path


@pytest.mark.parametrize("layout", [HUMAN17, CMU31, KeypointLayout.numbered(5)])
@pytest.mark.parametrize("widths", [(7,), (8, 4, 3)])
def test_round_trip(tmp_path: Path, layout: KeypointLayout, widths: tuple[int, ...]) -> None:
    saved = model(layout, Architecture(widths, "block", "closed_form", "free"))
    save_model(tmp_path / "models" / "m.safetensors", saved)
    loaded = load_model(tmp_path / "models" / "m.safetensors")
    assert loaded.name == "m"  # that of the file
    for field in ("layout", "normaliser", "provenance", "quality"):
        assert getattr(loaded, field) == getattr(saved, field)
    assert loaded.network.architecture == saved.network.architecture
    np.testing.assert_array_equal(loaded.object_frame, saved.object_frame)
    for (name, a), (again, b) in zip(
        loaded.network.named_weights(), saved.network.named_weights(), strict=True
    ):
        assert name == again and a.dtype == b.dtype == np.float32
        np.testing.assert_array_equal(a, b)
    assert [f.name for f in (tmp_path / "models").iterdir()] == ["m.safetensors"]


@pytest.mark.parametrize("older", [["left_hip", "right_hip", "neck", "nose"], None])
def test_a_file_from_when_handedness_was_one(file: Path, older: list[str] | None) -> None:
    rewrite(file, lambda header, weights, metadata: header["layout"].update(handedness=older))
    assert load_model(file).layout.handedness == (() if older is None else (tuple(older),))


def refused(path: Path) -> str:
    """Return what load_model says against the file, which it must name."""
    with pytest.raises(ModelFileError) as caught:
        load_model(path)
    assert isinstance(caught.value, ValueError) and str(path) in str(caught.value)
    return str(caught.value)


@some
@given(cut=st.floats(0, 1, exclude_max=True))
def test_a_cut_off_file_is_refused(file: Path, cut: float) -> None:
    whole = file.read_bytes()
    part = file.with_name("cut.safetensors")
    part.write_bytes(whole[: int(cut * len(whole))])
    assert ("damaged" if part.stat().st_size else "is empty") in refused(part)


@some
@given(st.binary(max_size=300))
def test_any_bytes_are_refused(file: Path, data: bytes) -> None:
    file.write_bytes(data)
    assert refused(file)


@some
@given(st.floats(0, 1), st.binary(min_size=1, max_size=40), st.booleans())
def test_overwritten_bytes_raise_nothing_else(
    file: Path, place: float, data: bytes, in_header: bool
) -> None:
    raw = bytearray(model_bytes(file))
    end = 8 + int.from_bytes(raw[:8], "little") if in_header else len(raw)
    at = int(place * (end - len(data)))
    raw[at : at + len(data)] = data
    file.write_bytes(raw)
    try:
        loaded = load_model(file)
    except ModelFileError as error:
        assert str(file) in str(error)
    else:
        assert all(np.isfinite(w).all() for _, w in loaded.network.named_weights())


def model_bytes(file: Path) -> bytes:
    save_model(file, model())
    return file.read_bytes()


def rewrite(
    file: Path,
    change: Callable[[dict[str, Any], dict[str, np.ndarray], dict[str, str]], None],
) -> None:
    """Write the model again after `change` of its header, weights and metadata."""
    with safe_open(file, "numpy") as opened:
        metadata = opened.metadata()
        weights = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 - not a dict
    header = json.loads(metadata.pop("model"))
    change(header, weights, metadata)
    save_file(weights, file, metadata | ({"model": json.dumps(header)} if header else {}))


def test_rewriting_alone_does_no_harm(file: Path) -> None:
    rewrite(file, lambda header, weights, metadata: None)
    assert load_model(file).name == "mine"


@pytest.mark.parametrize("weight", ["D.0", "D.1", "b.0", "b_.1", "camera_head", "L"])
@pytest.mark.parametrize("kind", ["nan", "infinite", "huge", "shape", "missing", "float64", "int"])
def test_weights_are_checked(file: Path, weight: str, kind: str) -> None:
    def change(header: Any, weights: dict[str, np.ndarray], metadata: Any) -> None:
        if kind == "missing":
            del weights[weight]
        elif kind == "shape":
            weights[weight] = np.ones((*weights[weight].shape, 2), np.float32)
        elif kind in ("float64", "int"):
            weights[weight] = weights[weight].astype(kind)
        else:
            weights[weight].flat[-1] = {"nan": np.nan, "infinite": -np.inf, "huge": 3e38}[kind]

    rewrite(file, change)
    assert weight in refused(file)


@pytest.mark.parametrize(
    ("kind", "refusal"), [("skew", "not symmetric"), ("indefinite", "not positive definite")]
)
@pytest.mark.parametrize("name", ["error_covariance", "hidden_covariance"])
def test_error_covariances_are_checked(file: Path, name: str, kind: str, refusal: str) -> None:
    def change(header: Any, weights: Any, metadata: Any) -> None:
        if kind == "skew":
            weights[name][0, 1] = 0.5
        else:
            weights[name][2, 2] *= -1

    save_model(file, with_hidden_nose())
    rewrite(file, change)
    assert f"{name} is {refusal}" in refused(file)


def with_hidden_nose() -> Model:
    """Return a model that has a second covariance for detectors without a nose."""
    covariance = 2 * np.eye(3 * len(HUMAN17), dtype=np.float32)
    return dataclasses.replace(model(), hidden_keypoints=("nose",), hidden_covariance=covariance)


def test_the_covariance_of_hidden_keypoints_is_kept(file: Path) -> None:
    older = load_model(file)
    assert older.covariance_for(()) is older.error_covariance
    save_model(file, with_hidden_nose())
    loaded = load_model(file)
    assert loaded.hidden_keypoints == ("nose",)
    np.testing.assert_array_equal(loaded.covariance_for(("neck",))[0, :2], [2, 0])
    assert loaded.covariance_for(("neck", "nose")) is loaded.error_covariance


@pytest.mark.parametrize("wrong", [["eye"], "nose", [["nose"]], [1], None, {"nose": 1}])
def test_hidden_keypoints_are_names_of_the_layout(file: Path, wrong: Any) -> None:
    save_model(file, with_hidden_nose())
    rewrite(file, lambda header, weights, metadata: header.update(hidden_keypoints=wrong))
    assert "hidden_keypoints are" in refused(file)


def test_hidden_keypoints_without_a_covariance_are_refused(file: Path) -> None:
    rewrite(file, lambda header, weights, metadata: header.update(hidden_keypoints=["nose"]))
    assert "lacks 'hidden_covariance'" in refused(file)


def test_a_layout_of_before_there_were_rigid_pairs_is_read(file: Path) -> None:
    def change(header: Any, weights: Any, metadata: Any) -> None:
        del header["layout"]["rigid"]
        weights["bone_lengths"] = weights["bone_lengths"][: len(HUMAN17.edges)]

    rewrite(file, change)
    assert load_model(file).layout == dataclasses.replace(HUMAN17, rigid=())


@pytest.mark.parametrize("value", [0.0, -0.1])
def test_bones_have_a_length(file: Path, value: float) -> None:
    def change(header: Any, weights: Any, metadata: Any) -> None:
        weights["bone_lengths"][3, 1] = value

    rewrite(file, change)
    assert "bone_lengths are not all above" in refused(file)


def correlation(value: float) -> np.ndarray:
    """Return the correlation of the bones of HUMAN17, `value` between each two."""
    b = len(HUMAN17.bone_indices())
    return (value + (1 - value) * np.eye(b)).astype(np.float32)


def test_the_correlation_of_bones_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "mine.safetensors"
    save_model(path, dataclasses.replace(model(), bone_correlation=correlation(0.5)))
    bones = load_model(path).bones
    assert bones is not None and bones.correlation is not None
    np.testing.assert_array_equal(bones.correlation, correlation(0.5))
    save_model(path, model())
    without = load_model(path).bones
    assert without is not None and without.correlation is None


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (correlation(0.5)[:3, :3], "bone_correlation is float32 (3, 3)"),
        (correlation(0.5) + np.triu(np.full_like(correlation(0), 0.1), 1), "is not symmetric"),
        (2 * correlation(0.5), "is not 1 on its diagonal"),
        (correlation(1.0), "is not positive definite"),
        (correlation(0.5) * np.float32(np.nan), "has a number that is not below"),
    ],
)
def test_a_damaged_correlation_is_refused(file: Path, wrong: np.ndarray, reason: str) -> None:
    def change(header: Any, weights: Any, metadata: Any) -> None:
        weights["bone_correlation"] = wrong

    rewrite(file, change)
    assert reason in refused(file)


def test_a_file_that_knows_nothing_of_bones_is_read(file: Path) -> None:
    def change(header: Any, weights: Any, metadata: Any) -> None:
        del weights["bone_lengths"]

    rewrite(file, change)
    assert load_model(file).bones is None


HEADERS: dict[str, dict[str, Any]] = {
    "no layer": {"architecture": {"widths": []}},
    "widths of words": {"architecture": {"widths": ["8", "4"]}},
    "other widths": {"architecture": {"widths": [8, 5]}},
    "one width": {"architecture": {"widths": 8}},
    "unknown threshold": {"architecture": {"widths": [8, 4], "threshold": "hard"}},
    "unknown option": {"architecture": {"widths": [8, 4], "dropout": 0.1}},
    "unknown scale": {"normaliser": {"scale": "inches"}},
    "layout of another object": {"layout": dataclasses.asdict(CMU31)},
    "layout without names": {"layout": {}},
    "layout repeats": {"layout": {"name": "x", "keypoints": ["a"] * 17}},
    "layout is a number": {"layout": 17},
    "frame is skew": {"object_frame": [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]},
    "frame is large": {"object_frame": (2 * np.eye(3)).tolist()},
    "frame is NaN": {"object_frame": np.full((3, 3), np.nan).tolist()},
    "frame is flat": {"object_frame": [1, 0, 0]},
    "frame is ragged": {"object_frame": [[1], [0, 1]]},
    "frame is text": {"object_frame": "eye"},
    "provenance is a number": {"provenance": 3},
}


@pytest.mark.parametrize("changes", HEADERS.values(), ids=HEADERS)
def test_the_header_is_checked(file: Path, changes: dict[str, Any]) -> None:
    rewrite(file, lambda header, weights, metadata: header.update(changes))
    text = refused(file)
    assert "damaged header or weights" in text or "another version" in text


@pytest.mark.parametrize("missing", ["name", "architecture", "layout", "normaliser"])
def test_a_header_is_complete(file: Path, missing: str) -> None:
    rewrite(file, lambda header, weights, metadata: header.pop(missing))
    assert missing in refused(file)


def test_metadata_are_checked(file: Path) -> None:
    rewrite(file, lambda header, weights, metadata: metadata.update(format="another model 7"))
    assert "deep_nrsfm_ros model 2" in refused(file)
    save_model(file, model())
    rewrite(file, lambda header, weights, metadata: header.clear())
    assert "damaged header" in refused(file)
    weights = dict(model().network.named_weights())
    save_file(weights, file)
    assert "deep_nrsfm_ros model 2" in refused(file)
    for text in ("", "{", "[]", "3", "[" * 100_000):
        save_file(weights, file, {"format": "deep_nrsfm_ros model 2", "model": text})
        assert "damaged header" in refused(file)


def test_tensors_of_a_type_that_numpy_lacks_are_refused(file: Path) -> None:
    for kind, name in ((torch.bfloat16, "BF16"), (torch.float8_e4m3fn, "F8_E4M3")):
        tensors = {"D.0": torch.ones(17, 3, 8).to(kind)}
        save_tensors(tensors, file, {"format": "deep_nrsfm_ros model 2"})
        text = refused(file)
        assert f"weights `D.0` of type {name}, which NumPy cannot read" in text
        assert "damaged" not in text


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    assert "No such file" in refused(tmp_path / "absent.safetensors")
    (tmp_path / "folder.safetensors").mkdir()
    refused(tmp_path / "folder.safetensors")


def test_a_huge_file_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.safetensors"
    with path.open("wb") as huge:
        huge.truncate(2**40)  # sparse: takes no space
    assert "larger than 64 MiB" in refused(path)


@pytest.mark.parametrize("fails", ["save_file", "os.replace"])
def test_a_failed_save_leaves_the_old_file(
    file: Path, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    def full_disk(*arguments: object) -> None:
        if fails == "save_file":
            Path(str(arguments[1])).write_bytes(b"half")
        raise OSError("no space left")

    before = file.read_bytes()
    monkeypatch.setattr(f"deep_nrsfm_ros.model_files.model_file.{fails}", full_disk)
    with pytest.raises(OSError, match="no space"):
        save_model(file, model(seed=1))
    assert file.read_bytes() == before
    assert list(file.parent.iterdir()) == [file]


def test_what_json_cannot_hold_leaves_the_old_file(file: Path) -> None:
    before = file.read_bytes()
    with pytest.raises(TypeError):
        save_model(file, dataclasses.replace(model(), provenance={"data": Path("x")}))
    assert file.read_bytes() == before
    assert list(file.parent.iterdir()) == [file]


def test_saving_replaces(file: Path) -> None:
    save_model(file, dataclasses.replace(model(), quality={"cycle_error": 0.5}))
    assert load_model(file).quality == {"cycle_error": 0.5}


def test_a_model_has_the_name_of_its_file(tmp_path: Path) -> None:
    save_model(tmp_path / "first.safetensors", model())
    (tmp_path / "first.safetensors").rename(tmp_path / "second.safetensors")
    assert load_model(tmp_path / "second.safetensors").name == "second"
    assert load_model("second", str(tmp_path)).name == "second"


def test_a_file_is_named_by_a_string_as_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    save_model("mine.safetensors", model())
    assert load_model("mine.safetensors").name == "mine"
    monkeypatch.setenv("HOME", str(tmp_path))
    save_model("~/new/mine.safetensors", model())
    assert (tmp_path / "new" / "mine.safetensors").is_file()
    with pytest.raises(TypeError, match="takes the file, the model"):
        save_model(model(), "mine.safetensors")  # type: ignore[arg-type]


def test_find_model(tmp_path: Path) -> None:
    folders = [tmp_path / "mine", tmp_path / "installed", tmp_path / "absent"]
    for folder, names in zip(folders, (("human", "dog"), ("human", "cmu31")), strict=False):
        for name in names:
            save_model(folder / f"{name}{MODEL_SUFFIX}", model())
    assert find_model("human", folders) == folders[0] / "human.safetensors"
    assert find_model("cmu31", folders) == folders[1] / "cmu31.safetensors"
    path = folders[1] / "cmu31.safetensors"
    assert find_model(str(path), []) == path
    for unknown in ("cat", "cat.safetensors", str(tmp_path / "cat.safetensors"), ""):
        with pytest.raises(ModelFileError, match="there are cmu31, dog, human in") as caught:
            find_model(unknown, folders)
        assert str(folders[0]) in str(caught.value) and repr(unknown) in str(caught.value)
    with pytest.raises(ModelFileError, match="there are none"):
        find_model("human", folders[2:])


def test_a_header_that_claims_too_much_is_refused_before_it_is_read(file: Path) -> None:
    for length in (2**20 + 1, 2**40, 2**64 - 1):
        file.write_bytes(length.to_bytes(8, "little") + bytes(2**21))
        assert "its header claims" in refused(file)


def test_a_pipe_is_no_model(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.safetensors")
    assert "not a regular file" in refused(tmp_path / "pipe.safetensors")


def test_more_keypoints_than_can_be_lifted_are_refused() -> None:
    with pytest.raises(ValueError, match="1001 keypoints; at most 1000"):
        KeypointLayout.numbered(1001)


@pytest.mark.parametrize(
    "changes",
    [
        {"architecture": {"widths": [8.0, 4]}},
        {"architecture": {"widths": [8, True]}},
        {"architecture": {"widths": [8, 4], "whitening": "1"}},
        {"normaliser": {"scale": ["rms", "rms"]}},
        {"layout": {**dataclasses.asdict(HUMAN17), "name": 5}},
        {"layout": {**dataclasses.asdict(HUMAN17), "keypoints": [*range(17)]}},
        {"layout": {**dataclasses.asdict(HUMAN17), "derived": {"nose": [{}]}}},
    ],
    ids=str,
)
def test_what_the_header_says_has_the_right_type(file: Path, changes: dict[str, Any]) -> None:
    rewrite(file, lambda header, weights, metadata: header.update(changes))
    assert "damaged header or weights" in refused(file)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "is empty"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
        (b"PK\x03\x04" + bytes(99), "zip archive"),
        (b"\x80\x02}q" + bytes(99), "pickle, which is never read"),
        (b"<!DOCTYPE html><html>", "web page"),
    ],
)
def test_files_of_other_kinds_are_named_and_not_called_damaged(
    tmp_path: Path, content: bytes, reason: str
) -> None:
    file = tmp_path / "other.safetensors"
    file.write_bytes(content)
    text = refused(file)
    assert reason in text and "damaged" not in text


def test_a_model_of_another_version_is_not_called_damaged(tmp_path: Path) -> None:
    file = tmp_path / "other.safetensors"
    weights = {"w": np.zeros(1, np.float32)}
    save_file(weights, file, {"format": "deep_nrsfm_ros model 3", "model": "{}"})
    assert "its format is 'deep_nrsfm_ros model 3'" in refused(file)
    save_file(weights, file, {"format": "pt"})
    assert "safetensors file of another program" in refused(file)


def test_a_path_that_is_no_model_file_is_told_from_an_unknown_name(tmp_path: Path) -> None:
    (tmp_path / "weights.pt").write_bytes(b"x")
    for path, reason in {
        tmp_path / "absent.safetensors": "does not exist",
        tmp_path / "weights.pt": "is a file, not a model file",
        tmp_path: "is a folder, not a model file",
    }.items():
        with pytest.raises(ModelFileError, match=reason):
            load_model(str(path))
