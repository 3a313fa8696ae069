# SPDX-License-Identifier: Apache-2.0
"""The checks of a training that need no data: the same for the command line and the service."""

from __future__ import annotations

import dataclasses
from contextlib import closing
from pathlib import Path

from deep_nrsfm_ros.configuration import options
from deep_nrsfm_ros.data.bag_files import BagError, open_bag, opens_quickly
from deep_nrsfm_ros.data.bag_topics import keypoint_topics
from deep_nrsfm_ros.data.hands import check_side
from deep_nrsfm_ros.data.keypoint_files import is_bag
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.extras import require_extra
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17, HUMAN25
from deep_nrsfm_ros.messages.field_mapping import FieldMapping
from deep_nrsfm_ros.messages.mapping_file import read_mapping
from deep_nrsfm_ros.model_files.find_layout import NUMBERED, find_layout
from deep_nrsfm_ros.model_files.model_file import check_name, load_once
from deep_nrsfm_ros.training.config import DataConfig, OptionNames, TrainingConfig
from deep_nrsfm_ros.training.disk import check_room
from deep_nrsfm_ros.training.fine_tuning import check_fixed_options, start_from
from deep_nrsfm_ros.training.limb_exchange import LimbExchange, check_limb_exchange
from deep_nrsfm_ros.training.same_name import check_not_shipped

_NUMBERED_LAYOUT = KeypointLayout(NUMBERED, ())  # its points are counted when the bags are read

_OF_BAGS = (
    *("topic", "keypoint_layout", "min_confidence", "mapping", "image_width", "image_height"),
    *("missing_value", "min_score", "category", "hands"),
)
_OF_CMU = ("subjects", "all_trials", "stride", "camera_seed", "cameras", "virtual_people")


def validate(config: TrainingConfig, names: OptionNames) -> str:
    """Check all that can be checked before the data are read.

    Args:
        config: the configuration to check.
        names: the names of the options in the messages.

    Returns:
        A warning about bags that cannot be used and the layout of the model, or "".

    Raises:
        ValueError: names the first option that is wrong, and says what to do.
    """
    check_name(names("name"), config.output.name)
    check_not_shipped(names("name"), config.output.name, config.output.folder)
    _check_ranges(config, names)
    require_extra("train", "training")
    _check_data(config, names)
    source, target = find_layouts(config, names)
    if target != _NUMBERED_LAYOUT:
        try:
            KeypointMap(source, target)
        except ValueError as error:
            raise ValueError(
                f"{error}; set {names('keypoint_layout')} to the layout of the "
                f"recorded keypoints, for which {source.name!r} is taken now, or {names('object')}"
            ) from None
    config.layout_loss.check(target, names)
    if config.data.cmu:
        config.variation.check(target, names)
    check_limb_exchange(config.recipe.limb_exchange, names("limb_exchange"))
    if config.recipe.limb_exchange > 0:
        try:
            LimbExchange(target)
        except ValueError as error:
            raise ValueError(
                f"{names('limb_exchange')} is {config.recipe.limb_exchange:g}, but {error}; give "
                "it edges in a layout file, or set it to 0"
            ) from None
    people = (HUMAN17.keypoints, HUMAN25.keypoints)
    if config.data.virtual_people and target.keypoints not in people:
        raise ValueError(
            f"{names('virtual_people')} has the keypoints of {HUMAN17.name} or {HUMAN25.name}, "
            f"and the model those of {target.name!r}: leave it out"
        )
    if not config.recipe.steps and not config.start:
        raise ValueError(f"{names('steps')} is 0: name the model to keep with {names('start')}")
    if config.start:
        start = load_once(Path(config.start))
        if target != _NUMBERED_LAYOUT:
            start_from(start, target)
        check_fixed_options(start, config.preset, names)
    check_room(names("free_disk"), config.output.folder, config.limits.free_disk)
    left_out = look_into_bags(config, names, source)
    handedness = "" if config.start else target.warning  # a start passes its handedness on
    return "; ".join(filter(None, (*left_out, handedness)))


def find_layouts(
    config: TrainingConfig, names: OptionNames
) -> tuple[KeypointLayout, KeypointLayout]:
    """Return the layouts of the data and of the model.

    Both are empty and called "numbered" where the points of the bags are taken as they are. Raises
    ValueError for a layout that does not exist.
    """
    if config.object == NUMBERED:
        if config.data.keypoint_layout or config.data.cmu:
            raise ValueError(
                f"{names('object')} is {NUMBERED!r}, which takes the points of bags as they are; "
                f"leave out {names('keypoint_layout')}, or name an object"
            )
        return _NUMBERED_LAYOUT, _NUMBERED_LAYOUT
    target = find_layout(names("object"), config.object or config.start or HUMAN25.name)
    named = config.data.keypoint_layout
    return find_layout(names("keypoint_layout"), named) if named else target, target


def _check_ranges(config: TrainingConfig, names: OptionNames) -> None:
    """Raise ValueError for the first option outside its range."""
    parts = (config.layout_loss, config.variation, config.curation, config.limits)
    for part in (*config.preset, *parts):
        for field, _, option in options(type(part)):
            option.check(names(field.name), getattr(part, field.name))
    for field, _, option in options(ReadOptions):
        if hasattr(config.data, field.name):
            option.check(names(field.name), getattr(config.data, field.name))
    for name, value, least in (
        ("min_confidence", config.data.min_confidence, 0),
        ("stride", config.data.stride, 1),
        ("cameras", config.data.cameras, 1),
        ("virtual_people", config.data.virtual_people, 0),
        ("threads", config.output.threads, 0),
    ):
        if not value >= least:
            raise ValueError(f"{names(name)} is {value}; it must be at least {least}")


def _check_data(config: TrainingConfig, names: OptionNames) -> None:
    """Raise ValueError unless there is data of exactly one kind, and each bag or file exists."""
    data = config.data
    if bool(data.bags or data.inputs) == bool(data.cmu):
        raise ValueError(f"name what to train on: {names('data')}")
    if bool(data.image_width) != bool(data.image_height):
        raise ValueError(
            f"{names('image_width')} is {data.image_width} and {names('image_height')} is "
            f"{data.image_height}: the size of the image needs both"
        )
    check_side(names("hands"), data.hands)
    default = DataConfig()
    of_the_other = _OF_BAGS if data.cmu else _OF_CMU
    for name in of_the_other:
        if getattr(data, name) != getattr(default, name):
            kind = "motion capture" if data.cmu else "bags and files"
            raise ValueError(f"{names(name)} has no effect on {kind}: leave it out")
    if not data.cmu:
        for name, value in dataclasses.asdict(config.variation).items():
            if value:
                raise ValueError(f"{names(name)} has no effect on bags and files: leave it out")
    for field in ("bags", "inputs"):
        for path in getattr(data, field):
            if not path.expanduser().exists():
                raise ValueError(f"{names(field)} names {path}, which does not exist")
    files = data.files()
    if data.category and not any(not is_bag(path) for path in files):
        raise ValueError(f"{names('category')} has no effect on bags: leave it out")
    if data.topic and not (data.bags or data.cmu or any(map(is_bag, files))):
        raise ValueError(f"{names('topic')} is {data.topic!r}, but there is no bag; leave it out")


def look_into_bags(config: TrainingConfig, names: OptionNames, source: KeypointLayout) -> list[str]:
    """Return a sentence for each bag that cannot be used, if others can.

    It takes milliseconds, as it reads the index of each bag and the definitions of its types, and
    16 messages at most of topics that may be meant. A damaged bag that is too large for that is
    taken as it is.

    Args:
        config: names the bags, topic and mapping.
        names: the names of the options in the messages.
        source: layout of the messages; "numbered" where it is unknown.

    Raises:
        BagError: no bag or file is left.
    """
    data, failures = config.data, []
    mapping = read_field_mapping(data.mapping) if data.bags else None
    for bag in map(Path.expanduser, data.bags):
        if not opens_quickly(bag):
            continue
        try:
            with closing(open_bag(bag)) as opened:
                keypoint_topics(opened, data.topic, mapping, len(source) or None)
        except BagError as error:
            failures.append(str(error))
    if failures and len(failures) == len(data.bags) and not data.inputs:
        more = f" (and {len(failures) - 1} more)" if len(failures) > 1 else ""
        named = f"{names('topic')} is {data.topic!r}: " if data.topic else ""
        raise BagError(f"{named}{failures[0]}{more}")
    return failures


def read_field_mapping(file: str) -> FieldMapping | None:
    """Return the field mapping in a file, None for ""; raise ValueError where it is damaged."""
    return read_mapping(Path(file).expanduser()) if file else None
