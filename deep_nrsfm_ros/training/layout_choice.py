# SPDX-License-Identifier: Apache-2.0
"""The keypoint layouts of bags and files of which nothing says it, chosen as `lift` does it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.resolve_layout import ResolvedLayout, resolve_layout
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.lifting.layout_fit import (
    LayoutFit,
    fit_layouts,
    is_clearly_better,
    sample_objects,
)
from deep_nrsfm_ros.lifting.sanity import check, is_person
from deep_nrsfm_ros.model_files.find_layout import NUMBERED
from deep_nrsfm_ros.model_files.model_file import Model, load_model, load_once
from deep_nrsfm_ros.training.config import TrainingConfig, option_names
from deep_nrsfm_ros.training.reporter import Reporter
from deep_nrsfm_ros.training.validation import find_layouts
from deep_nrsfm_ros.wording import wording

PEOPLE = "human"
"""The model of people that comes with the package."""
_SHOWN = 3  # names of files in a sentence


class Source:
    """A bag or a file of whose keypoints nothing says the layout."""

    def __init__(self, path: Path, detections: Detections) -> None:
        """Take the objects of a bag or a file, all of them or a sample."""
        self.path = path
        self.detections: Detections | None = detections
        self.resolved: ResolvedLayout | None = None
        self.failure: ValueError | None = None

    @property
    def layout(self) -> KeypointLayout:
        """Return the layout that `LayoutChoice.choose` has chosen.

        Raises:
            ValueError: no layout of that number of keypoints is known.
        """
        if self.failure:
            raise self.failure
        assert self.resolved, "its layout is not chosen yet"
        return self.resolved.layout

    def fail(self, reason: ValueError) -> None:
        """Have no layout."""
        option = wording("--object", node="train.object", python="")
        self.failure = ValueError(f"{self.path}: {reason}, or the object with {option}")


@dataclass(frozen=True, eq=False)
class _Tried:
    """A source, a sample of its objects, and how the layouts fit them, the best one first.

    Nothing was tried where `fits` is empty.
    """

    source: Source
    sample: Detections
    fits: list[LayoutFit]

    def residual(self, layout: KeypointLayout) -> float:
        """Return the residual of a layout; infinite if its objects cannot be lifted with it."""
        same = (fit for fit in self.fits if fit.layout.keypoints == layout.keypoints)
        return next((fit.residual for fit in same), np.inf)

    def allows(self, layout: KeypointLayout) -> bool:
        """Return whether no other layout fits clearly better."""
        return not self.fits or not is_clearly_better(self.fits[0], self.residual(layout))


class LayoutChoice:
    """Chooses the layouts of bags and files.

    Those with the same number of keypoints share one layout, as they mostly come of one detector.
    One in which another layout fits clearly better has that one, since a folder may mix kinds.
    """

    def __init__(self, model: Model, preferred: KeypointLayout) -> None:
        """Start without a bag or file.

        Args:
            model: shows which layout fits.
            preferred: taken unless another one fits clearly better.
        """
        self._model, self.preferred = model, preferred
        self._sources: list[Source] = []

    def add(self, detections: Detections, path: Path) -> Source:
        """Add a bag or a file; it has a layout after `choose`."""
        self._sources.append(Source(path, detections))
        return self._sources[-1]

    def choose(self) -> None:
        """Choose the layout of each bag and file; none can be added any more."""
        sizes: dict[int, list[Source]] = {}
        for source in self._sources:
            assert source.detections, "the layouts are chosen already"
            sizes.setdefault(source.detections.confidence.shape[1], []).append(source)
        for sources in sizes.values():
            normalised = [source for source in sources if _is_normalised(source)]
            others = [source for source in sources if source not in normalised]
            # No layout fits points whose x and y have units of their own.
            self._choose_together(others or normalised)
            first = (others or normalised)[0]
            for source in normalised:
                source.failure = first.failure
                if first.resolved:
                    source.resolved = ResolvedLayout(first.resolved.layout, _NORMALISED)
        for source in self._sources:
            source.detections = None

    def _choose_together(self, sources: list[Source]) -> None:
        """Choose the layouts of sources with the same number of keypoints."""
        left = [self._try(source, is_alone=len(sources) == 1) for source in sources]
        while left:
            agreeing = _agreeing(left)
            try:
                resolved = resolve_layout(_together(agreeing), self._model, self.preferred)
            except ValueError as error:
                for each in left:
                    each.source.fail(error)
                return
            agreeing = [each for each in agreeing if each.allows(resolved.layout)] or agreeing
            for each in agreeing:
                each.source.resolved = resolved
            left = [each for each in left if each not in agreeing]

    def _try(self, source: Source, *, is_alone: bool) -> _Tried:
        """Return a source with a sample, and how the layouts fit it unless it is alone."""
        assert source.detections
        if is_alone:
            return _Tried(source, source.detections, [])
        sample = source.detections[sample_objects(source.detections.confidence)]
        fits = fit_layouts(sample.points, sample.confidence, self._model, [self.preferred])
        return _Tried(source, sample, fits)

    def report(self, reporter: Reporter) -> None:
        """Report each layout that was chosen, with the reason, and each that is ambiguous."""
        option = option_names()("keypoint_layout")
        chosen = [(each.path.name, each.resolved) for each in self._sources if each.resolved]
        for names, (layout, reason, _) in _by_layout(chosen):
            reporter.say(
                f"{names}: keypoint layout {layout.name}: {reason}; {option} NAME takes another"
            )
        for names, resolved in _by_layout([each for each in chosen if each[1].ambiguity]):
            reporter.warn(f"{names}: {resolved.ambiguity} ({option})")


def _by_layout(chosen: list[tuple[str, ResolvedLayout]]) -> list[tuple[str, ResolvedLayout]]:
    """Return each layout with the names of its bags and files in words, and no guess if it can."""
    groups: dict[tuple[str, ...], list[tuple[str, ResolvedLayout]]] = {}
    for each in chosen:
        groups.setdefault(each[1].layout.keypoints, []).append(each)
    return [
        (in_words(name for name, _ in group), min((r for _, r in group), key=_is_guess))
        for group in groups.values()
    ]


def _is_guess(resolved: ResolvedLayout) -> bool:
    """Return whether nothing but other bags and files shows a layout."""
    return resolved.reason == _NORMALISED


_NORMALISED = "a guess, since the keypoints are normalised"


def _is_normalised(source: Source) -> bool:
    """Return whether the points of a source look normalised."""
    assert source.detections
    found = check(source.detections.points, source.detections.confidence)
    return any(finding.code == "normalised" for finding in found)


def _agreeing(tried: list[_Tried]) -> list[_Tried]:
    """Return the sources that may be in one layout: as many of them as there are."""
    layouts = {fit.layout.keypoints: fit.layout for each in tried for fit in each.fits}
    best, best_rank = tried, (0, 0.0)
    for layout in layouts.values():
        allowing = [each for each in tried if each.allows(layout)]
        residual = sum(each.residual(layout) for each in allowing if each.fits)
        if (len(allowing), -residual) > best_rank:
            best, best_rank = allowing, (len(allowing), -residual)
    return best


def _together(tried: list[_Tried]) -> Detections:
    """Return the samples of several sources as one."""
    samples = [each.sample for each in tried]
    if len(samples) == 1:
        return samples[0]
    points = np.concatenate([sample.points for sample in samples])
    confidence = np.concatenate([sample.confidence for sample in samples])
    count = len(points)
    usual = [sample.usual_layout for sample in samples if sample.usual_layout]
    return Detections(
        points,
        confidence,
        np.zeros(count, np.int64),
        np.full(count, ""),
        np.zeros(1, np.int64),
        usual_layout=usual[0] if usual else None,
    )


def layout_choice(config: TrainingConfig) -> LayoutChoice | None:
    """Return the choice of the layouts; None where the configuration or the object says them.

    An object that is no person, without a model to start from, says it: nothing shows what fits.
    """
    if config.data.keypoint_layout or config.data.cmu or config.object == NUMBERED:
        return None
    _, target = find_layouts(config, option_names())
    if is_person(target):
        return LayoutChoice(load_model(PEOPLE), target)
    return LayoutChoice(load_once(Path(config.start)), target) if config.start else None


def detector_layout(config: TrainingConfig, layouts: list[KeypointLayout]) -> str:
    """Return the value of the lifter's `keypoint_layout` for the detector of the data.

    Args:
        config: of the training.
        layouts: of the keypoints in each bag and file.

    Returns:
        The name of a preset, or the path of a layout file or model file. "" where it is the layout
        of the model, or where bags and files are of several layouts.
    """
    named, target = find_layouts(config, option_names())
    if config.data.keypoint_layout:
        return config.data.keypoint_layout if named.keypoints != target.keypoints else ""
    if len({layout.keypoints for layout in layouts}) != 1:
        return ""
    (layout, *_) = layouts
    if layout.keypoints == target.keypoints:
        return ""
    if layout.name in LAYOUTS:
        return layout.name
    is_of_start = config.start and load_once(Path(config.start)).layout == layout
    return config.start if is_of_start else ""


def in_words(sources: Iterable[str]) -> str:
    """Return the names of bags and files, e.g. "a.npz, b.npz, c.npz and 7 more"."""
    names = list(sources)
    more = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")
