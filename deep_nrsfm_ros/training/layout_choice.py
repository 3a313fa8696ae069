# SPDX-License-Identifier: Apache-2.0
"""The keypoint layouts of bags and files of which nothing says it, chosen as `lift` does it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.resolve_layout import ResolvedLayout, resolve_layout
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.lifting.sanity import is_person
from deep_nrsfm_ros.model_files.find_layout import NUMBERED
from deep_nrsfm_ros.model_files.model_file import Model, load_model, load_once
from deep_nrsfm_ros.training.config import COMMAND_LINE, TrainingConfig
from deep_nrsfm_ros.training.reporter import Reporter
from deep_nrsfm_ros.training.validation import find_layouts

PEOPLE = "human"
"""The model of people that comes with the package."""
_SHOWN = 3  # names of files in a sentence


class _Choice(NamedTuple):
    """The layout that was chosen for a bag or a file."""

    source: str
    resolved: ResolvedLayout


class LayoutChoice:
    """Chooses the layout of each bag and each file by itself: a folder may mix kinds."""

    def __init__(self, model: Model, preferred: KeypointLayout) -> None:
        """Start without a bag or file.

        Args:
            model: shows which layout fits.
            preferred: taken unless another one fits clearly better.
        """
        self._model, self.preferred = model, preferred
        self._choices: list[_Choice] = []

    def choose(self, detections: Detections, path: Path) -> KeypointLayout:
        """Return the layout of detections: the one that they name, or else the one that fits.

        Raises:
            ValueError: no layout of that number of keypoints is known.
        """
        if detections.layout:
            return detections.layout
        try:
            resolved = resolve_layout(detections, self._model, self.preferred)
        except ValueError as error:
            raise ValueError(f"{path}: {error}, or the object with --object") from None
        self._choices.append(_Choice(path.name, resolved))
        return resolved.layout

    def report(self, reporter: Reporter) -> None:
        """Report each layout that was chosen, with the reason, and each that is ambiguous."""
        option = COMMAND_LINE("keypoint_layout")
        for choices in self._by_layout(self._choices):
            layout, reason, _ = choices[0].resolved
            reporter.say(
                f"{_sources(choices)}: keypoint layout {layout.name}: {reason}; "
                f"{option} NAME takes another"
            )
        for choices in self._by_layout([c for c in self._choices if c.resolved.ambiguity]):
            reporter.warn(f"{_sources(choices)}: {choices[0].resolved.ambiguity} ({option})")

    def _by_layout(self, choices: list[_Choice]) -> list[list[_Choice]]:
        """Return the choices of each layout."""
        groups: dict[tuple[str, ...], list[_Choice]] = {}
        for choice in choices:
            groups.setdefault(choice.resolved.layout.keypoints, []).append(choice)
        return list(groups.values())


def layout_choice(config: TrainingConfig) -> LayoutChoice | None:
    """Return the choice of the layouts; None where the configuration or the object says them.

    An object that is no person, without a model to start from, says it: nothing shows what fits.
    """
    if config.data.keypoint_layout or config.data.cmu or config.object == NUMBERED:
        return None
    _, target = find_layouts(config, COMMAND_LINE)
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
    named, target = find_layouts(config, COMMAND_LINE)
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


def _sources(choices: list[_Choice]) -> str:
    """Return the names of bags and files."""
    return in_words(choice.source for choice in choices)


def in_words(sources: Iterable[str]) -> str:
    """Return the names of bags and files, e.g. "a.npz, b.npz, c.npz and 7 more"."""
    names = list(sources)
    more = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")
