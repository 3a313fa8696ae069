# SPDX-License-Identifier: Apache-2.0
"""Fine-tuning: a training that starts from a trained model instead of from random weights.

Architecture and normaliser stay those of the model: its weights mean nothing in others.

The whitening L defines what the first dictionary means, because D_1 is a dictionary of L S. Encoder
and decoder share D_1, so no change of D_1 compensates a change of L in both: (L D)^T would have to
compensate what L^-1 D does not. With the same keypoints L therefore stays, and the training starts
with the quality of the model. With other keypoints L has another size. It is computed from
the new data, as for a fresh network, and D_1 keeps its rows: the whitened coordinates of one object
are similar whichever keypoints are added. docs/devlog has the errors at the start of this and of
other conversions.

A keypoint that the model does not have starts with zero weights: the encoder ignores it, and the
decoder puts it at the centre. It is learned from there, because its gradient comes from the code,
which is not zero.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.spelling import match_names
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.geometry import Array
from deep_nrsfm_ros.nrsfm.network import Network
from deep_nrsfm_ros.nrsfm.recipe import Preset
from deep_nrsfm_ros.training.learned_frames import LEARNED_FRAMES, joined_marks

RARELY_SHOWN = "rarely_shown"
"""Key of a provenance: keypoints that less than half of the frames show."""

_FEWEST = 4  # keypoints, as for lifting: fewer than a tetrahedron has are no 3D shape

_FRAMES_A_STEP = 3  # 64 a batch are 21 passes over the frames
_MIN_STEPS = 100
_WITHOUT_WHITENING = 10  # times as many steps, as new keypoints are learned from nothing


def start_from(model: Model, layout: KeypointLayout) -> Network:
    """Return the network of `model` for the keypoints of `layout`, matched by name.

    Args:
        model: the model to start from.
        layout: layout of the new model.

    Returns:
        The network. With other keypoints than the model's it is not whitened (L is the identity).

    Raises:
        ValueError: fewer than 4 keypoints match.
    """
    places = match_names(layout.keypoints, model.layout.keypoints)
    pairs = [(i, places[k]) for i, k in enumerate(model.layout.keypoints) if k in places]
    if len(pairs) < _FEWEST:
        raise ValueError(
            f"model {model.name!r} and layout {layout.name!r} share {len(pairs)} keypoints by "
            f"name; at least {_FEWEST} are needed to start from it"
        )
    old, to = (np.array(places) for places in zip(*pairs, strict=True))
    net, p = model.network, len(layout)

    def moved(rows: Array) -> Array:
        result = np.zeros((p, *rows.shape[1:]), np.float32)
        result[to] = rows[old]
        return result

    L = L_inverse = np.eye(p, dtype=np.float32)
    if len(pairs) == p == net.p:
        L, L_inverse = (moved(moved(A).T).T.copy() for A in (net.L, net.L_inverse))
    return dataclasses.replace(
        net,
        D=(moved(net.D[0]), *net.D[1:]),
        b_=(moved(net.b_[0]), *net.b_[1:]),
        L=L,
        L_inverse=L_inverse,
    )


def steps_from(start: Network, frames: int) -> int:
    """Return the number of steps of a training that starts from a network.

    A trained network has learned what shapes there are, so that about 21 passes over the new frames
    suffice; with more it fits their noise. `benchmarks/real/fine_tuning.py` compares numbers.

    Args:
        start: as `start_from` returns it.
        frames: of all processes.
    """
    steps = max(frames // _FRAMES_A_STEP, _MIN_STEPS)
    return _WITHOUT_WHITENING * steps if lacks_whitening(start) else steps


def lacks_whitening(start: Network) -> bool:
    """Return whether a start, as `start_from` returns it, is not whitened.

    It is not where its keypoints are not those of its model, or where the model has no whitening.
    """
    return np.array_equal(start.L, np.eye(start.p))


def check_fixed_options(model: Model, preset: Preset, name_of: Callable[[str], str] = str) -> None:
    """Raise ValueError unless `preset` has the architecture and the normaliser of `model`.

    Args:
        model: the model to start from.
        preset: the preset to train with.
        name_of: returns the name of an option, for the message.
    """
    fixed, wanted = (
        dataclasses.asdict(architecture) | dataclasses.asdict(normaliser)
        for architecture, normaliser in (
            (model.network.architecture, model.normaliser),
            (preset.architecture, preset.normaliser),
        )
    )
    for name, value in wanted.items():
        if value != fixed[name]:
            raise ValueError(
                f"{name_of(name)} is {value}; model {model.name!r}, from which to start, has "
                f"{fixed[name]}: leave the option out"
            )


def inherit(trained: Model, start: Model) -> Model:
    """Return the model `trained` from `start` with the origin in its provenance.

    Where the layout names no handedness, the object frame is that of `start` too: the network keeps
    the axes of its start and the sign of depth. So are the bones where `start` has learned them
    from many people, as a training on one person from few sides does not see their lengths
    (docs/devlog/training.md has the errors with either). The error covariance is the new network's,
    unless frames rarely show some keypoints: those of an upper body, filled in, make whole people
    worse, and the covariance of `start` does not.
    """
    origin = {"model": start.name, "data": start.provenance.get("data", "unknown")}
    if trained.provenance["recipe"]["steps"] == 0:  # the network is that of the start
        origin |= {k: v for k, v in start.provenance.items() if k != LEARNED_FRAMES}
    model = dataclasses.replace(trained, provenance=trained.provenance | {"from": origin})
    if trained.layout.keypoints == start.layout.keypoints:  # a mark is of the keypoints of a layout
        model.provenance[LEARNED_FRAMES] = joined_marks(trained, start)
    if not trained.layout.handedness:
        model = dataclasses.replace(model, object_frame=start.object_frame)
    if _has_better_covariance(start, trained):
        model.provenance["from"]["error_covariance"] = "kept"
        model = dataclasses.replace(
            model,
            error_covariance=start.error_covariance,
            hidden_keypoints=start.hidden_keypoints,
            hidden_covariance=start.hidden_covariance,
        )
    if _has_better_bones(start, trained):
        model.provenance["from"]["bones"] = "kept"
        model = dataclasses.replace(
            model, bone_lengths=start.bone_lengths, bone_correlation=start.bone_correlation
        )
    return model


def _has_better_bones(start: Model, trained: Model) -> bool:
    """Return whether the bones of `start` are of the same layout and of more people."""
    same = trained.layout.keypoints == start.layout.keypoints
    same = same and trained.layout.bone_indices() == start.layout.bone_indices()
    anew = trained.provenance["recipe"]["steps"] == 0  # what such a training is for
    return same and not anew and start.bone_correlation.size > trained.bone_correlation.size


def _has_better_covariance(start: Model, trained: Model) -> bool:
    """Return whether `start` knows the errors of keypoints that the frames rarely show.

    They are the new network's too, as far as its weights are those of the start.
    """
    said = trained.provenance
    same = trained.layout.keypoints == start.layout.keypoints and start.error_covariance.size > 0
    has_share = said["recipe"]["start_share"] > 0 and said["recipe"]["steps"] != 0
    return same and has_share and RARELY_SHOWN in said and "last_step" not in said
