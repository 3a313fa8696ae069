# SPDX-License-Identifier: Apache-2.0
"""The last step of a training: from the trained network to a model that can be lifted with."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from deep_nrsfm_ros import __version__
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.virtual_people import FACE_KEYPOINTS
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.correction import (
    Lift,
    bone_lengths,
    error_covariance,
    hidden_covariance,
    varied_bones,
)
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.geometry import Floats, centre
from deep_nrsfm_ros.nrsfm.handedness import object_frame
from deep_nrsfm_ros.nrsfm.network import Network, coherence, complete, reconstruct
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser, normalise
from deep_nrsfm_ros.training.fine_tuning import RARELY_SHOWN
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.learned_frames import LEARNED_FRAMES, frame_marks, marks_in_words
from deep_nrsfm_ros.training.trainer import Trainer

_SHOWN = 0.5  # share of the frames; of keypoints shown in fewer, most errors are of filled-in ones
_MOST_FRAMES = 2048  # on which the object frame, the error covariance and the bones are measured


class _ErrorStatistics(NamedTuple):
    """What a model knows of the errors of its network; the fields are those of `Model`."""

    error_covariance: NDArray[np.float32]
    bone_lengths: NDArray[np.float32]
    bone_correlation: NDArray[np.float32]
    hidden_keypoints: tuple[str, ...]
    hidden_covariance: NDArray[np.float32]


def finish(
    trainer: Trainer,
    name: str,
    layout: KeypointLayout,
    source: str,
    last_step_data: Dataset | None = None,
) -> Model:
    """Return the trained model with object frame, error covariance, bones and provenance.

    Args:
        trainer: the trainer that `loop.train` has returned.
        name: name of the model.
        layout: layout of the p keypoints that the trainer was trained on.
        source: where the data come from, in words, for the provenance.
        last_step_data: complete frames of many different objects in this layout, from which the
            error covariance and the bones are learned (see `data.virtual_people` and
            `data.virtual_hands`). None: from frames of the training.

    Returns:
        The model. Its `quality` is label-free: errors relative to the size of the object, 0 is
        perfect; the coherence of the final dictionary, 0 to 1; and the share of frames with
        mirrored depth, 0 to 0.5, where the frames tell it and the training came to its end.
    """
    net = trainer.net.map(lambda w: w.cpu().numpy())
    # Frames are drawn with replacement: four times their number leaves out 2 % of them.
    sample = trainer.sample(min(_MOST_FRAMES, 4 * len(trainer.frames)))
    mask = sample.mask.cpu().numpy()
    W, _ = complete(net, sample.points.cpu().numpy(), mask)
    S, _, _ = _lift(net, trainer.preset.normaliser)(W)
    statistics = _error_statistics(trainer, net, layout, W, last_step_data)
    provenance = _provenance(trainer, source)
    shares = mask[..., 0].mean(0)
    if rare := [k for k, share in zip(layout.keypoints, shares, strict=True) if share < _SHOWN]:
        provenance[RARELY_SHOWN] = rare
    if last_step_data is not None:
        provenance["last_step"] = {"data": last_step_data.source, "frames": len(last_step_data)}
    provenance[LEARNED_FRAMES] = _marks(trainer.frames)
    return Model(
        name,
        net,
        layout,
        trainer.preset.normaliser,
        object_frame(S, layout, mask[..., 0] > 0),
        **statistics._asdict(),
        provenance=provenance,
        quality=_quality(trainer, coherence(net)),
    )


def _error_statistics(
    trainer: Trainer,
    net: Network,
    layout: KeypointLayout,
    W: Floats,
    last_step_data: Dataset | None,
) -> _ErrorStatistics:
    """Return error covariances and bones of a network.

    Args:
        trainer: gives seed, normaliser and recipe.
        net: the network, of arrays.
        layout: of its p keypoints.
        W: (n, p, 2) complete frames of the training.
        last_step_data: frames to learn from in place of W; see `finish`.
    """
    rng, recipe = np.random.default_rng(trainer.seed), trainer.preset.recipe
    lift = _lift(net, trainer.preset.normaliser)
    if last_step_data is not None:
        W = last_step_data.points
    covariance, pairs = error_covariance(lift, W, rng), layout.bone_indices()
    if last_step_data is not None and pairs:
        lengths, correlation = varied_bones(lift, W, pairs, covariance, rng)
    else:
        lengths = bone_lengths(lift, W, pairs, covariance, rng)
        correlation = np.zeros((0, 0), np.float32)
    hidden: tuple[str, ...] = ()
    without_face: NDArray[np.float32] = np.zeros(0, np.float32)
    if set(FACE_KEYPOINTS) <= set(layout.keypoints):
        hidden = FACE_KEYPOINTS
        lift_without_face = _lift_without_face(net, trainer.preset.normaliser, layout)
        without_face = hidden_covariance(lift, lift_without_face, W, covariance, rng)
    if last_step_data is None and trainer.from_random:
        covariance *= recipe.error_scale
        without_face *= recipe.error_scale
    return _ErrorStatistics(covariance, lengths, correlation, hidden, without_face)


def _lift(net: Network, normaliser: Normaliser) -> Lift:
    """Return a function that lifts complete points W (f, p, 2).

    It returns shapes S, cameras M and the normalised points.
    """

    def lift(W: Floats) -> tuple[Floats, Floats, Floats]:
        encoded = normaliser.encode(W, np.ones_like(W[..., :1]))
        return *reconstruct(net, encoded.W), encoded.W

    return lift


def _lift_without_face(net: Network, normaliser: Normaliser, layout: KeypointLayout) -> Lift:
    """Return what `_lift` does, but from the keypoints other than those of the face; S is centred.

    The face is filled in as the lifter fills in missing keypoints: by the network's prior, then by
    what the network lifts.
    """
    visible = np.array([[name not in FACE_KEYPOINTS] for name in layout.keypoints])

    def lift(W: Floats) -> tuple[Floats, Floats, Floats]:
        points, mask = W, np.broadcast_to(visible, (*W.shape[:2], 1)).astype(W.dtype)
        for _ in range(1 + LiftingOptions().refill):
            encoded = normalise(net, normaliser, points, mask)
            S, M = reconstruct(net, encoded.gain * encoded.W)
            points = np.where(visible, W, normaliser.decode(S @ M, encoded))
            mask = np.ones_like(mask)
        return centre(S), M, centre((W - encoded.origin) / encoded.unit)

    return lift


def _provenance(trainer: Trainer, source: str) -> dict[str, Any]:
    """Return how the model was made, for its file."""
    provenance: dict[str, Any] = {
        "data": source,
        "frames": trainer.total_frames,
        "recipe": dataclasses.asdict(trainer.preset.recipe),
    }
    if trainer.objective.layout_loss is not None:
        provenance["layout_loss"] = dataclasses.asdict(trainer.objective.layout_loss.weights)
    if trainer.factorisation is not None:
        provenance["factorisation"] = {
            "solutions": trainer.factorisation.solutions,
            "spread": round(trainer.factorisation.spread, 4),
        }
    if trainer.minutes_needed:
        provenance["factorisation_needs_minutes"] = trainer.minutes_needed
    provenance |= {"seed": trainer.seed, "step": trainer.step}
    if trainer.kept_step is not None:
        provenance["kept_step"] = trainer.kept_step
    provenance["cpu_seconds"] = round(trainer.cpu_seconds, 2)  # of the first process
    if trainer.group.size > 1:
        provenance["processes"] = trainer.group.size
    provenance["versions"] = {"deep_nrsfm_ros": __version__, "torch": torch.__version__}
    return provenance


def _marks(frames: FrameStore) -> str:
    """Return the marks of the frames that a training uses, of its first process."""
    points, visible = frames.points.cpu().numpy(), frames.visible.cpu().numpy()
    usable = frames.usable.cpu().numpy()
    if len(usable) == len(points):
        return marks_in_words(frame_marks(points, visible))
    return marks_in_words(frame_marks(points[usable], visible[usable]))


def _quality(trainer: Trainer, dictionary_coherence: float) -> dict[str, float]:
    """Return the label-free quality of the model, for its file."""
    reprojection_error, cycle_error = trainer.measure()
    quality = {
        "reprojection_error": round(reprojection_error, 5),
        "cycle_error": round(cycle_error, 5),
        "combined": round(math.hypot(reprojection_error, cycle_error), 5),
        "coherence": round(dictionary_coherence, 5),
    }
    if not math.isnan(trainer.mirrored_share):
        quality["mirrored_share"] = round(trainer.mirrored_share, 5)
    return quality
