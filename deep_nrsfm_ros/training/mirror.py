# SPDX-License-Identifier: Apache-2.0
"""Mirrored frames in training: found without labels, and repaired in the network.

`MirrorTest` of `nrsfm.neighbours` on the frames of a training. Its reference shapes depend on the
frames alone, so all seeds share them. As known shapes of the cycle loss they teach a network the
handedness that most of its frames have already.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.nrsfm.geometry import Floats, align, centre, centre_visible
from deep_nrsfm_ros.nrsfm.neighbours import (
    MirrorTest,
    Neighbours,
    Reference,
    join,
    mirrored_frames,
    nearest,
    rigid_shapes,
)
from deep_nrsfm_ros.nrsfm.network import Network, reconstruct, whiten, whitening_network
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser, normalise
from deep_nrsfm_ros.nrsfm.recipe import Recipe
from deep_nrsfm_ros.training.distributed import ALONE, ProcessGroup
from deep_nrsfm_ros.training.few_frames import FactorisedShapes
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.trainer import KnownShapes, Trainer, second_moment
from deep_nrsfm_ros.wording import wording

MOST_FRAMES = 15_000
"""Frames of the reference: 11 s on one core, 220 MB."""
TOLERATED = 0.005
"""Share of mirrored frames up to which a network counts as not mirrored."""
REPAIRED = 0.001
"""Share of mirrored frames up to which a network is not repaired."""
ALWAYS_FROM = 0.2
"""Progress of a training from which `Recipe.reference` "always" takes the reference shapes."""
MIN_TESTED = 0.5
"""Share of the frames that the test must tell something about, for its share to count."""

_NEIGHBOURS = 16
_MIN_WEIGHT = 0.3  # of a reference shape that is taught


def most_frames(recipe: Recipe) -> int:
    """Return the frames of the reference, so that it takes about 3 % of the training's time."""
    taken = recipe.steps * recipe.batch / (10_000 * 64)
    return int(np.clip(MOST_FRAMES * math.sqrt(taken), 1000, MOST_FRAMES))


def warning(share: float) -> str:
    """Return a warning if the share of mirrored frames is more than tolerated, else ""."""
    if not share > TOLERATED:  # NaN: unknown
        return ""
    return (
        f"{100 * share:.1f} % of the frames have a mirrored depth: frames of nearly the same shape "
        "from other sides are lifted as its mirror image; train with another seed "
        f"({wording('--seed', node='train.seed', python='Recipe.seed')}) or more of them "
        f"({wording('--seeds', node='train.seeds', python='Recipe.seeds')})"
    )


class MirrorCheck:
    """The mirror test on a fixed sample of the frames of one process.

    Attributes:
        points: (n, p, 2) the frames of the sample, 0 where missing.
        visible: (n, p).
        on_progress: called with the frames done and n while the reference is computed.
    """

    def __init__(
        self,
        frames: FrameStore,
        normaliser: Normaliser,
        most: int = MOST_FRAMES,
        group: ProcessGroup = ALONE,
    ) -> None:
        """Take the sample; the reference is computed when it is first needed.

        Args:
            frames: of this process.
            normaliser: of the network's input.
            most: frames of the sample; random ones if there are more.
            group: all its processes make the check at the same time.
        """
        order = np.random.default_rng(0).permutation(len(frames))[:most]
        batch = frames.batch(torch.from_numpy(np.sort(order)).to(frames.device))
        self.points: NDArray[np.float32] = batch.points.cpu().numpy()
        self._mask: NDArray[np.float32] = batch.mask.cpu().numpy()
        self.visible: NDArray[np.bool_] = self._mask[..., 0] > 0
        self.on_progress: Callable[[int, int], None] = lambda done, total: None
        self._normaliser, self._group = normaliser, group
        self._moment = second_moment(frames, normaliser, group)

    @cached_property
    def _reference(self) -> tuple[Neighbours, Reference]:
        """Return the neighbours of the sample's frames, and a shape of each."""
        net = whitening_network(self._moment)
        W = self._normalised(net)
        pairs = nearest(whiten(net, W), _NEIGHBOURS, self.on_progress)
        return pairs, join(rigid_shapes(W, pairs), pairs)

    def _normalised(self, net: Network) -> Floats:
        """Return the completed and normalised keypoints (n, p, 2), as the input of a network."""
        parts = [
            normalise(net, self._normaliser, self.points[rows], self._mask[rows]).W
            for rows in slices(len(self.points))
        ]
        return np.concatenate(parts) if parts else self.points

    def lift(self, net: Network) -> Floats:
        """Return the shapes (n, p, 3) of a network of arrays, centred, moved onto the keypoints."""
        S = np.empty((*self.points.shape[:2], 3))
        for rows in slices(len(S)):
            mask = self._mask[rows]
            W, gain, _, _ = normalise(net, self._normaliser, self.points[rows], mask)
            X, M = reconstruct(net, W * gain)
            S[rows] = centre(X + centre_visible(W - X @ M, mask) @ M.swapaxes(1, 2))
        return S

    def test(self, net: Network) -> MirrorTest:
        """Return which frames of the sample a network of arrays or tensors mirrors."""
        return self.test_shapes(self.lift(_arrays(net)), self.visible)

    def test_shapes(self, S: Floats, visible: NDArray[np.bool_]) -> MirrorTest:
        """Return which shapes (n, p, 3) of the sample's frames are mirrored; see `visible`."""
        return mirrored_frames(S, visible, self._reference[1])

    def share(self, net: Network) -> float:
        """Return the share of mirrored frames, 0 to 0.5; NaN where the frames tell too little.

        They do where most of them have no neighbour from another side, as a video from a fixed
        camera may be. In a group it is the mean over the processes, which all call this.
        """
        test = self.test(net)
        share, tested = self._group.mean((test.share, float(test.tested.mean())))
        return share if tested >= MIN_TESTED else math.nan

    def reference_shapes(self, net: Network) -> Tensor:
        """Return the reference shapes (m, p, 3) in the axes and the handedness of a network.

        Mirrored frames come out with the handedness of the majority, in the axes of a neighbour
        that is not mirrored. Missing keypoints are those that the network lifts.
        """
        pairs, reference = self._reference
        X = self.lift(_arrays(net))
        test = mirrored_frames(X, self.visible, reference)
        target = _unmirrored(X, test.mirrored, pairs)
        mirror = np.where(test.handedness[:, None, None] < 0, np.array([1, 1, -1]), 1)
        shapes = align(reference.shapes * mirror, target).aligned
        shapes *= np.linalg.norm(target, axis=(1, 2), keepdims=True)
        shapes = centre(np.where(self.visible[..., None], shapes, target))
        sound = test.tested & (reference.weights > _MIN_WEIGHT)
        return torch.from_numpy(shapes[sound].astype(np.float32))


def _unmirrored(X: Floats, mirrored: NDArray[np.bool_], pairs: Neighbours) -> Floats:
    """Return shapes X (n, p, 3) with the mirrored ones reflected into the axes of the others.

    Each is fitted to its nearest neighbour that is not mirrored, or to the mean of all of those.
    """
    if not mirrored.any():
        return X
    others = pairs.frames[mirrored]
    sound = np.logical_not(mirrored[others])
    has_one = np.asarray(sound.any(1), bool)[:, None, None]
    first = np.take_along_axis(others, sound.argmax(1)[:, None], 1)[:, 0]
    target = np.where(has_one, X[first], X[~mirrored].mean(0))
    result = X.copy()
    result[mirrored] = align(X[mirrored] * np.array([1, 1, -1]), target).aligned
    return result


def _arrays(net: Network) -> Network:
    """Return a network of arrays."""
    return net.map(lambda w: w if isinstance(w, np.ndarray) else w.detach().cpu().numpy())


class KnownShapesSource:
    """Sets the known shapes of the cycle loss that are not the network's own.

    They are factorised shapes, or where frames are mirrored the reference shapes of the test.

    The test is made after the screening and at each tenth of the steps. A network that mirrors
    more than `REPAIRED` is taught until the next test: images of the reference shapes from random
    cameras must be lifted as these shapes. They take the place of the network's own shapes, which
    repeat its mistakes.

    Attributes:
        reference: (m, p, 3) the reference shapes in the network's axes while it is taught by them,
            else None.
    """

    def __init__(
        self, check: MirrorCheck, recipe: Recipe, factorised: FactorisedShapes | None = None
    ) -> None:
        """Start without reference shapes.

        Args:
            check: the mirror test.
            recipe: of the training.
            factorised: what is taught from the first step to the last instead; see `few_frames`.
        """
        self.factorised = factorised
        self.check, self.mode = check, recipe.mirror_repair
        self.interval = max(recipe.steps // 10, 1)
        self.first = max(min(recipe.screening, self.interval), 1)  # a random network has no axes
        self.reference: Tensor | None = None

    def prepare(self, trainer: Trainer) -> None:
        """Set the known shapes of the trainer's next step, if it is to be taught."""
        step = trainer.step
        if self.factorised is not None:
            known = self.factorised.draw(trainer.batch, _generator(trainer))
            trainer.known = known.to(trainer.weights.device)
            return
        if self.mode == "off" or not trainer.preset.recipe.cycle:
            return
        if step == self.first or (step and step % self.interval == 0):
            self.reference = self._reference_shapes(trainer)
        if self.reference is None:
            return
        size = (trainer.batch,)
        chosen = torch.randint(len(self.reference), size, generator=_generator(trainer))
        trainer.known = KnownShapes(self.reference[chosen]).to(trainer.weights.device)

    def _reference_shapes(self, trainer: Trainer) -> Tensor | None:
        """Return the reference shapes to teach until the next test, None for none."""
        share = self.check.share(trainer.net)
        always = self.mode == "always" and trainer.progress >= ALWAYS_FROM
        if math.isnan(share) or not (share > REPAIRED or always):
            return None
        shapes = self.check.reference_shapes(trainer.net)
        return shapes if len(shapes) else None

    def state(self) -> dict[str, Tensor]:
        """Return all that `restore` needs, as named tensors."""
        return {} if self.reference is None else {"reference": self.reference}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Set to a saved state."""
        self.reference = tensors.get("reference")


def _generator(trainer: Trainer) -> torch.Generator:
    """Return the source of the random numbers of the trainer's next step."""
    return torch.Generator().manual_seed((trainer.seed << 32) + trainer.step)
