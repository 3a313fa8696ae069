# SPDX-License-Identifier: Apache-2.0
"""The way of one keypoint message to lifted shapes, as one configuration defines it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.history import Memory
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter
from deep_nrsfm_ros.lifting.observation import (
    MAX_COORDINATE,
    MessageError,
    Observation,
    without_border,
)
from deep_nrsfm_ros.lifting.options import HistoryOptions, LiftingOptions
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.lifting.sanity import to_pixels
from deep_nrsfm_ros.lifting.smoothing import Smoother, SmoothingOptions
from deep_nrsfm_ros.lifting.steady_depth import steady_depths
from deep_nrsfm_ros.lifting.track_matching import keypoint_tolerances
from deep_nrsfm_ros.messages.field_mapping import Size
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.messages.serialised import Header, MessageReader
from deep_nrsfm_ros.messages.stamps import Moment
from deep_nrsfm_ros.model_files.matching_model import map_to_model
from deep_nrsfm_ros.model_files.model_file import Model

Floats = NDArray[Any]

_DEFAULT_HISTORY = HistoryOptions()


class Pipeline:
    """Immutable per-configuration pipeline, swapped atomically on a parameter change.

    Only what is remembered of identities changes from message to message.

    Attributes:
        model: lifts.
        detector: layout that `keypoint_layout` names; None: the model's own.
        source: layout of the messages, `detector` or the model's.
        edges: pairs of keypoint indices of the model's layout, to draw.
        tolerances: (p,) of the keypoints of the model's layout, for identities.
        min_confidence: detector confidence below which a keypoint is missing.
        min_score: detector's score of an object below which it is left out.
        image_size: width and height of the image in pixels that the options give; None: unknown.
        remembers: whether objects are lifted with what their last frames have shown.
    """

    def __init__(
        self,
        model: Model,
        detector: KeypointLayout | None,
        inputs: InputOptions,
        lifting: LiftingOptions,
        smoothing: SmoothingOptions,
        history: HistoryOptions = _DEFAULT_HISTORY,
    ) -> None:
        """Prepare a model and its input.

        Args:
            model: weights and layout.
            detector: layout that `inputs.keypoint_layout` names; None: the model's own.
            inputs: how messages are read.
            lifting: how keypoints are lifted.
            smoothing: how shapes are filtered after the correction.
            history: what is remembered of identities.

        Raises:
            ValueError: the layouts of model and detector do not fit each other.
        """
        self.model, self.detector = model, detector
        self.source = detector or model.layout
        self.edges = model.layout.edge_indices()
        self.tolerances = keypoint_tolerances(model.layout)
        self._map = map_to_model(self.source, model.layout)
        self._lifter = Lifter(model, lifting, layout=self.source, history=history)
        self.remembers = history.enabled and lifting.correction != "none"
        self._memories: dict[str, Memory] = {}
        self.min_confidence = inputs.min_confidence
        self.min_score = inputs.min_score
        self.image_size = inputs.image_size
        self._min_visible, self._max_objects = lifting.min_visible, inputs.max_objects
        self._smoothing = smoothing
        self._smoothers: dict[str, Smoother] = {}

    def read(
        self, raw: bytes, reader: MessageReader, size: Size | None = None
    ) -> tuple[Header | None, Observation]:
        """Return the header of a serialised message, None if its type has none, and its objects.

        Args:
            raw: the serialised message.
            reader: of the message's topic.
            size: of the image in pixels; None: that of the options. Normalised keypoints of any
                type are multiplied by it.

        Returns:
            The header, and an observation in the order of the model's layout.

        Raises:
            MessageError: the message is malformed or has more than `max_objects` objects.
        """
        size = size or self.image_size
        header, observation = reader(raw, len(self.source), self.min_confidence, size)
        observation = observation.above(self.min_score)
        points, confidence = observation.points, observation.confidence
        if len(confidence) > self._max_objects:
            raise MessageError(
                f"message has {len(confidence)} objects; expected at most "
                f"{self._max_objects} (max_objects)"
            )
        points = to_pixels(points, confidence, size)
        if size:
            points, confidence, *_ = without_border(Observation(points, confidence), size)
        found = Observation(*self._map(points, confidence), observation.identities)
        return header, found._replace(places=observation.places)

    @property
    def needs_identities(self) -> bool:
        """Whether `lift` needs the identities of objects: something is remembered of them."""
        return self._smoothing.enabled or self.remembers

    @property
    def reference_length(self) -> float:
        """The reference length of the shapes."""
        return float(self._lifter.constants.reference_length)

    @property
    def history_status(self) -> str:
        """What is remembered from message to message, as text for diagnostics."""
        if not self.remembers:
            return "off: each message is lifted by itself"
        count = sum(map(len, self._memories.values()))
        return f"on: {count} object{'s' * (count != 1)} remembered"

    def restart(self, topic: str) -> None:
        """Forget all identities of a topic, as when its stamps begin anew."""
        self._smoothers.pop(topic, None)
        self._memories.pop(topic, None)

    @property
    def shared_keypoints(self) -> tuple[tuple[int, int], ...]:
        """Pairs of the indices in detector's and model's layout of the keypoints of one name."""
        target = self.model.layout.keypoints
        names = enumerate(self.source.keypoints)
        return tuple((i, target.index(name)) for i, name in names if name in target)

    def forget(self) -> None:
        """Forget all identities of all topics."""
        self._smoothers.clear()
        self._memories.clear()

    def learned_bones(
        self, most: int = 8, shown: Mapping[str, Floats] | None = None
    ) -> dict[str, str]:
        """Return the bone lengths that are learned of each identity, as text for diagnostics.

        Args:
            most: identities, those lifted last; 8 typical.
            shown: shape (p, 3) of each identity that is present, in the unit that the lengths are
                to have; None: all that are remembered, in units of the reference length.
        """
        learned: dict[str, str] = {}
        for memory in self._memories.values():
            latest = memory.latest(len(memory))
            present = [name for name in latest if shown is None or name in shown]
            for identity in present[: most - len(learned)]:
                lengths, seconds = self._lifter.learned_lengths(memory, identity)
                if shown is not None:
                    unit = self._unit(lengths, shown[identity])
                    lengths = {name: unit * length for name, length in lengths.items()}
                if seconds:
                    bones = ", ".join(f"{name} {length:.3f}" for name, length in lengths.items())
                    learned[identity] = f"{seconds:.1f} s of sight: {bones}"
        return learned

    def _unit(self, lengths: Mapping[str, float], shape: Floats) -> float:
        """Return the factor from the unit of bone lengths to that of a shape of the object.

        The bone of the reference pair says it, since it has its length in each shape. Where no
        bone joins that pair, all bones together do.
        """
        layout, spans = self.model.layout, {}
        for pair in self.edges:
            for i, j in (pair, pair[::-1]):
                name = f"{layout.keypoints[i]}-{layout.keypoints[j]}"
                if name in lengths:
                    spans[name] = float(np.linalg.norm(shape[i] - shape[j]))
        a, b = layout.reference or ("", "")
        bones = [name for name in (f"{a}-{b}", f"{b}-{a}") if name in spans]
        bones = bones or [*spans]
        return sum(spans[name] for name in bones) / (sum(lengths[name] for name in bones) or 1.0)

    def lift(
        self,
        observation: Observation,
        intrinsics: Intrinsics | None,
        identities: tuple[str, ...],
        topic: str,
        moment: Moment,
        up: NDArray[np.float64] | None = None,
    ) -> tuple[Lifted, tuple[str, ...]]:
        """Return the lifted objects of a message, smoothed if so configured, and their identities.

        All objects are lifted in one pass. Objects whose gap smoothing fills are appended. There
        may be no objects at all. Objects that cannot be lifted are NaN.

        Args:
            observation: n objects in the order of the model's layout.
            intrinsics: of the camera: shapes are at their positions; None: shapes are centred.
            identities: n, unique on the topic; "" if unknown.
            topic: of the message; each topic has its own filters.
            moment: time of the message.
            up: (3,) unit vector against gravity in the camera's axes; None: unknown.

        Raises:
            MessageError: there are objects, and none can be lifted.
        """
        points, confidence = observation.points, observation.confidence
        context = memory = None
        if self.remembers:
            memory = self._memories.get(topic)
            if memory is None:
                memory = self._memories[topic] = self._lifter.memory()
            context = memory(identities, moment.seconds, up)
        elif up is not None:
            context = self._lifter.memory()(("",) * len(points), moment.seconds, up)
        if intrinsics:
            lifted = lift_perspective(self._lifter, intrinsics, points, confidence, context)
        else:
            lifted = self._lifter.lift(points, confidence, context=context)
        if memory is not None and context:
            lifted = steady_depths(lifted, memory, context)
        smoother = self._smoothers.get(topic)
        if smoother is None:
            smoother = self._smoothers[topic] = Smoother(self._smoothing)
        lifted, identities = smoother(lifted, identities, moment.seconds, moment.period)
        if identities and np.isnan(lifted.residual).all():
            detected = self._lifter.detected_count(confidence).max()
            if detected >= self._min_visible:
                raise MessageError(
                    "message has its visible keypoints on one line or on one spot"
                    + ", or outside the view of the camera's lens" * bool(intrinsics)
                )
            raise MessageError(
                f"message has at most {detected} detected keypoints of the model's "
                f"{len(self.model.layout)} in an object, without those at (0, 0), with a NaN or a "
                f"coordinate of {MAX_COORDINATE:g} or more, at the image's border, of low "
                "confidence, or that follow from others; "
                f"min_visible is {self._min_visible}"
            )
        return lifted, identities
