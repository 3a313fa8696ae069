# SPDX-License-Identifier: Apache-2.0
"""Lift the 2D keypoints of n objects to 3D shapes and camera rotations; needs no torch."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.configuration import check
from deep_nrsfm_ros.kernel import supports
from deep_nrsfm_ros.large_arrays import empty, release
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.compiled_backend import CompiledBackend
from deep_nrsfm_ros.lifting.confidence import CALIBRATED
from deep_nrsfm_ros.lifting.history import Context, Memory, StateLayout
from deep_nrsfm_ros.lifting.numpy_backend import Float32, LifterConstants, NumpyBackend
from deep_nrsfm_ros.lifting.observation import from_arrays
from deep_nrsfm_ros.lifting.options import HistoryOptions, LiftingOptions
from deep_nrsfm_ros.lifting.own_bones import (
    Learned,
    in_reference_units,
    named_lengths,
    own_bones,
    partner_bones,
)
from deep_nrsfm_ros.lifting.weights import keypoint_weight, trusted
from deep_nrsfm_ros.model_files.find_layout import layout_of
from deep_nrsfm_ros.model_files.model_file import Model, load_model
from deep_nrsfm_ros.wording import in_python

_BLOCK = 64  # objects per call in `lift_all`: more exceed the cache
_RELEASED = 128  # blocks after which results that are in files are taken out of memory

_Options = TypeVar("_Options", LiftingOptions, HistoryOptions)

_MIRROR_IN_IMAGE = np.array([-1, 1], np.float32)
_MIRROR_IN_CAMERA = np.array([-1, 1, 1], np.float32)  # x axis of the camera: to the right
_MIRROR_IN_OBJECT = np.array([1, -1, 1], np.float32)  # y axis of the object: to its left


class Lifted(NamedTuple):
    """n lifted objects with p keypoints each.

    An object that cannot be lifted has confidence 0 and is NaN otherwise: it has too few detected
    keypoints, or they lie on one line, which does not determine a camera.

    Attributes:
        shapes: (n, p, 3) camera axes (x right, y down, z forward); centred, or at the object's
            position where the camera's intrinsics are known, as to `VideoLifter`. The reference
            pair of the model's layout is `reference_length` of its options long: of people, neck
            to mid-hip is 0.5 by default, so shapes are in metres. Without a pair, the RMS radius
            is so long, 1 by default.
        rotations: (n, 3, 3) from object to camera axes, p_camera = R p_object, det +1.
        scale: (n,) pixels per unit of `shapes`.
        translation: (n, 2) projection of the shape's origin in the image, in pixels.
        residual: (n,) image error of the network before the correction: distance of its keypoints
            from those given, relative to their size; 0 = perfect, below 0.1 typical, above 0.3
            poor. It is the mean over the `test_time_rotations` of the image; the image error that
            `train` prints is of the image alone, and so smaller on frames that a model has learned.
        confidence: (n, p) probability in [0, 1] that the point is close to its true position.
        wrong: (n, p) bool, whether a detected keypoint contradicts the others of its object; it
            was taken as missing (option `leave_out_wrong`).
    """

    shapes: Float32
    rotations: Float32
    scale: Float32
    translation: Float32
    residual: Float32
    confidence: Float32
    wrong: NDArray[np.bool_]

    @property
    def object_confidence(self) -> Float32:
        """The mean confidence (n,) of each object's points."""
        mean: Float32 = self.confidence.mean(1)
        return mean

    def at(self, chosen: Any) -> Lifted:
        """Return some objects, or one.

        Args:
            chosen: index of the arrays' first axis.
        """
        return Lifted._make(part[chosen] for part in self)


class Lifter:
    """Lifts 2D keypoints with a model; needs NumPy, not torch.

    Attributes:
        model: the model.
        options: how it lifts.
        layout: keypoint layout of the points that a call takes.
        constants: model and options in the form that a backend computes with.
        backend: the kernel if it supports the network, else NumPy.
    """

    def __init__(
        self,
        model: Model | str | Path,
        options: LiftingOptions | None = None,
        *,
        layout: KeypointLayout | str | Path | Sequence[str] | NDArray[np.str_] | None = None,
        history: HistoryOptions | None = None,
    ) -> None:
        """Prepare a backend for the model.

        Args:
            model: weights, layout and error statistics, or the name or file of a model, as
                `load_model` takes it.
            options: None: all defaults.
            layout: the detector's layout of q keypoints, as an object, by the name of a preset
                or a layout file ("coco17"), or a list of the keypoints' names; its keypoints are
                mapped to the model's by name. None: the model's layout.
            history: what is remembered of identities, by `VideoLifter`; None: all defaults.

        Raises:
            ValueError: the model or the layout does not exist, they share fewer than 4 keypoints,
                or an option is out of its range or asks for more keypoints than the model has.
            TypeError: an argument is of another type.
        """
        if isinstance(model, (str, Path)):
            model = load_model(model)
        if not isinstance(model, Model):
            raise TypeError(
                f"model is a {type(model).__name__}; give load_model('human'), or a name"
            )
        self.model = model
        self.options = _checked("options", options, LiftingOptions)
        check_min_visible("min_visible", self.options.min_visible, model)
        history = _checked("history", history, HistoryOptions)
        self.layout = model.layout if layout is None else layout_of("layout", layout)
        self._to_model = KeypointMap(self.layout, model.layout)
        are_names = not isinstance(layout, (KeypointLayout, str, Path)) and layout is not None
        if are_names and (unnamed := self._to_model.unnamed()):
            warnings.warn(
                f"layout names {unnamed.filled} of model {model.name!r}, and {unnamed.others}: "
                f"{unnamed.missing} are guessed; rename those that they are",
                stacklevel=2,
            )
        self.constants = _constants(model, self.options, history, self._to_model)
        backend = CompiledBackend if supports(model.network) else NumpyBackend
        self.backend = backend(self.constants)

    def __call__(self, points: ArrayLike, confidence: ArrayLike | None = None) -> Lifted:
        """Lift the keypoints of n objects, or of one.

        Args:
            points: (n, q, 2) or (q, 2) keypoints in the layout of this lifter, x right and y down,
                in pixels or any other unit that is the same for x and y: multiply shares of width
                and height, from 0 to 1, by the image's size. A keypoint at (0, 0) or with a NaN is
                missing, and so is one that a mask of `numpy.ma` hides.
            confidence: (n, q) or (q,), from 0, which is missing, to 1; a boolean array of
                visibility serves too. On another scale there is a Python warning, and more than 1
                counts as 1. None: all keypoints have confidence 1.

        Returns:
            The n objects; n is 1 for points (q, 2).

        Raises:
            ValueError: the arrays do not fit each other or the layout, or no object of the layout
                can have as many keypoints as the option `min_visible` asks for.
        """
        self._check_layout()
        warn_of_scale(confidence)
        seen = from_arrays(points, confidence, self.layout)
        return lift_all(self.lift, *self._to_model(seen.points, seen.confidence))

    def check(
        self,
        points: ArrayLike,
        confidence: ArrayLike | None = None,
        image_size: tuple[int, int] | None = None,
    ) -> list[str]:
        """Return what looks wrong in keypoints and their shapes, a sentence each with the remedy.

        A call does not check. These are the checks of the program `lift`: units, places that stand
        for missing keypoints, confidences, a poor fit, keypoints that are often wrong; of people
        also axes that point elsewhere, and left and right exchanged. Of another object, no check
        tells whether it is mirrored, or lies on its side.

        Args:
            points: as of a call; many objects tell more than one.
            confidence: as of a call.
            image_size: width and height of the image in pixels; None: unknown.

        Raises:
            ValueError: as a call.
        """
        from deep_nrsfm_ros.lifting import sanity  # it imports this file

        lifted = self(points, confidence)
        seen = from_arrays(points, confidence, self.layout)
        raw = np.asarray(points, np.float64).reshape(seen.points.shape)
        given = seen.confidence if confidence is None else np.asarray(confidence, np.float64)
        given = given.reshape(seen.confidence.shape)
        is_lifted = ~np.isnan(lifted.residual)
        answer = lifted if is_lifted.any() else None
        with in_python():
            found = sanity.check(seen.points, given, None, image_size, None, answer)
            found += sanity.find_origin(raw, given)
            if sanity.is_person(self.model.layout):
                found += sanity.pose(lifted.rotations, seen.confidence, self.layout)
            names = self.model.layout.keypoints
            found += sanity.wrong_keypoints(lifted.wrong[is_lifted], names)
        return [str(each) for each in found]

    def _check_layout(self) -> None:
        """Raise ValueError if the layout has fewer keypoints of the model than `min_visible`."""
        least, to_model = self.options.min_visible, self._to_model
        shown = np.isin(self.model.layout.keypoints, to_model.filled)
        most = int(to_model.detected_count(shown[None])[0])
        if least > max(most, LiftingOptions.min_visible):
            raise ValueError(
                f"min_visible is {least}, but layout {self.layout.name!r} has {most} keypoints of "
                f"model {self.model.name!r}, without those that follow from others: nothing would "
                f"be lifted; set it to at most {most}, 4 is typical"
            )

    def detected_count(self, confidence: Float32) -> NDArray[np.int64]:
        """Return the number (n,) of keypoints that count for the option `min_visible`.

        Args:
            confidence: (n, p) as in `lift`.
        """
        return self._to_model.detected_count(trusted(keypoint_weight(confidence)))

    def memory(self) -> Memory:
        """Return an empty memory, for the identities of one stream."""
        bones = self.constants.bones
        layout = StateLayout(len(self.model.layout), len(bones.lengths) if bones else 0)
        return Memory(layout, self.constants.history.depth_cutoff)

    def learned_lengths(self, memory: Memory, identity: str) -> tuple[dict[str, float], float]:
        """Return what is learned of an object's bones.

        Args:
            memory: of this lifter.
            identity: of the object.

        Returns:
            The length of each bone in the unit of `Lifted.shapes`, by the names of its ends; a
            bone that was never seen is left out, and so is one of the right side, which has the
            length of the left one. And the seconds of sight behind the best known length; 0:
            nothing is learned.
        """
        constants, row = self.constants, memory.row(identity)
        bones = constants.bones
        if bones is None or row is None or np.isnan(row[0]):
            return {}, 0.0
        state = StateLayout(len(self.model.layout), len(bones.lengths)).split(row[None])
        learned = Learned(state.growth, state.evidence, state.misfit)
        lengths = own_bones(bones, learned, constants.history.bones_time).lengths[0]
        if constants.reference:
            reference, length = constants.reference, constants.reference_length
            lengths = in_reference_units(lengths, bones.ends, reference, length)
        first_of_pair = constants.bone_partners >= np.arange(len(lengths))
        shown = first_of_pair & (state.evidence[0] > 0)
        named = named_lengths(lengths, bones.ends, self.model.layout.keypoints, shown)
        return named, float(state.evidence.max(initial=0))

    def lift(
        self,
        points: Float32,
        confidence: Float32,
        *,
        perspective: bool = False,
        context: Context | None = None,
    ) -> Lifted:
        """Lift an observation in the model's layout, without the checks of a call.

        Keypoints that a map from this lifter's layout derives do not count for `min_visible`.
        A confidence is a weight: see `lifting.weights`.

        Args:
            points: (n, p, 2) float32, finite.
            confidence: (n, p) float32 in [0, 1]; 0 is missing.
            perspective: whether the points are on the plane z = 1 of a camera that looks at the
                object (see `perspective.virtual_views`); the correction uses the ray of each point.
            context: what is remembered of the objects, and gravity; its states are updated. None:
                the answer depends on this message alone.

        Raises:
            ValueError: the arrays do not fit each other or the model.
        """
        p = len(self.model.layout)
        if points.shape[1:] != (p, 2) or confidence.shape != points.shape[:2]:
            raise ValueError(
                f"points are {points.shape} and confidence {confidence.shape}; "
                f"model {self.model.name!r} needs (n, {p}, 2) and (n, {p})"
            )
        if self.options.mirrored:
            points, context = points * _MIRROR_IN_IMAGE, context and _mirrored_context(context)
        arrays, not_lifted = self.backend(points, confidence, perspective, context)
        lifted = Lifted(*arrays)
        if self.options.mirrored:
            lifted = _mirrored(lifted)
        return mark_not_lifted(lifted, not_lifted) if not_lifted.any() else lifted


def warn_of_scale(confidence: ArrayLike | None) -> None:
    """Give a Python warning, at the caller's caller, for confidences that are not from 0 to 1."""
    if confidence is None:
        return
    from deep_nrsfm_ros.lifting.sanity import confidence_scale  # it imports this module

    given = np.atleast_1d(np.asarray(confidence))
    for finding in confidence_scale(given) if given.dtype.kind in "fiu" else ():
        warnings.warn(str(finding), stacklevel=3)


def _checked(argument: str, given: Any, cls: type[_Options]) -> _Options:
    """Return options whose values are in their ranges; the defaults for None.

    Args:
        argument: name of the argument, for the error text.
        given: an instance of `cls`, or None.
        cls: the dataclass of the options.

    Raises:
        TypeError: the options are of another type.
        ValueError: a value is out of range; the text names option, value and range.
    """
    if given is None:
        return cls()
    if not isinstance(given, cls):
        raise TypeError(f"{argument} is a {type(given).__name__}; give {cls.__name__}(NAME=VALUE)")
    check(given)
    return given


def check_min_visible(name: str, min_visible: int, model: Model) -> None:
    """Raise ValueError if no object can have as many detected keypoints as an option asks for.

    The default is allowed for every model.

    Args:
        name: of the option, for the error text.
        min_visible: as in `LiftingOptions`.
        model: lifts the objects.
    """
    p = len(model.layout)
    own = KeypointMap(model.layout, model.layout)
    most = int(own.detected_count(np.ones((1, p), bool))[0])
    if min_visible <= max(most, LiftingOptions.min_visible):
        return
    following = f", of which {p - most} follow from others and do not count" * (most < p)
    raise ValueError(
        f"{name} is {min_visible}, but model {model.name!r} has {p} keypoints{following}: no "
        f"object would be lifted; set it to at most {most}, 4 is typical"
    )


def _mirrored_context(context: Context) -> Context:
    """Return the context in the axes of the mirrored camera, whose x axis points to the left."""
    up, to_view = context.up, context.to_view
    return context._replace(
        up=None if up is None else np.asarray(up) * _MIRROR_IN_CAMERA,
        to_view=None
        if to_view is None
        else _MIRROR_IN_CAMERA[:, None] * to_view * _MIRROR_IN_CAMERA,
    )


def _mirrored(lifted: Lifted) -> Lifted:
    """Return the mirror images of lifted objects: left and right exchanged in image and object."""
    return lifted._replace(
        shapes=lifted.shapes * _MIRROR_IN_CAMERA,
        rotations=_MIRROR_IN_CAMERA[:, None] * lifted.rotations * _MIRROR_IN_OBJECT,
        translation=lifted.translation * _MIRROR_IN_IMAGE,
    )


def _constants(
    model: Model, options: LiftingOptions, history: HistoryOptions, to_model: KeypointMap
) -> LifterConstants:
    """Return model and options in the form that a backend computes with."""
    p, error_covariance = len(model.layout), model.covariance_for(to_model.filled)
    angles = 2 * np.pi * np.arange(options.test_time_rotations) / options.test_time_rotations
    c, s = np.cos(angles), np.sin(angles)
    covariance = None
    if options.correction in ("bones", "learned"):
        to_object = np.kron(np.eye(p), model.object_frame)
        covariance = to_object.T @ error_covariance @ to_object
    elif options.correction == "back_projection":
        covariance = np.eye(3 * p)
    pair = model.layout.reference
    bones = model.bones if options.correction == "bones" else None
    ends = np.zeros((2, 0), np.int32) if bones is None else bones.ends
    return LifterConstants(
        network=model.network,
        normaliser=model.normaliser,
        object_frame=model.object_frame,
        test_time_rotations=np.array([[c, -s], [s, c]], np.float32).transpose(2, 0, 1).copy(),
        partners=model.layout.partners() if options.test_time_mirror else None,
        covariance=covariance,
        bones=bones,
        # The constants of the confidence were fitted with this covariance.
        error_std=np.sqrt(model.error_covariance.diagonal().reshape(p, 3).sum(1)),
        noise=options.noise,
        refill=options.refill,
        reference_length=options.length_for(model.layout),
        reference=pair and (model.layout.index(pair[0]), model.layout.index(pair[1])),
        min_visible=options.min_visible,
        leave_out_wrong=options.leave_out_wrong,
        derivations=to_model.derivations,
        history=history,
        bone_partners=partner_bones(ends, model.layout.sides()),
        axis=model.layout.vertical_axis(),
        calibration=CALIBRATED,
    )


def lift_all(
    lift: Callable[[Float32, Float32], Lifted],
    points: Float32,
    confidence: Float32,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Lifted:
    """Lift any number of objects, in slices of at most 64 to stay in cache.

    Large results are in temporary files (`large_arrays.empty`).

    Args:
        lift: `Lifter.lift`, or a function of the same two arrays.
        points: (n, p, 2) as in `Lifter.lift`.
        confidence: (n, p) as in `Lifter.lift`.
        on_progress: called after each slice with the number of lifted objects and n.
    """
    n = len(points)
    first, *rest = slices(n, _BLOCK) or [slice(0)]
    lifted = lift(points[first], confidence[first])
    on_progress(first.stop, n)
    if not rest:
        return lifted
    # Each slice goes to its place, so that memory holds the objects but once.
    result = Lifted._make(empty((n, *array.shape[1:]), array.dtype) for array in lifted)
    for i, part in enumerate((first, *rest)):
        if part is not first:
            lifted = lift(points[part], confidence[part])
        for array, values in zip(result, lifted, strict=True):
            array[part] = values
        if i % _RELEASED == 0:
            release(result)
        on_progress(part.stop, n)
    return result


def mark_not_lifted(lifted: Lifted, not_lifted: NDArray[np.bool_]) -> Lifted:
    """Set the chosen objects (n,) to NaN and their confidence to 0, in place; return `lifted`."""
    for array in lifted:
        array[not_lifted] = 0 if array.dtype == bool else np.nan
    lifted.confidence[not_lifted] = 0
    return lifted
