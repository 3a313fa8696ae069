# SPDX-License-Identifier: Apache-2.0
"""Looks at the last messages of a stream: the layout that fits them, and what looks wrong.

The hot path only keeps references to messages. They are read a second time when the node asks, at
most once a second.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.layout_fit import (
    LayoutFit,
    ambiguity,
    better_layout,
    choose_layout,
    fit_layouts,
)
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.observation import Observation, left_out_sentences
from deep_nrsfm_ros.lifting.sanity import (
    POOR_RESIDUAL,
    Finding,
    Size,
    check,
    confidence_scale,
    is_person,
    orientation,
    to_pixels,
)
from deep_nrsfm_ros.messages.decoding import implied_layout, is_normalised, type_name
from deep_nrsfm_ros.messages.options import MODEL_ORDER
from deep_nrsfm_ros.messages.pipeline import Pipeline
from deep_nrsfm_ros.messages.serialised import MessageReader
from deep_nrsfm_ros.messages.stamps import check_stamps
from deep_nrsfm_ros.model_files.model_file import Model

_MESSAGES = 16  # kept; enough objects to tell layouts apart, few enough to read again in 1 ms
_MAX_BYTES = 2**18  # of a kept message: 1000 people of 17 keypoints
_SEARCHES = (1, 2, 4, 8, 16)  # messages with objects at which the layout is chosen anew


class Choice(NamedTuple):
    """The layout that was chosen for a stream.

    Attributes:
        layout: of the keypoints.
        reason: why, in words.
    """

    layout: KeypointLayout
    reason: str

    @property
    def value(self) -> str:
        """The value of the parameter `keypoint_layout`; what is no preset is the model's own."""
        return self.layout.name if self.layout.name in LAYOUTS else MODEL_ORDER


class _Sample(NamedTuple):
    """The objects of the kept messages of one topic, in pixels, and what the messages say of them.

    Attributes:
        points: (n, q, 2).
        confidence: (n, q).
        given: the confidences as the detector gives them, not limited to 1.
        stamps: (f,) in ns.
        left_out: sentences about objects and keypoints that are left out.
        has_scores: objects have scores.
        is_normalised: the messages give fractions of the image.
    """

    points: NDArray[np.float32]
    confidence: NDArray[np.float32]
    given: NDArray[np.floating[Any]]
    stamps: NDArray[np.int64]
    left_out: list[str]
    has_scores: bool
    is_normalised: bool


class StreamCheck:
    """Keeps the last messages of a lifter's input and looks at them.

    Attributes:
        searching: whether the layout is still to be chosen, from the first messages.
    """

    def __init__(self, *, search: bool) -> None:
        """Start without messages.

        Args:
            search: the layout is to be chosen.
        """
        self.searching = search
        self._recent: deque[tuple[str, MessageReader, bytes]] = deque(maxlen=_MESSAGES)
        self._lifted: Lifted | None = None
        self._ambiguity: tuple[KeypointLayout, Finding] | None = None
        self._with_objects = 0

    def restart(self, *, search: bool) -> None:
        """Forget all messages, because the input or the model has changed."""
        self.__init__(search=search)  # type: ignore[misc]

    def received(self, topic: str, reader: MessageReader, raw: bytes) -> None:
        """Keep a message, unless it is so large that reading it again would take long."""
        if len(raw) < _MAX_BYTES:
            self._recent.append((topic, reader, raw))

    def lifted(self, lifted: Lifted) -> None:
        """Keep the objects of the last lifted message."""
        self._lifted = lifted

    def search(self, pipeline: Pipeline, size: Size | None) -> Choice | None:
        """Return the layout of the first messages, if it is time to choose it anew.

        It is chosen after 1, 2, 4, 8 and 16 messages, so that the first message is lifted in the
        right order already and one bad message does not decide. Messages without objects do not
        count.
        """
        if not self._recent or not self._has_objects():
            return None
        choice = None
        if self._with_objects + 1 in _SEARCHES:
            choice = self.choose(pipeline, size)
            if choice is None:
                return None
        self._with_objects += 1
        self.searching = self._with_objects < _SEARCHES[-1]
        return choice

    def choose(self, pipeline: Pipeline, size: Size | None) -> Choice | None:
        """Return the layout that fits the kept messages best.

        It is the one that the type of the messages implies, or else the model's, unless another
        one fits clearly better.

        Args:
            pipeline: its model lifts; its options say how messages are read.
            size: of the image in pixels; None: that of the pipeline.

        Returns:
            None if there is no object, or no layout of its number of keypoints.
        """
        if not self._recent:
            return None
        model, (topic, reader, _) = pipeline.model, self._recent[-1]
        implied = _implied(reader, model)
        layouts = [implied] if implied else []
        for q in _sizes(model, implied):
            sample = self._sample(topic, pipeline, size, q)
            if sample is None or not len(sample.points):
                continue
            fits = fit_layouts(sample.points, sample.confidence, model, layouts)
            chosen = choose_layout(fits, implied or model.layout)
            if chosen:
                rivals = ambiguity(sample.points, sample.confidence, model, fits, chosen)
                if implied and chosen.layout.keypoints == implied.keypoints:
                    rivals = None
                self._ambiguity = (chosen.layout, rivals) if rivals else None
                return Choice(chosen.layout, _reason(chosen, fits, implied, reader))
            if q == len(model.layout):
                return Choice(model.layout, "the order of the model")
        return None

    def look(
        self,
        pipeline: Pipeline,
        size: Size | None,
        intrinsics: Intrinsics | None,
        residual: float,
    ) -> list[Finding]:
        """Return what looks wrong in the last messages.

        Args:
            pipeline: with which they were lifted.
            size: of the image in pixels; None: that of the pipeline.
            intrinsics: of the camera; None: not used.
            residual: median residual of the last second; NaN if nothing was lifted.
        """
        if not self._recent:
            return []
        topic, reader, _ = self._recent[-1]
        sample = self._sample(topic, pipeline, size, len(pipeline.source))
        if sample is None or not len(sample.points):
            return []
        findings = check(
            sample.points,
            sample.confidence,
            intrinsics,
            size or pipeline.image_size,
            lifted=self._lifted,
            is_normalised=sample.is_normalised,
        )
        findings = confidence_scale(sample.given) + findings
        findings += check_stamps(sample.stamps, topic)
        findings += [Finding("left-out", text) for text in sample.left_out]
        if pipeline.min_score and not sample.has_scores:
            findings.append(
                Finding(
                    "min-score",
                    f"min_score is {pipeline.min_score:g} and has no effect: the messages on "
                    f"{topic} give no object a score (a field mapping can name it)",
                )
            )
        if field := reader.unused_confidence:
            findings.append(
                Finding(
                    "confidence-field",
                    f"the messages on {topic} have no field 'confidence', and their field "
                    f"{field!r} is not used: all keypoints count as certain; call it confidence",
                )
            )
        # Poor fit and low confidence are rated by the diagnostics, over all objects of a second.
        findings = [f for f in findings if f.code not in ("poor-fit", "low-confidence")]
        if self._ambiguity and self._ambiguity[0].keypoints == pipeline.source.keypoints:
            findings.insert(0, self._ambiguity[1])
        turned: list[Finding] = []
        if self._lifted is not None and is_person(pipeline.model.layout):
            used = size or pipeline.image_size if intrinsics or sample.is_normalised else None
            turned = orientation(self._lifted.rotations, used)
        outside = [finding for finding in findings if finding.code == "outside"]
        if outside:  # the cause of whatever else looks wrong
            others = [finding for finding in findings if finding.code != "outside"]
            return outside + others + turned
        if residual >= POOR_RESIDUAL:
            fits = fit_layouts(sample.points, sample.confidence, pipeline.model)
            if better := better_layout(fits, pipeline.source, residual):
                return [better, *findings]  # in the wrong order people may lie or stand anyhow
        return findings + turned

    def _has_objects(self) -> bool:
        """Return whether the last message may have objects."""
        _, reader, raw = self._recent[-1]
        try:
            return reader.count(raw) > 0
        except Exception:  # a layout that was not counted is found by reading
            return True

    def _sample(self, topic: str, pipeline: Pipeline, size: Size | None, q: int) -> _Sample | None:
        """Return the objects of a topic, read with q keypoints; None if none can be."""
        observations: list[Observation] = []
        stamps: list[int] = []
        given: list[NDArray[np.floating[Any]]] = [np.zeros(0)]
        size = size or pipeline.image_size
        for _, reader, raw in (kept for kept in self._recent if kept[0] == topic):
            try:
                header, observation = reader(raw, q, pipeline.min_confidence, size)
            except Exception:  # damaged bytes fail in many ways; the hot path has reported it
                continue
            observations.append(observation.above(pipeline.min_score))
            if (observation.confidence == 1).any():  # else none was limited to 1
                with suppress(Exception):  # as above
                    given.append(reader.confidence(raw, q, size).ravel())
            if header:
                stamps.append(header.stamp)
        if not observations:
            return None
        points = np.concatenate([observation.points for observation in observations])
        confidence = np.concatenate([observation.confidence for observation in observations])
        pixels = to_pixels(points, confidence, size).astype(np.float32, copy=False)
        was_normalised = pixels is not points or is_normalised(self._recent[-1][1].input_type)
        left_out = left_out_sentences(r for each in observations for r in each.left_out)
        has_scores = any(each.scores for each in observations)
        return _Sample(
            pixels,
            confidence,
            np.concatenate(given),
            np.array(stamps, np.int64),
            left_out,
            has_scores,
            was_normalised,
        )


def _implied(reader: MessageReader, model: Model) -> KeypointLayout | None:
    """Return the layout that the type of messages implies, if the model can lift it."""
    name = implied_layout(reader.input_type)
    if not name:
        return None
    try:
        KeypointMap(LAYOUTS[name], model.layout)
    except ValueError:
        return None
    return LAYOUTS[name]


def _sizes(model: Model, implied: KeypointLayout | None) -> Iterator[int]:
    """Yield the numbers of keypoints to try, the likely ones first."""
    sizes = [*([len(implied)] if implied else []), len(model.layout), *map(len, LAYOUTS.values())]
    yield from dict.fromkeys(sizes)


def _reason(
    chosen: LayoutFit,
    fits: list[LayoutFit],
    implied: KeypointLayout | None,
    reader: MessageReader,
) -> str:
    """Return why a layout was chosen."""
    if implied and chosen.layout.keypoints == implied.keypoints:
        return f"the layout of {type_name(reader.input_type)}"
    others = ", ".join(
        f"{fit.layout.name} {fit.residual:.2f}" for fit in fits if fit.layout is not chosen.layout
    )
    instead = f"instead of {others}" if others else "the only layout of that size"
    return f"it fits {chosen.residual:.2f}, {instead}"
