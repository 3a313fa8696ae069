# SPDX-License-Identifier: Apache-2.0
"""Model files: safetensors weights with everything that is needed to use them, never pickle."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load, save_file

from deep_nrsfm_ros.configuration import check
from deep_nrsfm_ros.layouts.joints import joints_from_json
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.model_files.folders import default_models_dir, in_words, model_folders
from deep_nrsfm_ros.nrsfm.bones import Bones
from deep_nrsfm_ros.nrsfm.network import Architecture, Network, weight_shapes
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser

MODEL_SUFFIX = ".safetensors"
_FORMAT = "deep_nrsfm_ros model 2"
_FAMILY = "deep_nrsfm_ros model "
_FOREIGN = {
    b"version https://git-lfs": "is a pointer of Git LFS; fetch the file with `git lfs pull`",
    b"PK": "is a zip archive (or weights of PyTorch), not a safetensors file; unpack it, or train "
    "a model",
    **dict.fromkeys(
        (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"),
        "is a pickle, which is never read; train a model",
    ),
    **dict.fromkeys(
        (b"<!", b"<html", b"<HTML", b"<?xml"),
        "is a web page, not a model; download the file itself",
    ),
}
"""What a file is that begins with these bytes."""
_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
_NUMPY_TYPES = ("BOOL", "U8", "I8", "U16", "I16", "U32", "I32", "U64", "I64", "F16", "F32", "F64")
_MAX_BYTES = 64 * 2**20
_MAX_HEADER = 2**20
_SMALLEST = 1e-9  # length of a bone, or its spread, that can be divided by
_LARGEST = 1e9  # no weight of a trained model comes near; products of them stay finite


class ModelFileError(ValueError):
    """A model file that is missing, damaged or not one of ours; the text says which and what."""


@dataclass(frozen=True)
class Model:
    """A trained network of p keypoints and all that is needed to lift with it.

    Attributes:
        name: name of the model; one that is read from a file has the name of the file.
        network: architecture and weights.
        layout: layout of the p keypoints.
        normaliser: takes keypoints to the input of the network.
        object_frame: (3, 3) orthonormal A from the network's axes to the object's (S A, A^T M).
            det -1 undoes a mirrored depth. The axes are x front, y left, z up where the layout
            has a handedness.
        provenance: data, recipe, seed, date and versions. `judgement` is what the judge said at the
            end of the training: `doubtful`, a bool, `reason`, a sentence, and the figures.
        quality: label-free figures, such as `reprojection_error` and `cycle_error`.
        error_covariance: (3p, 3p) covariance of the network's errors, in its own axes (see
            `lifting/correction.py`); the identity if it was not measured.
        hidden_keypoints: names of keypoints that some detectors never have, as those of the face.
        hidden_covariance: (3p, 3p) error covariance where the detector has none of
            `hidden_keypoints`; (0,) if there are no such keypoints.
        bone_lengths: (b, 2) mean and standard deviation of the length of each bone of the
            layout, as shares of the sum of all lengths (see `nrsfm/bones.py`); (0, 2) if they
            were not measured.
        bone_correlation: (b, b) of these lengths; (0, 0): they vary independently.
    """

    name: str
    network: Network
    layout: KeypointLayout
    normaliser: Normaliser
    object_frame: NDArray[np.float32]
    provenance: dict[str, Any] = field(default_factory=dict)
    quality: dict[str, Any] = field(default_factory=dict)
    error_covariance: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    bone_lengths: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    bone_correlation: NDArray[np.float32] = field(
        default_factory=lambda: np.zeros((0, 0), np.float32)
    )
    hidden_keypoints: tuple[str, ...] = ()
    hidden_covariance: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))

    def __post_init__(self) -> None:
        """Set the error covariance to the identity if it is empty."""
        if not self.error_covariance.size:
            unknown = np.eye(3 * len(self.layout), dtype=np.float32)
            object.__setattr__(self, "error_covariance", unknown)

    def covariance_for(self, keypoints: Collection[str]) -> NDArray[np.float32]:
        """Return the error covariance (3p, 3p) for a detector that has these keypoints.

        Args:
            keypoints: names of keypoints of the layout.
        """
        if self.hidden_keypoints and not set(self.hidden_keypoints) & set(keypoints):
            return self.hidden_covariance
        return self.error_covariance

    @property
    def bones(self) -> Bones | None:
        """Mean and spread of the bones' lengths; None if they were not measured."""
        if not len(self.bone_lengths):
            return None
        ends = np.array(self.layout.bone_indices(), np.int32).T
        lengths, spread = self.bone_lengths.astype(np.float64).T
        correlation = self.bone_correlation.astype(np.float64)
        return Bones(ends, lengths, spread, correlation if correlation.size else None)


def save_model(path: str | Path, model: Model) -> None:
    """Write a model file completely or not at all: under a temporary name, then renamed.

    Args:
        path: the file, NAME.safetensors; its folder is made where it is missing. `load_model` and
            the lifter find a model by its name in `$ROS_HOME/deep_nrsfm_ros/models`.
        model: the model.

    Raises:
        TypeError: the arguments are of other types.
        OSError: the file cannot be written.
    """
    if not isinstance(model, Model):
        raise TypeError(f"model is a {type(model).__name__}; save_model takes the file, the model")
    path = Path(path).expanduser()
    header = {
        "name": model.name,
        "architecture": dataclasses.asdict(model.network.architecture),
        "layout": dataclasses.asdict(model.layout),
        "normaliser": dataclasses.asdict(model.normaliser),
        "object_frame": np.asarray(model.object_frame).tolist(),
        "provenance": model.provenance,
        "quality": model.quality,
        "hidden_keypoints": list(model.hidden_keypoints),
    }
    weights = {k: np.ascontiguousarray(w, np.float32) for k, w in model.network.named_weights()}
    weights["error_covariance"] = np.ascontiguousarray(model.error_covariance, np.float32)
    if model.hidden_keypoints:
        weights["hidden_covariance"] = np.ascontiguousarray(model.hidden_covariance, np.float32)
    if len(model.bone_lengths):
        weights["bone_lengths"] = np.ascontiguousarray(model.bone_lengths, np.float32)
    if model.bone_correlation.size:
        weights["bone_correlation"] = np.ascontiguousarray(model.bone_correlation, np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        save_file(weights, partial, {"format": _FORMAT, "model": json.dumps(header)})
        with partial.open("rb") as file:
            os.fsync(file.fileno())  # or a power cut may leave the new name on an empty file
        partial.chmod(0o644)  # safetensors writes for its owner alone; models are for everybody
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def load_model(model: str | Path, models_dir: str | Path | None = None) -> Model:
    """Return a model by its name or from its file; it has the name of its file.

    Args:
        model: name of a model ("human"), or path of a model file. A `Path` is always a file.
        models_dir: folder of your own models, searched before those of the package. None: the
            lifter's, `$ROS_HOME/deep_nrsfm_ros/models`.

    Raises:
        ModelFileError: there is no such model (the text lists those that exist), or its file is
            damaged.
    """
    path = model
    if not isinstance(path, Path):
        own = Path(models_dir).expanduser() if models_dir else default_models_dir()
        path = find_model(path, model_folders(own))
    content = _read(path)
    try:
        metadata = _metadata(content)
        if "format" in metadata:
            _check_format(metadata["format"])
        _check_weight_types(content)
        weights = load(content)
        _check_format(metadata.get("format"))
    except ModelFileError as error:
        raise ModelFileError(f"{path} {error}") from None
    except Exception as error:  # safetensors raises many kinds for a damaged file
        reason = _foreign(content) or f"is damaged or no safetensors file: {error}"
        raise ModelFileError(f"{path} {reason}") from error
    try:
        model_in_file = _build(json.loads(metadata["model"]), weights)
        return dataclasses.replace(model_in_file, name=path.stem)
    except KeyError as error:
        raise ModelFileError(f"{path} has a damaged header or weights: it lacks {error}") from error
    except (TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as e:
        if "unexpected keyword argument" in str(e):
            field_name = str(e).rpartition("argument ")[2]
            raise ModelFileError(
                f"{path} was written by another version of this package: its field {field_name} is "
                "not known here; install that version, or train the model anew"
            ) from e
        raise ModelFileError(f"{path} has a damaged header or weights: {e}") from e


def load_once(path: Path) -> Model:
    """Return `load_model(path)`; a file that has not changed since the last call is not read again.

    All callers share the model: they do not change it.
    """
    try:
        found = path.stat()
    except OSError:
        return load_model(path)  # it says what is wrong
    return _load_version(path, found.st_ino, found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=8)
def _load_version(path: Path, inode: int, modified: int, size: int) -> Model:
    """Return the model in a file; the other arguments tell its versions apart."""
    return load_model(path)


def _read(path: Path) -> bytes:
    """Return what a file holds, its size bounded; raise ModelFileError.

    The file is read, not memory-mapped: truncating a mapped file ends the process that uses it.
    """
    try:
        if path.exists() and not path.is_file():  # reading a pipe would wait for ever
            raise ModelFileError(f"cannot read model {path}: not a regular file")
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size <= _MAX_BYTES:
                return file.read(_MAX_BYTES)
    except OSError as error:
        raise ModelFileError(f"cannot read model {path}: {error.strerror or error}") from error
    raise ModelFileError(f"{path} is larger than {_MAX_BYTES >> 20} MiB: not a model")


def _foreign(content: bytes) -> str:
    """Return what a file that is no safetensors file is instead; "" if that is not known."""
    if not content:
        return "is empty; copy or download it anew"
    if content[8:9] == b"{":  # the header of safetensors, after its length, which can be any bytes
        return ""
    for start, reason in _FOREIGN.items():
        if content.startswith(start):
            return reason
    return ""


def _metadata(content: bytes) -> dict[str, Any]:
    """Return the metadata of a safetensors file: 8 bytes of length, then a header of JSON."""
    length = int.from_bytes(content[:8], "little")
    if length > _MAX_HEADER:
        raise ValueError(f"its header claims {length} bytes; at most {_MAX_HEADER} are allowed")
    return dict(json.loads(content[8 : 8 + length]).get("__metadata__", {}))


def _check_format(written: object) -> None:
    """Raise ModelFileError for a file of another version or another program."""
    if written == _FORMAT:
        return
    if str(written).startswith(_FAMILY):
        raise ModelFileError(
            f"was written by another version of this package: its format is {str(written)[:60]!r}, "
            f"and this version reads {_FORMAT!r}"
        )
    raise ModelFileError(
        f"is a safetensors file of another program, not a {_FORMAT!r} file; train one, or take one "
        "that `models` lists"
    )


def _check_weight_types(content: bytes) -> None:
    """Raise ModelFileError for weights of a type that NumPy lacks: bfloat16, float8.

    `safetensors.numpy` raises an error about an attribute of NumPy there.
    """
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    for name, entry in header.items():
        kind = entry.get("dtype") if name != "__metadata__" and isinstance(entry, dict) else "F32"
        if kind not in _NUMPY_TYPES:
            raise ModelFileError(
                f"has weights `{name}` of type {str(kind)[:20]}, which NumPy cannot read: write "
                "the file with float32 weights (F32), as `train` does"
            )


def _build(header: dict[str, Any], weights: dict[str, NDArray[np.float32]]) -> Model:
    """Return the model of a parsed header, every shape checked against the architecture."""
    architecture = Architecture(**_tuples(header["architecture"]))
    normaliser = Normaliser(**header["normaliser"])
    for config in (architecture, normaliser):
        _check_types(config)
        check(config)
    layout = _layout(header["layout"])
    p = len(layout)
    shapes = weight_shapes(architecture, p) | {"error_covariance": (3 * p, 3 * p)}
    hidden = _tuples(header.get("hidden_keypoints", []))  # older files have none
    if not isinstance(hidden, tuple) or any(name not in layout.keypoints for name in hidden):
        raise ValueError(f"hidden_keypoints are {str(hidden)[:60]}, not keypoints of the layout")
    if hidden:
        shapes["hidden_covariance"] = (3 * p, 3 * p)
    if "bone_lengths" in weights:  # older files have none
        b = len(layout.bone_indices())
        shapes["bone_lengths"] = (b, 2)
        if "bone_correlation" in weights:  # models that did not measure it have none
            shapes["bone_correlation"] = (b, b)
    for name, shape in shapes.items():
        weight = weights[name]
        if weight.shape != shape or weight.dtype != np.float32:
            raise ValueError(
                f"weight {name} is {weight.dtype} {weight.shape}; it must be float32 {shape}"
            )
        if not (np.abs(weight) < _LARGEST).all():  # NaN compares false
            raise ValueError(f"weight {name} has a number that is not below {_LARGEST:g}")
    frame = np.array(header["object_frame"], np.float64)
    # NaN and what would overflow compare false.
    if frame.shape != (3, 3) or not (np.abs(frame) < 2).all():
        raise ValueError("object_frame is not orthonormal (3, 3)")
    if not np.abs(frame @ frame.T - np.eye(3)).max() < 1e-3:
        raise ValueError("object_frame is not orthonormal (3, 3)")
    for name in {"error_covariance", "hidden_covariance"} & set(shapes):
        covariance = weights[name]
        if not (np.abs(covariance - covariance.T) <= 1e-5 * np.trace(covariance)).all():
            raise ValueError(f"{name} is not symmetric")
        if not np.linalg.eigvalsh(covariance)[0] > 0:
            raise ValueError(f"{name} is not positive definite")
    bone_lengths = weights.get("bone_lengths", np.zeros((0, 2), np.float32))
    if not (bone_lengths > _SMALLEST).all():
        raise ValueError(f"bone_lengths are not all above {_SMALLEST:g}")
    correlation = weights.get("bone_correlation", np.zeros((0, 0), np.float32))
    if correlation.size:
        if not (np.abs(correlation - correlation.T) <= 1e-5).all():
            raise ValueError("bone_correlation is not symmetric")
        if not (np.abs(correlation.diagonal() - 1) <= 1e-4).all():
            raise ValueError("bone_correlation is not 1 on its diagonal")
        if not np.linalg.eigvalsh(correlation)[0] > 0:
            raise ValueError("bone_correlation is not positive definite")
    return Model(
        str(header["name"]),
        Network.from_named_weights(architecture, weights),
        layout,
        normaliser,
        frame.astype(np.float32),
        dict(header["provenance"]),
        dict(header["quality"]),
        weights["error_covariance"],
        bone_lengths,
        correlation if "bone_lengths" in weights else correlation[:0, :0],
        hidden,
        weights["hidden_covariance"] if hidden else np.zeros(0, np.float32),
    )


def _tuples(value: Any) -> Any:
    """Return parsed JSON with its lists as tuples, as the dataclasses hold them."""
    if isinstance(value, list):
        return tuple(_tuples(item) for item in value)
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    return value


def _check_types(config: Any) -> None:
    """Raise ValueError for a value that has not the type of its default; JSON may hold anything."""
    for field_ in dataclasses.fields(config):
        default, value = field_.default, getattr(config, field_.name)
        if isinstance(default, float) and type(value) is int:
            continue
        items = value if isinstance(default, tuple) and isinstance(value, tuple) else (value,)
        kind = type(default[0] if isinstance(default, tuple) else default)
        if type(value) is not type(default) or any(type(item) is not kind for item in items):
            raise ValueError(f"{field_.name} is {value!r}; it must be like {default!r}")


def _layout(header: dict[str, Any]) -> KeypointLayout:
    """Return the layout of a header."""
    handedness = header["handedness"] or []
    if handedness and isinstance(handedness[0], str):  # the one of an older file
        handedness = [handedness]
    header = {"rigid": [], **_of_preset(header)} | header | {"handedness": handedness}
    if header["reference_length"] is None:
        header["reference_length"] = _of_preset(header)["reference_length"]
    _check_names(header)
    joints = joints_from_json(_tuples(header["joints"]))
    return KeypointLayout(**_tuples(header) | {"joints": joints})


def _of_preset(header: dict[str, Any]) -> dict[str, Any]:
    """Return top, bottom, joints and length of the preset that a header has the keypoints of.

    Older files lack these fields.
    """
    same = LAYOUTS.get(str(header["name"]))
    if same is None or list(same.keypoints) != header["keypoints"]:
        return {"top": [], "bottom": [], "joints": [], "reference_length": None}
    joints = [dataclasses.asdict(joint) for joint in same.joints]
    length = same.reference_length if [*(same.reference or ())] == header["reference"] else None
    ends = {"top": list(same.top), "bottom": list(same.bottom)}
    return ends | {"joints": joints, "reference_length": length}


def _check_names(layout: dict[str, Any]) -> None:
    """Raise ValueError unless every name in the header's layout is a text."""
    derived = layout["derived"]
    pairs = [*layout["edges"], *layout["rigid"], layout["reference"]]
    lists = [layout["keypoints"], *pairs, *layout["handedness"], layout["top"], layout["bottom"]]
    for names in ([layout["name"]], [*derived], *derived.values(), *lists):
        if not isinstance(names, (list, type(None))) or any(
            type(n) is not str for n in names or ()
        ):
            raise ValueError(f"layout has {str(names)[:60]} for names")


def check_name(option: str, name: str) -> None:
    """Raise ValueError unless `name`, given by `option`, can name a model and so its file."""
    if not _SAFE_NAME.fullmatch(name):
        raise ValueError(f"{option} is {name!r}; use letters, digits, '_', '-' and '.'")


def find_model(name_or_path: str, folders: Sequence[Path]) -> Path:
    """Return the file of a model given by path or by name in the first folder that has it.

    Raises ModelFileError that lists the models there are.
    """
    path = Path(name_or_path).expanduser()
    if path.suffix == MODEL_SUFFIX and path.is_file():
        return path
    for folder in folders:
        candidate = folder / f"{name_or_path}{MODEL_SUFFIX}"
        if candidate.is_file():
            return candidate
    reason = f"no model {name_or_path!r}"
    if len(path.parts) > 1:
        kind = "folder" if path.is_dir() else "file"
        wrong = f"is a {kind}, not a model file ({MODEL_SUFFIX})"
        reason = f"model {name_or_path!r} {wrong if path.exists() else 'does not exist'}"
    names = sorted({f.stem for folder in folders for f in folder.glob(f"*{MODEL_SUFFIX}")})
    raise ModelFileError(f"{reason}; there are {', '.join(names) or 'none'} in {in_words(folders)}")
