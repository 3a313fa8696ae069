"""What the service ~/train is asked for, checked, as the command line of the training."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deep_nrsfm_ros.configuration import option, to_arguments
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.messages.mapping_file import MAPPING_SUFFIXES
from deep_nrsfm_ros.messages.pipeline import MODEL_ORDER
from deep_nrsfm_ros.model_files.find_layout import NUMBERED, find_layout
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, check_name, load_model
from deep_nrsfm_ros.model_files.path_sandbox import PathSandbox
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.fine_tuning import start_from
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.record import (
    TrainingRecord,
    check_room,
    checkpoint_file,
    differences,
    find_records,
    look,
    record_file,
)


@dataclass(frozen=True)
class TrainingOptions:
    """What ~/train trains on, and what becomes of it."""

    bags: tuple[str, ...] = option((), "rosbag2 folders or files to train on")
    topic: str = option("", "topic in the bags; empty: the one that the lifter listens to")
    object: str = option(
        "",
        "layout of the new model: a preset, the path of a layout file or of a model file, or "
        "'numbered' for points without names; empty: that of train.from, or of the present model",
    )
    keypoint_layout: str = option(
        "",
        "order of the keypoints in the bags; empty: as the parameter keypoint_layout says, and "
        "where that is 'model', that of train.object if it is set",
    )
    from_: str = option(
        "",
        "model to start from, by name or path, its keypoints matched by name; empty: from chance",
    )
    name: str = option("trained", "name of the new model; an old one of this name is replaced")
    threads: int = option(1, "threads that the training may use", low=1, high=1024)
    max_minutes: float = option(
        0.0,
        "most wall time that train.minutes may ask for, and what a training gets that asks for no "
        "limit; 0: no limit",
        low=0.0,
        high=100_000.0,
        read_only=True,
    )
    resume: bool = option(
        False,
        "go on with the training of train.name that was cut off, with the bags and options that it "
        "began with",
    )
    activate: bool = option(True, "switch to the new model when the training has finished")


def paths_of(wanted: TrainingOptions) -> tuple[str, ...]:
    """Return every option that may be a path."""
    return (*wanted.bags, wanted.object, wanted.keypoint_layout, wanted.from_)


def sandboxed(wanted: TrainingOptions, sandbox: PathSandbox) -> TrainingOptions:
    """Return the options with whole paths; raise ValueError for what leads out of the sandbox."""
    check_name("train.name", wanted.name)
    folder, name = sandbox.models_dir, wanted.name
    results = (folder / f"{name}{suffix}" for suffix in (MODEL_SUFFIX, ".html"))
    traces = (checkpoint_file(folder, name), record_file(folder, name))
    sandbox.outputs("train.name", (*results, *traces))
    return dataclasses.replace(
        wanted,
        bags=tuple(sandbox.bag("train.bags", bag) for bag in wanted.bags),
        object=sandbox.layout("train.object", wanted.object),
        keypoint_layout=sandbox.layout("train.keypoint_layout", wanted.keypoint_layout),
        from_=str(sandbox.model("train.from", wanted.from_)) if wanted.from_ else "",
    )


def limited(wished: Limits, max_minutes: float) -> Limits:
    """Return the limits within the owner's; raise ValueError for a wish beyond them."""
    if not max_minutes:
        return wished
    if wished.minutes > max_minutes:
        raise ValueError(
            f"train.minutes is {wished.minutes:g}; the owner of the lifter allows at most "
            f"{max_minutes:g} (train.max_minutes)"
        )
    return dataclasses.replace(wished, minutes=wished.minutes or max_minutes)


def layouts(wanted: TrainingOptions, heard: str, model: Path, start: str) -> tuple[str, str]:
    """Return source and target of a request, as `TrainingRequest` has them.

    heard: the lifter's parameter keypoint_layout. model: the file of the present model. start:
    that of the model to start from, or "".
    """
    target = wanted.object or start or str(model)
    if wanted.keypoint_layout or target == NUMBERED:
        return wanted.keypoint_layout, target
    return (wanted.object or str(model)) if heard == MODEL_ORDER else heard, target


@dataclass(frozen=True)
class TrainingRequest:
    """Everything that a training is told.

    source_layout, target_layout: those of the bags and of the new model, each as `find_layout`
        takes it; the target may be "numbered", the source is then empty.
    start: the file of the model to start from, or "".
    input_type, image_width, image_height: those of the lifter. Bags tell the types of their
        messages; a field mapping says how to read those of a type that is not known.
    """

    options: TrainingOptions
    recipe: Recipe
    topic: str
    source_layout: str
    target_layout: str
    start: str
    min_confidence: float
    output: Path
    curation: Curation = Curation()
    limits: Limits = Limits()
    layout_loss: LayoutLossWeights = LayoutLossWeights()
    input_type: str = ""
    image_width: int = 0
    image_height: int = 0

    def check(self) -> str:
        """Return what should be known before, or ""; raise ValueError that says what is wrong."""
        check_name("train.name", self.options.name)
        check_room(self.output, self.limits.free_disk)
        if self.options.resume and (found := self._unfinished()).asked:
            now = differences(found.asked, self._asked())
            said = f"{'; '.join(now)}; it keeps to what it began with" if now else ""
            return f"goes on with {found}" + (f"; {said}" if said else "")
        if not self.options.bags:
            raise ValueError("no bags to train on; set the parameter train.bags")
        for bag in self.options.bags:
            if not Path(bag).expanduser().exists():
                raise ValueError(f"train.bags names {bag}, which does not exist")
        if self.target_layout == NUMBERED:
            self.layout_loss.check(KeypointLayout(NUMBERED, ()))
            if self.source_layout:
                raise ValueError(
                    f"train.object is {NUMBERED!r}: its points come as they are in the bags; "
                    "empty train.keypoint_layout, or name an object"
                )
            return KeypointLayout(NUMBERED, ()).warning
        source = find_layout("train.keypoint_layout", self.source_layout)
        target = find_layout("train.object", self.target_layout)
        KeypointMap(source, target)
        self.layout_loss.check(target)
        if self.start:
            start_from(load_model(Path(self.start)), target)
        return target.warning

    def arguments(self) -> list[str]:
        """Return the arguments of the training command."""
        words = ["--name", self.options.name, "--output", str(self.output)]
        words += ["--threads", str(self.options.threads), "--json-progress"]
        if self.options.resume:
            words += ["--resume"]
            if self._unfinished().asked:
                return words
        named = {
            "--topic": self.topic,
            "--keypoint-layout": self.source_layout,
            "--object": self.target_layout,
            "--from": self.start,
            "--min-confidence": str(self.min_confidence),
            "--mapping": self._mapping,
            "--image-width": str(self.image_width),
            "--image-height": str(self.image_height),
        }
        words += [f"{name}={value}" for name, value in named.items()]  # even one that begins with -
        for bag in self.options.bags:
            words += [f"--bag={Path(bag).expanduser()}"]
        for config in (self.recipe, self.layout_loss, self.limits, self.curation):
            words += to_arguments(config)
        return words

    @property
    def _mapping(self) -> str:
        """Return the file of the field mapping, or ""."""
        return self.input_type if self.input_type.endswith(MAPPING_SUFFIXES) else ""

    def _unfinished(self) -> TrainingRecord:
        """Return the training to go on with; raise ValueError if there is none."""
        name, others = self.options.name, find_records(self.output)
        found = look(self.output, name)
        if found is None:
            names = ", ".join(other.name for other in others) or "none"
            raise ValueError(
                f"train.resume is true, but there is no unfinished training of {name!r} in "
                f"{self.output} (unfinished: {names}); set train.resume to false to begin one"
            )
        if found.running:
            raise ValueError(f"{found}: {found.advice}")
        return found

    def _asked(self) -> dict[str, Any]:
        """Return what the training would be asked for, by the names that its record has."""
        return {
            "bag": [Path(bag) for bag in self.options.bags],
            "topic": self.topic,
            "keypoint_layout": self.source_layout,
            "object": self.target_layout,
            "start": self.start,
            "min_confidence": self.min_confidence,
            "mapping": self._mapping,
            "image_width": self.image_width,
            "image_height": self.image_height,
            **dataclasses.asdict(self.recipe),
            **dataclasses.asdict(self.layout_loss),
            **dataclasses.asdict(self.limits),
            **dataclasses.asdict(self.curation),
        }
