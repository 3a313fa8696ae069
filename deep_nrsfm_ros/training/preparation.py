# SPDX-License-Identifier: Apache-2.0
"""The data of a training: read, curated and assessed before the training starts."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deep_nrsfm_ros.data.bags import TooManyFramesError, check_confidence, keypoint_count, read_bags
from deep_nrsfm_ros.data.curation import Curated, Curation, curate
from deep_nrsfm_ros.data.dataset import Dataset, concatenate
from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.keypoint_files import is_bag, read_keypoints, sample_bag, with_topic
from deep_nrsfm_ros.data.mocap import TrialSelection, read_split
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.data.resolve_layout import NameCheck, check_names
from deep_nrsfm_ros.data.share import Share
from deep_nrsfm_ros.data.sufficiency import Sufficiency, assess_sufficiency
from deep_nrsfm_ros.data.varied_images import varied
from deep_nrsfm_ros.data.virtual_people import read_virtual_people
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.sanity import Finding, to_pixels
from deep_nrsfm_ros.model_files.find_layout import NUMBERED
from deep_nrsfm_ros.training.config import DataConfig, TrainingConfig, option_names
from deep_nrsfm_ros.training.data_check import (
    WRONG_LAYOUT,
    SourceFinding,
    check_objects,
    is_copy,
    sentences,
)
from deep_nrsfm_ros.training.distributed import own_share
from deep_nrsfm_ros.training.layout_choice import (
    LayoutChoice,
    Source,
    detector_layout,
    in_words,
    layout_choice,
)
from deep_nrsfm_ros.training.reporter import Reporter
from deep_nrsfm_ros.training.validation import find_layouts, read_field_mapping
from deep_nrsfm_ros.wording import wording


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


class Part(NamedTuple):
    """The objects of bags or of a file.

    Attributes:
        dataset: in the layout of the model.
        layout: of the keypoints, as the detector gave them.
    """

    dataset: Dataset
    layout: KeypointLayout


class ReadData(NamedTuple):
    """All data of a training.

    Attributes:
        dataset: in the layout of the model.
        detector_layout: value of the lifter's `keypoint_layout` for the detector that gave the
            keypoints; "" where that is the layout of the model, or unknown.
        findings: what looks wrong in it, source by source.
    """

    dataset: Dataset
    detector_layout: str
    findings: tuple[SourceFinding, ...] = ()


def read_data(config: TrainingConfig, reporter: Reporter) -> ReadData:
    """Return the data that the configuration names, and report what was lost on the way.

    Each of several processes reads its own share of bags and files; all read the motion capture.
    Where nothing says the keypoint layout of a bag or a file, it is chosen (`layout_choice`). Each
    is checked by itself (`data_check`): in a mixture, sound ones would hide a faulty one.

    Raises ValueError where there is no such data, or none that can be read or learned from.
    """
    data = config.data
    source, target = find_layouts(config, option_names())
    if data.cmu:
        images = read_split(_selection(data, data.cmu), target, reporter.reading)
        return ReadData(varied(images, config.variation), "")
    options = ReadOptions(
        topic=data.topic,
        min_confidence=data.min_confidence,
        mapping=read_field_mapping(data.mapping),
        image_size=data.image_size,
        max_frames=-(-config.limits.max_frames // own_share().size),
        missing_value=data.missing_value,
        min_score=data.min_score,
        category=data.category,
    )
    if config.object == NUMBERED:
        source = target = _numbered(data, options)
    reader = _Reader(data, options, KeypointMap(source, target), layout_choice(config), reporter)
    parts, findings = reader.read(), reader.findings
    for sentence in sentences(findings):
        reporter.warn(sentence)
    dataset = concatenate([part.dataset for part in parts])
    if len(dataset) > -(-config.limits.max_frames // own_share().size):
        total = len(dataset) * own_share().size
        raise ValueError(
            f"bags and files have {total} frames; at most {config.limits.max_frames} are "
            "read (max_frames); name fewer files, or allow more"
        )
    detector = detector_layout(config, [part.layout for part in parts])
    return ReadData(dataset, detector, tuple(findings))


def read_people(
    config: TrainingConfig, layout: KeypointLayout, reporter: Reporter
) -> Dataset | None:
    """Return the virtual people of the configuration in a layout; None if it has none."""
    data = config.data
    if not data.cmu or not data.virtual_people:
        return None
    selection = _selection(data, data.cmu)
    return read_virtual_people(selection, data.virtual_people, layout, reporter.reading)


def _selection(data: DataConfig, folder: Path) -> TrialSelection:
    """Return the trials of CMU that the configuration names."""
    trials = "all" if data.all_trials else "train"
    return TrialSelection(
        folder, data.subjects, trials, data.stride, data.camera_seed, data.cameras
    )


def _numbered(data: DataConfig, options: ReadOptions) -> KeypointLayout:
    """Return the layout of points without names, as many as the objects in the data have."""
    if data.bags:
        return KeypointLayout.numbered(keypoint_count(data.bags, options))
    first = data.files()[0]
    detections = read_keypoints(first, _options_for(first, options))
    return KeypointLayout.numbered(detections.confidence.shape[1])


class _Found(NamedTuple):
    """A bag or a file that can be read.

    Attributes:
        path: of it.
        layout: of its keypoints, or the source of a choice that will give it.
        detections: the content of a file; None for a bag, which is read later.
    """

    path: Path
    layout: KeypointLayout | Source
    detections: Detections | None = None

    def find_layout(self) -> KeypointLayout:
        """Return the layout of its keypoints; raise ValueError where none was found."""
        return self.layout.layout if isinstance(self.layout, Source) else self.layout


class _Reader:
    """Reads bags and files; collects what looks wrong in them.

    Attributes:
        findings: what looks wrong, source by source.
    """

    def __init__(
        self,
        data: DataConfig,
        options: ReadOptions,
        keypoint_map: KeypointMap,
        choice: LayoutChoice | None,
        reporter: Reporter,
    ) -> None:
        """Take what to read.

        Args:
            data: names bags and files.
            options: of reading.
            keypoint_map: from the layout that the configuration says to that of the model.
            choice: finds the layouts that nothing says; None: they are the one that the
                configuration says.
            reporter: takes progress, and what is left out.
        """
        self._data, self._options, self._reporter = data, options, reporter
        self._map, self._choice = keypoint_map, choice
        self.findings = list[SourceFinding]()
        self._failed_bags, self._failed_files = list[ValueError](), list[ValueError]()

    def read(self) -> list[Part]:
        """Return the objects in all bags and files; raise ValueError if there are none."""
        if repeated := self._data.repeated():
            names = in_words(path.name for path in repeated)
            self._reporter.warn(f"named more than once: {names}; trained on once")
        bags, files = list(self._find_bags()), self._load_files()
        if self._choice:  # it looks at all of them
            files = _emptied(list(files))
            self._choice.choose()
        parts = self._read_bags(bags) if self._data.bags else []
        parts += self._read_files(files, parts) if self._data.files() else []
        if self._choice:
            self._choice.report(self._reporter)
        return parts

    def _find_bags(self) -> Iterator[_Found]:
        """Yield the bags that can be read, with their layouts."""
        for bag in self._data.own_bags():
            if not self._choice:
                yield _Found(bag, self._map.source)
                continue
            try:
                options = with_topic(bag, self._options, len(self._map.target))
                sample = sample_bag(bag, options, self._reporter.reading)
            except ValueError as error:
                self._failed_bags.append(error)
            else:
                yield _Found(bag, sample.layout or self._choice.add(sample, bag))

    def _load_files(self) -> Iterator[_Found]:
        """Yield the files that can be read, with their content.

        Where there are several sources, the names that a file has for its keypoints go before the
        layout of the configuration.
        """
        data, source = self._data, self._map.source
        is_only_source = len(data.files()) == 1 and not data.bags
        named = source if data.keypoint_layout and is_only_source else None
        fallback = None if self._choice else source
        target = self._map.target
        options = dataclasses.replace(self._options, layout=named, fallback=fallback, target=target)
        for path in _own_files(data)[0]:
            try:
                own = _options_for(path, options)
                if self._choice and path.exists() and is_bag(path):
                    own = with_topic(path, own, len(self._map.target))
                detections = read_keypoints(path, own, self._reporter.reading).without_padding()
            except ValueError as error:  # of one file: the others may do
                self._failed_files.append(error)
                continue
            layout: KeypointLayout | Source | None = detections.layout
            if not layout:
                layout = self._choice.add(detections, path) if self._choice else source
            yield _Found(path, layout, detections)

    def _read_bags(self, bags: list[_Found]) -> list[Part]:
        """Return the objects in the bags of each layout, and report what could not be read.

        A bag that cannot be read, or is clearly in another layout, is left out with a warning,
        unless no data is left.
        """
        failures, parts = self._failed_bags, list[Part]()
        reporter, options, target = self._reporter, self._options, self._map.target
        groups: dict[tuple[str, ...], tuple[KeypointLayout, list[Path]]] = {}
        for found in bags:
            try:
                layout = found.find_layout()
            except ValueError as error:
                failures.append(error)
            else:
                groups.setdefault(layout.keypoints, (layout, []))[1].append(found.path)
        for layout, paths in groups.values():
            try:
                reading = read_bags(paths, layout, target, options, reporter.reading, own_share())
            except TooManyFramesError:
                raise
            except ValueError as error:
                failures.append(error)
                continue
            for warning in reading.warnings:
                reporter.warn(warning)
            if reading.unreadable:
                count = f"{reading.unreadable} of {reading.messages}"
                reporter.warn(f"{count} messages could not be read: {reading.reason}")
            whole = _in_pixels(reading.dataset, options)
            if len(whole) > reading.messages:
                reporter.say(
                    f"{reading.messages} messages hold {len(whole)} objects; each is a frame of "
                    "the training"
                )
            ends = [start for _, start in reading.starts[1:]] + [len(whole)]
            kept = list[tuple[str, Dataset]]()
            for (bag, start), end in zip(reading.starts, ends, strict=True):
                dataset, is_chosen = whole[start:end], self._choice is not None
                found_in_it = _check_bag(bag, dataset, layout, options, is_chosen=is_chosen)
                if wrong := _wrong_layout(bag, found_in_it):
                    failures.append(wrong)
                    continue
                self.findings += [SourceFinding(bag.name, finding) for finding in found_in_it]
                kept.append((bag.name, dataset))
            if kept and len(kept) < len(reading.starts):
                source = f"bags {', '.join(name for name, _ in kept)}"
                whole = dataclasses.replace(concatenate([each for _, each in kept]), source=source)
            if kept:
                parts.append(Part(whole, layout))
        if not parts and not self._data.files():
            raise failures[0]
        for failure in failures:
            reporter.warn(f"left out: {failure}")
        return parts

    def _read_files(self, files: Iterable[_Found], bags: list[Part]) -> list[Part]:
        """Return the objects in each file, those of one identity one after the other.

        So near-duplicates of one person follow one another, as the curation expects. A file that
        cannot be read, or is clearly in another layout, is left out with a warning, unless no data
        is left.
        Each of several processes reads every n-th file; where there are fewer files than processes,
        it takes its share of the objects in each.
        """
        share, reporter, target = _own_files(self._data)[1], self._reporter, self._map.target
        parts, failures, copies = list[Part](), self._failed_files, list[str]()
        for found in files:
            path, detections = found.path, found.detections
            assert detections, "a bag is no file"
            try:
                layout = found.find_layout()
                names, to_target = _match_names(path, layout, target)
                if not len(detections) or not detections.confidence.any():
                    raise ValueError(f"{path}: it has no object with keypoints")
                found_in_it = check_objects(
                    detections.points,
                    detections.confidence,
                    layout,
                    target,
                    self._options.image_size,
                    # The names in a file say its layout, and a chosen one is the one that fits.
                    may_be_another=layout is self._map.source,
                )
                if wrong := _wrong_layout(path, found_in_it):
                    raise wrong
            except ValueError as error:  # of one file: the others may do
                failures.append(error)
                continue
            found_in_it = [*detections.findings, *names.findings, *found_in_it]
            self.findings += [SourceFinding(path.name, finding) for finding in found_in_it]
            for warning in (*detections.warnings, *names.warnings):
                reporter.warn(f"{path.name}: {warning}")
            order = np.lexsort((detections.frame, detections.identities))
            order = order[share.rows(len(order))]
            identities = detections.identities[order]
            starts = np.flatnonzero(np.append(True, identities[1:] != identities[:-1]))
            points, confidence = to_target(detections.points[order], detections.confidence[order])
            visible, source = confidence > 0, f"file {path.name}"
            dataset = Dataset(points, visible, target, source, sequence_starts=starts)
            if same := [part.dataset.source for part in parts if is_copy(dataset, part.dataset)]:
                copies.append(f"{path.name} (of {same[0].removeprefix('file ')})")
            parts.append(Part(dataset, layout))
        if not parts and not bags:
            raise failures[0]
        if copies:
            reporter.warn(f"the same keypoints twice: {in_words(copies)}; leave the copies out")
        for failure in failures:
            reporter.warn(f"left out: {failure}")
        return parts


def _own_files(data: DataConfig) -> tuple[list[Path], Share]:
    """Return the files that this of several processes reads, and its share of each of them."""
    paths, share = data.files(), own_share()
    if len(paths) >= share.size:
        return paths[share.index :: share.size], Share()
    return paths, share


def _emptied(files: list[_Found]) -> Iterator[_Found]:
    """Yield files, each of which is free to leave memory once the next one is asked for."""
    files.reverse()
    while files:
        yield files.pop()


def _in_pixels(dataset: Dataset, options: ReadOptions) -> Dataset:
    """Return the dataset of bags in pixels: normalised keypoints times the image's size."""
    if options.image_size is None:  # else nothing is multiplied
        return dataset
    points = to_pixels(dataset.points, dataset.visible.astype(np.float32), options.image_size)
    return dataclasses.replace(dataset, points=np.asarray(points, np.float32))


def _check_bag(
    path: Path, dataset: Dataset, layout: KeypointLayout, options: ReadOptions, *, is_chosen: bool
) -> list[Finding]:
    """Return what looks wrong in a bag.

    Args:
        path: of the bag.
        dataset: its objects, in the layout of the model.
        layout: of the keypoints, as the detector gave them.
        options: of reading.
        is_chosen: the layout is the one that fits best.
    """
    target, size = dataset.layout, options.image_size
    found = check_objects(
        dataset.points, dataset.visible, target, target, size, may_be_another=False
    )
    found += check_confidence(path, len(layout), options)
    if is_chosen or not any(finding.code == "poor-fit" for finding in found):
        return found
    sample = sample_bag(path, dataclasses.replace(options, layout=layout))
    scale = [finding for finding in found if finding.code == "confidence-scale"]
    return scale + check_objects(sample.points, sample.confidence, layout, target, size)


def _wrong_layout(path: Path, findings: list[Finding]) -> ValueError | None:
    """Return the error of a bag or file that is clearly in another layout; None if it is not."""
    wrong = next((finding for finding in findings if finding.code == WRONG_LAYOUT), None)
    option = wording(
        "--keypoint-layout, train.keypoint_layout", node="train.keypoint_layout", python=""
    )
    return ValueError(f"{path}: {wrong} ({option})") if wrong else None


def _match_names(
    path: Path, layout: KeypointLayout, target: KeypointLayout
) -> tuple[NameCheck, KeypointMap]:
    """Return what is to be said of the names in a file, and the map to the layout of the model."""
    try:
        return check_names(layout, target, f"object {target.name!r}"), KeypointMap(layout, target)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _options_for(path: Path, options: ReadOptions) -> ReadOptions:
    """Return the options for a file: only a bag has a topic and a mapping, and no category."""
    if path.exists() and is_bag(path):
        return dataclasses.replace(options, category="")
    return dataclasses.replace(options, topic="", mapping=None)


def prepare(
    curation: Curation, dataset: Dataset, reporter: Reporter, *, has_start: bool = False
) -> Prepared:
    """Return the curated dataset with its sufficiency, and report what was left out.

    Args:
        curation: what to leave out.
        dataset: all frames.
        reporter: takes progress and warnings.
        has_start: whether the training starts from a model.

    Raises:
        ValueError: no model can be learned from what is left.
    """
    curated = curate(dataset, curation, reporter.curating)
    if curated.summary:
        reporter.say(curated.summary)
    sufficiency = assess_sufficiency(
        curated.dataset, has_start=has_start, near_duplicates=curated.near_duplicates
    )
    if sufficiency.refusal:
        raise ValueError(f"a model cannot be learned from this: {sufficiency.refusal}")
    for warning in (*curated.warnings, *sufficiency.warnings):
        reporter.say(f"warning: {warning}")
    return Prepared(curated, sufficiency)
