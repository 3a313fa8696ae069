"""Fine-tuning: a training that starts from a trained model instead of from chance.

Architecture and normaliser stay those of the model: its weights mean nothing in others.

The whitening L decides what the first dictionary means, D_1 being a dictionary of L S. Encoder
and decoder share D_1, so no change of it undoes a change of L in both: (L D)^T would have to
undo what L^-1 D does not. So with the same keypoints L stays as it is, and the training starts
as good as the model. With others L has to be another matrix; it is then computed from the new
data, as for a fresh network, and D_1 keeps its rows, for whitened coordinates of one object look
alike whatever else is seen of it. On a synthetic object with points taken away and added, that
started at a reprojection error of 0.19 to 0.35; converting D_1 by L_new L_old^-1 started at 0.36
to 0.84, keeping the block of L that both share at 0.34 to 0.59, and a fresh network at 1.

A keypoint that the model does not know starts at zero: the encoder does not hear it yet, the
decoder puts it at the centre, and neither harms the others. From there it is learned, since its
gradient comes from the code, which is not zero.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.geometry import Array
from deep_nrsfm_ros.nrsfm.network import Network
from deep_nrsfm_ros.nrsfm.recipe import Preset

_FEWEST = 4  # as for lifting: less than a tetrahedron is no shape


def start_from(model: Model, layout: KeypointLayout) -> Network:
    """Return the network of `model` for the keypoints of `layout`, matched by name.

    With other keypoints than the model's it is not yet whitened. Raises ValueError when fewer
    than 4 keypoints match.
    """
    new = {name: i for i, name in enumerate(layout.keypoints)}
    pairs = [(i, new[name]) for i, name in enumerate(model.layout.keypoints) if name in new]
    if len(pairs) < _FEWEST:
        raise ValueError(
            f"model {model.name!r} knows {len(pairs)} of the {len(new)} keypoints of "
            f"{layout.name!r}; at least {_FEWEST} are needed to start from it"
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
    """Return the model `trained` from `start` with what it owes to it.

    That is a line in the provenance, and the object's axes where its layout names no handedness:
    the network has kept the axes of its start, and which way round depth is.
    """
    origin = {"model": start.name, "data": start.provenance.get("data", "unknown")}
    model = dataclasses.replace(trained, provenance=trained.provenance | {"from": origin})
    if not trained.layout.handedness:
        model = dataclasses.replace(model, object_frame=start.object_frame)
    return model
