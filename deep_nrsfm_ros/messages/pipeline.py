"""From one keypoint message to lifted shapes: all that a change of parameters replaces at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deep_nrsfm_ros.configuration import option
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter, LiftingOptions
from deep_nrsfm_ros.lifting.observation import MessageError, Observation
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.lifting.smoothing import Smoother, SmoothingOptions
from deep_nrsfm_ros.messages.decoding import INPUT_TYPES, POINT_CLOUD
from deep_nrsfm_ros.messages.field_mapping import Size
from deep_nrsfm_ros.messages.serialised import Header, MessageReader
from deep_nrsfm_ros.model_files.folders import default_bags_dir, default_models_dir
from deep_nrsfm_ros.model_files.model_file import Model

MODEL_ORDER = "model"
AUTO = "auto"


@dataclass(frozen=True)
class InputOptions:
    """Model and input of the lifter."""

    model: str = option("human", "model to lift with: a name in the model folders, or a path")
    models_dir: str = option(
        str(default_models_dir()),
        "folder for trained models, looked through before those that come with the package",
        read_only=True,
    )
    bags_dir: str = option(
        str(default_bags_dir()),
        "folder of the bags that train.bags may name, set by the owner; relative names begin here",
        read_only=True,
    )
    input_type: str = option(
        POINT_CLOUD,
        f"type of the keypoint messages: one of {', '.join(INPUT_TYPES)}; the path of a field "
        "mapping for any other; or 'auto': that of the first publisher",
        read_only=True,
    )
    topics: tuple[str, ...] = option(
        (),
        "topics with keypoints, '*' for any one part of a name, which is then the identity of "
        "what comes from there: /humans/bodies/*/skeleton2d; none: keypoints",
        read_only=True,
    )
    image_width: int = option(
        0, "width of the image in pixels, for normalised keypoints; 0: unknown", low=0, high=1000000
    )
    image_height: int = option(0, "height of the image in pixels, likewise", low=0, high=1000000)
    keypoint_layout: str = option(
        MODEL_ORDER,
        "order of the detector's keypoints: a preset, the path of a layout file, or 'model' for "
        "the order of the model's own",
    )
    max_objects: int = option(
        100,
        "most objects in a message; one with more is dropped, not lifted for seconds",
        low=1,
        high=100_000,
    )
    min_confidence: float = option(
        0.1, "a keypoint with less confidence counts as missing", low=0, high=1
    )

    @property
    def image_size(self) -> Size | None:
        """Return width and height of the image, None if they are unknown."""
        known = self.image_width and self.image_height
        return (self.image_width, self.image_height) if known else None


class Pipeline:
    """One model, one detector layout, one set of options, ready for messages."""

    def __init__(
        self,
        model: Model,
        detector: KeypointLayout | None,
        inputs: InputOptions,
        lifting: LiftingOptions,
        steadying: SmoothingOptions,
    ) -> None:
        """Raise ValueError if the model and the detector's layout do not fit each other.

        detector: the layout that `inputs.keypoint_layout` names; None for the model's own.
        """
        self.model, self.detector = model, detector
        self.source = detector or model.layout
        self.edges = model.layout.edge_indices()
        self._map = KeypointMap(self.source, model.layout)
        self._lifter = Lifter(model, lifting)
        self._min_confidence = inputs.min_confidence
        self._size = inputs.image_size
        self._min_visible, self._max_objects = lifting.min_visible, inputs.max_objects
        self._steadying = steadying
        self._steady: dict[str, Smoother] = {}

    def read(
        self, raw: bytes, reader: MessageReader, size: Size | None = None
    ) -> tuple[Header | None, Observation]:
        """Return the header of a serialised message, None if its type has none, and its objects.

        The keypoints are as the model orders them. size: that of the image, instead of the one that
        the options tell. Raises MessageError.
        """
        q = len(self.source)
        header, seen = reader(raw, q, self._min_confidence, size or self._size)
        if len(seen.confidence) > self._max_objects:
            raise MessageError(
                f"message has {len(seen.confidence)} objects; expected at most "
                f"{self._max_objects} (max_objects)"
            )
        return header, Observation(*self._map(seen.points, seen.confidence), seen.identities)

    @property
    def steadies(self) -> bool:
        """Tell whether objects are filtered over time, for which their identities matter."""
        return self._steadying.enabled

    def lift(
        self,
        seen: Observation,
        intrinsics: Intrinsics | None,
        identities: tuple[str, ...],
        topic: str,
        time: float,
    ) -> tuple[Lifted, tuple[str, ...]]:
        """Return the shapes of the objects, smoothed if so configured, and their identities.

        intrinsics: of the camera, for the shapes to be at their place; None: they are centred.
        identities: n, of the objects on their topic; "" where there is none. time: of the message,
        in seconds. Objects that are bridged come last; there may be none at all. Objects that
        cannot be lifted are NaN, unless all are: then MessageError is raised.
        """
        points, confidence = seen.points, seen.confidence
        if intrinsics:
            lifted = lift_perspective(self._lifter, intrinsics, points, confidence)
        else:
            lifted = self._lifter.lift(points, confidence)
        steady = self._steady.get(topic)
        if steady is None:
            steady = self._steady[topic] = Smoother(self._steadying)
        lifted, identities = steady(lifted, identities, time)
        if identities and np.isnan(lifted.residual).all():
            most = (confidence > 0).sum(1).max()
            if most >= self._min_visible:
                raise MessageError(
                    "message has its visible keypoints on one line or on one spot"
                    + ", or where the camera's lens sees nothing" * bool(intrinsics)
                )
            raise MessageError(
                f"message has at most {most} visible keypoints of the "
                f"model's {len(self.model.layout)} in an object; min_visible is {self._min_visible}"
            )
        return lifted, identities
