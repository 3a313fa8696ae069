# SPDX-License-Identifier: Apache-2.0
"""The last step of a training: from the trained network to a model that can be lifted with."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch

from deep_nrsfm_ros import __version__
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.virtual_people import FACE_KEYPOINTS
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.correction import (
    bone_lengths,
    error_covariance,
    hidden_covariance,
    varied_bones,
)
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.geometry import Floats, centre
from deep_nrsfm_ros.nrsfm.handedness import object_frame
from deep_nrsfm_ros.nrsfm.network import coherence, complete, reconstruct
from deep_nrsfm_ros.nrsfm.normalisation import normalise
from deep_nrsfm_ros.training.trainer import Trainer

_MOST_FRAMES = 2048  # on which the object frame, the error covariance and the bones are measured


def finish(
    trainer: Trainer,
    name: str,
    layout: KeypointLayout,
    source: str,
    people: Dataset | None = None,
) -> Model:
    """Return the trained model with object frame, error covariance, bones and provenance.

    Args:
        trainer: the trainer that `loop.train` has returned.
        name: name of the model.
        layout: layout of the p keypoints that the trainer was trained on.
        source: where the data come from, in words, for the provenance.
        people: complete frames of many different objects in this layout, from which the error
            covariance and the bones are learned (see `data.virtual_people`). None: from frames of
            the training.

    Returns:
        The model. Its `quality` is label-free: errors relative to the size of the object, 0 is
        perfect; the coherence of the final dictionary, 0 to 1; and the share of frames with
        mirrored depth, 0 to 0.5, where the frames tell it and the training came to its end.
    """
    net = trainer.net.map(lambda w: w.cpu().numpy())
    normaliser = trainer.preset.normaliser

    def lift(W: Floats) -> tuple[Floats, Floats, Floats]:
        """Return shapes S, cameras M and the normalised input of complete points W (f, p, 2)."""
        encoded = normaliser.encode(W, np.ones_like(W[..., :1]))
        return *reconstruct(net, encoded.W), encoded.W

    def lift_without_face(W: Floats) -> tuple[Floats, Floats, Floats]:
        """Return what `lift` does, centred, from the keypoints other than those of the face."""
        visible = np.array([[name not in FACE_KEYPOINTS] for name in layout.keypoints])
        points, mask = W, np.broadcast_to(visible, (*W.shape[:2], 1)).astype(W.dtype)
        for _ in range(1 + LiftingOptions().refill):
            encoded = normalise(net, normaliser, points, mask)
            S, M = reconstruct(net, encoded.gain * encoded.W)
            points = np.where(visible, W, normaliser.decode(S @ M, encoded))
            mask = np.ones_like(mask)
        return centre(S), M, centre((W - encoded.origin) / encoded.unit)

    sample = trainer.sample(min(_MOST_FRAMES, 4 * len(trainer.frames)))
    mask = sample.mask.cpu().numpy()
    W, _ = complete(net, sample.points.cpu().numpy(), mask)
    S, _, _ = lift(W)
    rng = np.random.default_rng(trainer.seed)
    if people is not None:
        W = people.points
    covariance, pairs = error_covariance(lift, W, rng), layout.bone_indices()
    if people is not None and pairs:
        lengths, correlation = varied_bones(lift, W, pairs, covariance, rng)
    else:
        lengths = bone_lengths(lift, W, pairs, covariance, rng)
        correlation = np.zeros((0, 0), np.float32)
    hidden = FACE_KEYPOINTS if set(FACE_KEYPOINTS) <= set(layout.keypoints) else ()
    without_face = (
        hidden_covariance(lift, lift_without_face, W, covariance, rng)
        if hidden
        else np.zeros(0, np.float32)
    )
    if people is None and trainer.from_random:
        covariance *= trainer.preset.recipe.error_scale
        without_face *= trainer.preset.recipe.error_scale
    provenance = _provenance(trainer, source)
    if people is not None:
        provenance["last_step"] = {"data": people.source, "frames": len(people)}
    return Model(
        name,
        net,
        layout,
        normaliser,
        object_frame(S, layout, mask[..., 0] > 0),
        error_covariance=covariance,
        bone_lengths=lengths,
        bone_correlation=correlation,
        hidden_keypoints=hidden,
        hidden_covariance=without_face,
        provenance=provenance,
        quality=_quality(trainer, coherence(net)),
    )


def _provenance(trainer: Trainer, source: str) -> dict[str, Any]:
    """Return how the model was made, for its file."""
    provenance: dict[str, Any] = {
        "data": source,
        "frames": trainer.total_frames,
        "recipe": dataclasses.asdict(trainer.preset.recipe),
    }
    if trainer.objective.layout_loss is not None:
        provenance["layout_loss"] = dataclasses.asdict(trainer.objective.layout_loss.weights)
    if trainer.known is not None:
        provenance["factorisation"] = {
            "solutions": trainer.known.solutions,
            "spread": round(trainer.known.spread, 4),
        }
    provenance |= {"seed": trainer.seed, "step": trainer.step}
    if trainer.kept_step is not None:
        provenance["kept_step"] = trainer.kept_step
    provenance["cpu_seconds"] = round(trainer.cpu_seconds, 2)  # of the first process
    if trainer.group.size > 1:
        provenance["processes"] = trainer.group.size
    provenance["versions"] = {"deep_nrsfm_ros": __version__, "torch": torch.__version__}
    return provenance


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
