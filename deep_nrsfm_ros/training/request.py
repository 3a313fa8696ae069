# SPDX-License-Identifier: Apache-2.0
"""What the service ~/train is asked for: parameters of the lifter, as a `TrainingConfig`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.data.bag_files import open_bag, opens_quickly
from deep_nrsfm_ros.data.bag_topics import keypoint_topics
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.data.hands import SIDES
from deep_nrsfm_ros.data.keypoint_files import is_bag
from deep_nrsfm_ros.messages.options import AUTO, MODEL_ORDER
from deep_nrsfm_ros.model_files.find_layout import NUMBERED
from deep_nrsfm_ros.model_files.matching_model import FROM_NONE, matching_model
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, check_name
from deep_nrsfm_ros.model_files.path_sandbox import PathSandbox
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.config import PARAMETERS, DataConfig, OutputConfig, TrainingConfig
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.record import checkpoint_file, record_file
from deep_nrsfm_ros.training.resume import resume_request
from deep_nrsfm_ros.training.same_name import BEFORE, DOUBTFUL, UNFINISHED
from deep_nrsfm_ros.training.validation import read_field_mapping, validate

UNKNOWN_SIDE = "unknown"
"""Value of `train.hands` where nothing is known of recorded hands."""


@dataclass(frozen=True)
@described
class TrainingOptions:
    """Data and result of the service ~/train: the parameters `train.*` that no other part has."""

    bags: tuple[str, ...] = option(
        (),
        "rosbag2 folders or files to train on; they lie in the folder of the parameter bags_dir, "
        "where relative names begin",
    )
    inputs: tuple[str, ...] = option(
        (),
        "files of keypoints to train on beside the bags, of any kind that `lift` reads, or folders "
        "of such recordings; they lie in bags_dir, too",
    )
    topic: str = option(
        "",
        "topic in the bags; empty = the topic that the lifter listens to, or where a bag lacks it, "
        "the only topic with keypoints",
    )
    object: str = option(
        "",
        "layout of the new model: a preset, the path of a layout file or of a model file, or "
        "'numbered' for points without names; empty = that of train.from, or of the present model",
    )
    keypoint_layout: str = option(
        "",
        "order of the keypoints in the bags; empty = that of the parameter keypoint_layout; where "
        "that is 'model', the layout of train.object if it is set; where it is 'auto' and no "
        "message has shown it yet, the layout that fits the recording best",
    )
    hands: str = option(
        UNKNOWN_SIDE,
        "what recorded hands are, for a model of right hands: right; left = mirrored before the "
        "training; palms = each hand shows its palm, so that those that look like left ones are "
        "mirrored; unknown = taken as they are, and the model is doubtful if both sides are mixed",
        choices=(UNKNOWN_SIDE, *SIDES),
    )
    from_: str = option(
        "",
        "model to start from, by name or path; keypoints are matched by name; empty = the present "
        "model or one of the package, if it has most keypoints of the object; 'none' = random "
        "weights",
    )
    name: str = option(
        "trained",
        "name of the new model, not one of the package's; a good model of this name is replaced "
        "only by one that is not doubtful beside it, and is kept as NAME_before",
    )
    threads: int = option(1, "threads that the training may use", low=1, high=1024)
    max_minutes: float = option(
        0.0,
        "largest value of train.minutes, in minutes of wall time, and the limit of a training that "
        "sets none; 0 = no limit",
        low=0.0,
        high=100_000.0,
        read_only=True,
    )
    resume: bool = option(
        False,
        "continue the training of train.name that was cut off, with the bags and options that it "
        "began with",
    )
    activate: str = option(
        "if_better",
        "whether to switch to the new model when the training has finished: if_better = if its "
        "figures without labels are not worse than those of the present one (nor `unknown`, since "
        "that was trained on the frames of the comparison), it is of the object "
        "that the lifter lifts, and its depth cannot be mirrored as a whole; always; never",
        choices=("if_better", "always", "never"),
    )


@dataclass(frozen=True)
class TrainingParameters:
    """All parameters `train.*` of the lifter, a dataclass a group."""

    options: TrainingOptions
    recipe: Recipe
    layout_loss: LayoutLossWeights
    limits: Limits
    curation: Curation


@dataclass(frozen=True)
class LifterInput:
    """What the lifter receives: a training takes it for the content of the bags.

    Attributes:
        topic: its topic, "" where it listens to none or to several.
        keypoint_layout: order of the keypoints in its messages, as `find_layout` takes it; "model"
            is that of `model`, "auto" not yet known.
        model: file of its present model.
        min_confidence: keypoints of less confidence count as missing, 0 to 1.
        mapping: field mapping (.yaml) of its messages, or "".
        image_width, image_height: pixels, 0 where unknown.
        min_score: objects of less score are left out.
    """

    topic: str
    keypoint_layout: str
    model: Path
    min_confidence: float
    mapping: str = ""
    image_width: int = 0
    image_height: int = 0
    min_score: float = 0.0


@dataclass(frozen=True)
class TrainingRequest:
    """A training that is asked for.

    Attributes:
        config: its configuration.
        activate: whether the lifter then switches to its model: "if_better", "always", "never".
    """

    config: TrainingConfig
    activate: str = "if_better"

    def accept(self) -> tuple[TrainingConfig, str]:
        """Return the configuration to train with, and what the user should know of it, or "".

        Raises ValueError that names the parameter that is wrong.
        """
        check_name(PARAMETERS("name"), self.config.output.name)
        config, message = self.config, ""
        if config.resume:
            config, message = resume_request(config)
        warning = validate(config, PARAMETERS)
        return config, message or warning


def training_request(
    parameters: TrainingParameters, lifter: LifterInput, sandbox: PathSandbox
) -> TrainingRequest:
    """Return the training that the parameters of the lifter ask for.

    Raises ValueError for a path outside of the sandbox, for more minutes than the owner allows, or
    for a damaged model to start from.
    """
    options = sandboxed(parameters.options, sandbox)
    source, target = choose_layouts(options, lifter)
    data = DataConfig(tuple(map(Path, options.bags)), tuple(map(Path, options.inputs)))
    bags = [*data.bags, *filter(is_bag, data.files())]
    has_topic = bags or not data.inputs  # a resumed training names no data
    config = TrainingConfig(
        data=dataclasses.replace(
            data,
            topic=options.topic or (choose_topic(bags, lifter) if has_topic else ""),
            keypoint_layout=source,
            min_confidence=lifter.min_confidence,
            mapping=lifter.mapping,
            image_width=lifter.image_width,
            image_height=lifter.image_height,
            min_score=lifter.min_score,
            hands="" if options.hands == UNKNOWN_SIDE else options.hands,
        ),
        object=target,
        recipe=parameters.recipe,
        layout_loss=parameters.layout_loss,
        curation=parameters.curation,
        limits=limited(parameters.limits, options.max_minutes),
        output=OutputConfig(sandbox.models_dir, options.name, options.threads),
        resume=options.resume,
    )
    known = matching_model(target, [lifter.model])
    start = Path(options.from_) if options.from_ else known
    if start and options.from_ != FROM_NONE:
        config = config.with_start(start)
    config = dataclasses.replace(config, rival=str(known or config.rival))
    return TrainingRequest(config, options.activate)


def choose_topic(bags: Sequence[Path], lifter: LifterInput) -> str:
    """Return the topic that the lifter listens to, or the only one with keypoints in all the bags.

    It is "" where each bag has another one, or where the lifter listens to no single topic. Bags
    that cannot be used have no say: `validate` refuses them.
    """
    if not lifter.topic:
        return ""
    topics: set[str] = set()
    for bag in bags:
        with suppress(ValueError, OSError):
            if not opens_quickly(bag):
                continue
            with closing(open_bag(bag)) as opened:
                if any(t.name == lifter.topic for t in opened.topics if opened.has_messages(t)):
                    return lifter.topic
                mapping = read_field_mapping(lifter.mapping)
                topics |= {found.topic.name for found in keypoint_topics(opened, "", mapping)}
    if not topics:
        return lifter.topic
    return topics.pop() if len(topics) == 1 else ""


def data_in_words(data: DataConfig) -> str:
    """Return the data of a training, e.g. "/keypoints of bag_1, bag_2 and hands.npz"."""
    bags, inputs = (", ".join(map(str, named)) for named in (data.bags, data.inputs))
    if not bags:
        return inputs
    return f"{data.topic or 'the keypoint topic'} of {bags}" + (f" and {inputs}" if inputs else "")


def choose_layouts(options: TrainingOptions, lifter: LifterInput) -> tuple[str, str]:
    """Return the layouts of the bags and of the new model, each as `find_layout` takes it.

    What `options` leaves empty follows from the lifter's input and model. The layout of the bags is
    "" where the new model is "numbered", or where the training finds it.
    """
    start = "" if options.from_ == FROM_NONE else options.from_
    target = options.object or start or str(lifter.model)
    if options.keypoint_layout or target == NUMBERED:
        return options.keypoint_layout, target
    if lifter.keypoint_layout == AUTO:
        return "", target
    if lifter.keypoint_layout == MODEL_ORDER:
        return options.object or str(lifter.model), target
    return lifter.keypoint_layout, target


def paths_of(options: TrainingOptions) -> tuple[str, ...]:
    """Return the values of all options that may be paths."""
    start = "" if options.from_ == FROM_NONE else options.from_
    return (*options.bags, *options.inputs, options.object, options.keypoint_layout, start)


def sandboxed(options: TrainingOptions, sandbox: PathSandbox) -> TrainingOptions:
    """Return the options with absolute paths; raise ValueError for a path outside the sandbox."""
    check_name("train.name", options.name)
    folder, name = sandbox.models_dir, options.name
    names = [f"{name}{end}" for end in ("", BEFORE, DOUBTFUL, UNFINISHED)]
    results = (folder / f"{each}{suffix}" for each in names for suffix in (MODEL_SUFFIX, ".html"))
    traces = (of(folder, each) for each in names for of in (checkpoint_file, record_file))
    sandbox.outputs("train.name", (*results, *traces))
    return dataclasses.replace(
        options,
        bags=tuple(sandbox.recording("train.bags", word) for word in options.bags),
        inputs=tuple(sandbox.recording("train.inputs", word) for word in options.inputs),
        object=sandbox.layout("train.object", options.object),
        keypoint_layout=sandbox.layout("train.keypoint_layout", options.keypoint_layout),
        from_=(
            str(sandbox.model("train.from", options.from_))
            if options.from_ not in ("", FROM_NONE)
            else options.from_
        ),
    )


def limited(limits: Limits, max_minutes: float) -> Limits:
    """Return the limits within the owner's `max_minutes`, 0 being no limit.

    Raises ValueError where they ask for more.
    """
    if not max_minutes:
        return limits
    if limits.minutes > max_minutes:
        raise ValueError(
            f"train.minutes is {limits.minutes:g}; the owner of the lifter allows at most "
            f"{max_minutes:g} (train.max_minutes)"
        )
    return dataclasses.replace(limits, minutes=limits.minutes or max_minutes)
