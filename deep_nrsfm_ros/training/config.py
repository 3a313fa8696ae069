# SPDX-License-Identifier: Apache-2.0
"""The configuration of a training: one frozen dataclass for all who start, record or resume one.

The command line builds it with `from_arguments`, the service of the lifter with
`request.training_config`. `to_json` gives the text that the record on disk holds and that
`train --config` takes. `validation.validate` checks it for all of them.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from deep_nrsfm_ros.configuration import options
from deep_nrsfm_ros.data.curation import KEEP_ALL, Curation
from deep_nrsfm_ros.data.keypoint_files import recordings
from deep_nrsfm_ros.data.read_options import DEFAULT_READ_OPTIONS
from deep_nrsfm_ros.data.varied_images import ImageVariation
from deep_nrsfm_ros.layouts.presets import HUMAN25
from deep_nrsfm_ros.model_files.folders import default_models_dir, model_folders
from deep_nrsfm_ros.model_files.matching_model import FROM_NONE, matching_model
from deep_nrsfm_ros.model_files.model_file import find_model, load_once
from deep_nrsfm_ros.nrsfm.network import Architecture
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, LayoutLossWeights, Preset, Recipe
from deep_nrsfm_ros.training.limits import WHOLE, Limits
from deep_nrsfm_ros.wording import is_in_node


@dataclass(frozen=True)
class DataConfig:
    """Where the frames come from: bags and files of keypoints, or motion capture.

    Attributes:
        bags: bag folders or files (.db3, .mcap, .bag of ROS 1); empty for motion capture.
        inputs: files or folders of keypoints of any kind that `lift` reads, beside the bags.
        topic: keypoint topic in the bags, `*` allowed; "" is the only one.
        keypoint_layout: order of the keypoints in bags and files, as `find_layout` takes it; "" is
            what they say themselves, or else what fits (see `layout_choice`).
        min_confidence: keypoints of less confidence count as missing, 0 to 1.
        mapping: field mapping (.yaml) for messages of other types; "" is none.
        missing_value, min_score, category: as in `ReadOptions`, for bags and files.
        image_width, image_height: pixels, for keypoints given as shares of the image; 0 unknown.
        hands: what is known of recorded hands, one of `data.hands.SIDES`; "" is nothing.
        cmu: folder of the CMU motion capture (NN/NN.asf, NN/*.amc); None for keypoints.
        subjects: folders of the CMU subjects.
        all_trials: take all trials of a subject, not only the paper's first floor(0.8 N).
        stride: take every n-th CMU frame.
        camera_seed: seed of the random cameras of the CMU frames.
        cameras: random cameras that project each CMU frame, 1 to 8 typical.
        virtual_people: number of virtual people in CMU poses from which the last step learns error
            covariance and bones; 0 is from frames of the training.
    """

    bags: tuple[Path, ...] = ()
    inputs: tuple[Path, ...] = ()
    topic: str = ""
    keypoint_layout: str = ""
    min_confidence: float = 0.1
    mapping: str = ""
    missing_value: float | None = DEFAULT_READ_OPTIONS.missing_value
    min_score: float = DEFAULT_READ_OPTIONS.min_score
    category: str = DEFAULT_READ_OPTIONS.category
    image_width: int = 0
    image_height: int = 0
    hands: str = ""
    cmu: Path | None = None
    subjects: tuple[str, ...] = ("01",)
    all_trials: bool = False
    stride: int = 1
    camera_seed: int = 0
    cameras: int = 1
    virtual_people: int = 0

    @property
    def image_size(self) -> tuple[int, int] | None:
        """Return (width, height) in pixels, None where it is unknown."""
        size = (self.image_width, self.image_height)
        return size if all(size) else None

    def own_bags(self) -> list[Path]:
        """Return the bags that `bags` names, each once."""
        return _once(list(map(Path.expanduser, self.bags)))[0]

    def files(self) -> list[Path]:
        """Return the recordings that `inputs` names, also those in its folders, each once.

        One that `bags` names, too, is not among them.
        """
        bags = self.own_bags()
        return _once([*bags, *self._named_files()])[0][len(bags) :]

    def repeated(self) -> list[Path]:
        """Return the bags and files that are named more than once."""
        return _once([*map(Path.expanduser, self.bags), *self._named_files()])[1]

    def _named_files(self) -> list[Path]:
        """Return the recordings that `inputs` names, as often as it names them."""
        return [path for named in self.inputs for path in recordings(named.expanduser())]


@dataclass(frozen=True)
class OutputConfig:
    """Where the model goes, and the threads that make it.

    Attributes:
        folder: folder of models.
        name: name of the model; `same_name` says what becomes of one that has it.
        threads: threads of torch; 0 is one a core.
    """

    folder: Path = field(default_factory=default_models_dir)
    name: str = "trained"
    threads: int = 0


@dataclass(frozen=True)
class TrainingConfig:
    """All that defines a training.

    Attributes:
        data: where the frames come from.
        object: layout of the model, as `find_layout` takes it, or "numbered"; "" is the layout of
            `start`, or human25.
        start: model file to start from; "" starts from random weights.
        rival: model file that the new model is compared with, or ""; see `judge`.
        architecture, normaliser, recipe: the parts of a preset.
        layout_loss: weights of the losses that the layout defines.
        variation: which CMU images lack parts of the body, and which are mirrored.
        curation: which frames and keypoints are left out.
        limits: when the training ends before its last step, and which state it keeps.
        output: folder and name of the model, threads.
        resume: continue from the checkpoint of this name, if there is one.
    """

    data: DataConfig = field(default_factory=DataConfig)
    object: str = ""
    start: str = ""
    rival: str = ""
    architecture: Architecture = field(default_factory=Architecture)
    normaliser: Normaliser = field(default_factory=Normaliser)
    recipe: Recipe = field(default_factory=Recipe)
    layout_loss: LayoutLossWeights = field(default_factory=LayoutLossWeights)
    variation: ImageVariation = field(default_factory=ImageVariation)
    curation: Curation = field(default_factory=Curation)
    limits: Limits = field(default_factory=Limits)
    output: OutputConfig = field(default_factory=OutputConfig)
    resume: bool = False

    @classmethod
    def from_arguments(
        cls, arguments: argparse.Namespace, base: TrainingConfig | None = None
    ) -> TrainingConfig:
        """Return `base` with the options that a command line gives.

        Args:
            arguments: holds only the options that were given, by field name, and `preset`. Without
                `start` and `base`, the training starts from a model that has the object's
                keypoints, if there is one; "none" starts from random weights.
            base: the options that were not given. None is the defaults: those for motion capture
                keep all frames and the state after the last step, as that data is clean.

        Raises:
            ValueError: the model to start from is missing or damaged.
        """
        values: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in vars(arguments).items()
        }
        has_base = base is not None
        if base is None:
            base = cls(limits=WHOLE, curation=KEEP_ALL) if values.get("cmu") else cls()
        if "preset" in values:
            base = base.with_preset(PRESETS[values["preset"]])
        start = values.pop("start", "")
        network_options = {"preset"} | {
            item.name for part in (Architecture, Normaliser) for item in dataclasses.fields(part)
        }
        if start and start != FROM_NONE:
            folder = values.get("folder", base.output.folder)
            return base.with_start(find_model(start, model_folders(folder))).with_options(values)
        config = base.with_options(values)
        if (has_base and not start) or not (config.data.bags or config.data.inputs):
            return dataclasses.replace(config, start="") if start else config
        known = str(matching_model(config.object or HUMAN25.name) or "")
        config = dataclasses.replace(config, start="", rival=known)
        if known and not start and not network_options & values.keys():
            return config.with_start(Path(known))
        return config

    def with_preset(self, preset: Preset) -> TrainingConfig:
        """Return the configuration with architecture, normaliser and recipe of `preset`."""
        return dataclasses.replace(self, **preset._asdict())

    def with_start(self, path: Path) -> TrainingConfig:
        """Return the configuration that starts from a model, with its architecture and normaliser.

        The model is also the one that the new model is compared with.

        Raises ValueError for a file that is missing or damaged.
        """
        model = load_once(path)
        return dataclasses.replace(
            self,
            start=str(path),
            rival=str(path),
            architecture=model.network.architecture,
            normaliser=model.normaliser,
        )

    def with_options(self, values: Mapping[str, Any]) -> TrainingConfig:
        """Return the configuration with the fields of all parts that `values` names replaced."""
        changes: dict[str, Any] = {}
        for part in dataclasses.fields(self):
            old = getattr(self, part.name)
            if dataclasses.is_dataclass(old) and not isinstance(old, type):
                names = {item.name for item in dataclasses.fields(old)} & values.keys()
                for item, _, opt in options(type(old)):  # by the names that the caller knows
                    if item.name in names:
                        opt.check(option_names()(item.name), values[item.name])
                changes[part.name] = dataclasses.replace(old, **{k: values[k] for k in names})
            elif part.name in values:
                changes[part.name] = values[part.name]
        return dataclasses.replace(self, **changes)

    @property
    def preset(self) -> Preset:
        """Return architecture, normaliser and recipe."""
        return Preset(self.architecture, self.normaliser, self.recipe)

    def whole(self) -> TrainingConfig:
        """Return the configuration with absolute paths, valid in any working folder."""
        data = self.data
        return dataclasses.replace(
            self,
            data=dataclasses.replace(
                data,
                bags=tuple(map(_absolute, data.bags)),
                inputs=tuple(map(_absolute, data.inputs)),
                keypoint_layout=_absolute_file(data.keypoint_layout),
                mapping=_absolute_file(data.mapping),
                cmu=data.cmu and _absolute(data.cmu),
            ),
            object=_absolute_file(self.object),
            start=_absolute_file(self.start),
            rival=_absolute_file(self.rival),
            output=dataclasses.replace(self.output, folder=_absolute(self.output.folder)),
        )

    def to_json(self) -> str:
        """Return the configuration as JSON, an object a part, with absolute paths."""
        return json.dumps(dataclasses.asdict(self.whole()), indent=1, default=str)

    @classmethod
    def from_json(cls, text: str) -> TrainingConfig:
        """Return the configuration that `to_json` has written; fields left out have defaults.

        Raises ValueError that names the field for anything else.
        """
        try:
            values = json.loads(text)
        except RecursionError as error:
            raise ValueError("no configuration: it is nested too deeply") from error
        config = _decode(cls, values, "")
        assert isinstance(config, cls)
        return config


@dataclass(frozen=True)
class OptionNames:
    """The names under which one caller sets the fields of a `TrainingConfig`, for its messages.

    Attributes:
        prefix: what every name begins with, e.g. "--".
        separator: what stands between the words of a field's name, e.g. "-".
        others: names that do not follow from the field's; "data" is how to name any data at all.
    """

    prefix: str
    separator: str
    others: Mapping[str, str]

    def __call__(self, field_name: str) -> str:
        """Return the name of a field, e.g. "--min-change" of `min_change`."""
        name = self.prefix + field_name.replace("_", self.separator)
        return self.others.get(field_name, name)


COMMAND_LINE = OptionNames(
    "--",
    "-",
    {
        "bags": "--bag",
        "inputs": "--input",
        "folder": "--output",
        "start": "--from",
        "data": "--bag and --input (both repeatable), or --cmu with --subjects",
    },
)
PARAMETERS = OptionNames(
    "train.",
    "_",
    {
        "start": "train.from",
        "folder": "models_dir",
        "mapping": "input_type",
        "min_confidence": "min_confidence",
        "image_width": "image_width",
        "image_height": "image_height",
        "min_score": "min_score",
        "data": "train.bags and train.inputs",
    },
)


def option_names() -> OptionNames:
    """Return the names by which the reader of a training's sentences sets options."""
    return PARAMETERS if is_in_node() else COMMAND_LINE


def differences(old: TrainingConfig, new: TrainingConfig, names: OptionNames) -> list[str]:
    """Return in words each option in which `new` differs from `old`.

    Output, resume and the model to compare with do not count.
    """
    before, after = (_flat(config) for config in (old, new))
    return [
        f"{names(name)} was {option_text(value)}, is {option_text(after[name])} now"
        for name, value in before.items()
        if after[name] != value
    ]


def option_text(value: Any) -> str:
    """Return the value of an option for a message: words apart by spaces, or "empty"."""
    words = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return "empty" if value is None or not words else words


def _flat(config: TrainingConfig) -> dict[str, Any]:
    """Return the options of all parts by field name, without output, rival and resume."""
    config = config.whole()
    flat: dict[str, Any] = {}
    for part in dataclasses.fields(config):
        value = getattr(config, part.name)
        if part.name in ("output", "rival", "resume"):
            continue
        if dataclasses.is_dataclass(value):
            flat |= {item.name: getattr(value, item.name) for item in dataclasses.fields(value)}
        else:
            flat[part.name] = value
    return flat


def _once(paths: list[Path]) -> tuple[list[Path], list[Path]]:
    """Return each path once, and each of those that come again, by the files that they name."""
    kept, again = dict[Path, Path](), dict[Path, Path]()
    for path in paths:
        whole = path.resolve()
        (again if whole in kept else kept).setdefault(whole, path)
    return list(kept.values()), list(again.values())


def _absolute(path: Path) -> Path:
    """Return an absolute path, `~` expanded."""
    return path.expanduser().absolute()


def _absolute_file(name_or_path: str) -> str:
    """Return the absolute path of a file, or a name as it is: only a file has a suffix."""
    path = Path(name_or_path)
    if path.suffix and path.expanduser().is_file():
        return str(_absolute(path))
    return name_or_path


def _decode(kind: Any, value: Any, name: str) -> Any:
    """Return a JSON value as the type `kind`; raise ValueError that names the field `name`."""
    if dataclasses.is_dataclass(kind) and isinstance(kind, type) and isinstance(value, dict):
        hints = typing.get_type_hints(kind)
        inside = f"{name}." if name else ""
        if unknown := value.keys() - hints.keys():
            raise ValueError(f"{inside}{min(unknown)} is no option of a training")
        return kind(**{k: _decode(hints[k], item, inside + k) for k, item in value.items()})
    if typing.get_origin(kind) is types.UnionType:
        if value is None:
            return None
        kind = next(item for item in typing.get_args(kind) if item is not types.NoneType)
    if typing.get_origin(kind) is tuple and isinstance(value, list):
        return tuple(_decode(typing.get_args(kind)[0], item, name) for item in value)
    if kind is Path and isinstance(value, str):
        return Path(value)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind in (str, int, float, bool) and type(value) is kind:
        return value
    raise ValueError(f"{name or 'the configuration'} is {value!r}; it has another type")
