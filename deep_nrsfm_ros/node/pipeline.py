"""From one keypoint message to lifted shapes: all that a change of parameters replaces at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from deep_nrsfm_ros.configuration import option
from deep_nrsfm_ros.node.model_folders import default_bags_dir, default_models_dir
from deep_nrsfm_ros.nrsfm.keypoints import KeypointLayout, KeypointMap
from deep_nrsfm_ros.nrsfm.lifting import Lifted, Lifter, LiftingOptions
from deep_nrsfm_ros.nrsfm.model_file import Model
from deep_nrsfm_ros.observations.messages import INPUT_TYPES, POINT_CLOUD, MessageError, read

MODEL_ORDER = "model"


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
        POINT_CLOUD, "type of the keypoint messages", choices=tuple(INPUT_TYPES), read_only=True
    )
    keypoint_layout: str = option(
        MODEL_ORDER,
        "order of the detector's keypoints: a preset, the path of an object file, or 'model' for "
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


class Pipeline:
    """One model, one detector layout, one set of options, ready for messages."""

    def __init__(
        self,
        model: Model,
        detector: KeypointLayout | None,
        inputs: InputOptions,
        lifting: LiftingOptions,
    ) -> None:
        """Raise ValueError if the model and the detector's layout do not fit each other.

        detector: the layout that `inputs.keypoint_layout` names; None for the model's own.
        """
        self.model, self.detector = model, detector
        self.source = detector or model.layout
        self.edges = model.layout.edge_indices()
        self._map = KeypointMap(self.source, model.layout)
        self._lifter = Lifter(model, lifting)
        self._input_type, self._min_confidence = inputs.input_type, inputs.min_confidence
        self._min_visible, self._max_objects = lifting.min_visible, inputs.max_objects

    def __call__(self, message: Any) -> Lifted:
        """Return the shapes of the objects in `message`; raise ValueError if there is none.

        Objects that cannot be lifted are NaN, unless all are: that is an error too.
        """
        seen = read(message, self._input_type, len(self.source), self._min_confidence)
        if not 0 < len(seen.confidence) <= self._max_objects:
            raise MessageError(
                f"message has {len(seen.confidence)} objects; expected at least one and at most "
                f"{self._max_objects} (max_objects)"
            )
        points, confidence = self._map(*seen)
        lifted = self._lifter(points, confidence)
        if np.isnan(lifted.residual).all():
            most = (confidence > 0).sum(1).max()
            if most >= self._min_visible:
                raise MessageError("message has its visible keypoints on one line or on one spot")
            raise MessageError(
                f"message has at most {most} visible keypoints of the "
                f"model's {len(self.model.layout)} in an object; min_visible is {self._min_visible}"
            )
        return lifted
