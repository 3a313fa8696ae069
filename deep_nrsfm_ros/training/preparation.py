"""The data of a training: read, curated and assessed before the training starts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from deep_nrsfm_ros.data.bags import keypoint_count, read_bags
from deep_nrsfm_ros.data.curation import Curated, Curation, curate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.mocap import TrialSelection, read_split
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.data.sufficiency import Sufficiency, assess_sufficiency
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.messages.mapping_file import read_mapping
from deep_nrsfm_ros.model_files.find_layout import NUMBERED
from deep_nrsfm_ros.training.config import COMMAND_LINE, TrainingConfig
from deep_nrsfm_ros.training.reporter import Reporter
from deep_nrsfm_ros.training.validation import find_layouts


@dataclass(frozen=True)
class Prepared:
    """A dataset that is fit to be trained on.

    Attributes:
        curated: the dataset, and what was left out of it.
        sufficiency: how much the views vary.
    """

    curated: Curated
    sufficiency: Sufficiency

    @property
    def dataset(self) -> Dataset:
        """Return the dataset to train on."""
        return self.curated.dataset


def read_data(config: TrainingConfig, reporter: Reporter) -> Dataset:
    """Return the dataset that the configuration names, and report what was lost on the way.

    Raises ValueError where there is no such data, or none that can be read.
    """
    data = config.data
    source, target = find_layouts(config, COMMAND_LINE)
    if data.cmu:
        trials = "all" if data.all_trials else "train"
        selection = TrialSelection(data.cmu, data.subjects, trials, data.stride, data.camera_seed)
        return read_split(selection, target, reporter.reading)
    options = ReadOptions(
        topic=data.topic,
        min_confidence=data.min_confidence,
        mapping=read_mapping(Path(data.mapping).expanduser()) if data.mapping else None,
        image_size=data.image_size,
        max_frames=config.limits.max_frames,
    )
    if config.object == NUMBERED:
        source = target = KeypointLayout.numbered(keypoint_count(data.bags, options))
    reading = read_bags(data.bags, source, target, options, reporter.reading)
    for warning in reading.warnings:
        reporter.warn(warning)
    if reading.unreadable:
        count = f"{reading.unreadable} of {reading.messages}"
        reporter.warn(f"{count} messages could not be read: {reading.reason}")
    return reading.dataset


def prepare(curation: Curation, dataset: Dataset, reporter: Reporter) -> Prepared:
    """Return the curated dataset with its sufficiency, and report what was left out.

    Raises ValueError where no model can be learned from what is left.
    """
    curated = curate(dataset, curation)
    if curated.summary:
        reporter.say(curated.summary)
    sufficiency = assess_sufficiency(curated.dataset)
    if sufficiency.refusal:
        raise ValueError(f"a model cannot be learned from this: {sufficiency.refusal}")
    for warning in (*curated.warnings, *sufficiency.warnings):
        reporter.say(f"warning: {warning}")
    return Prepared(curated, sufficiency)
