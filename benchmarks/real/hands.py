# SPDX-License-Identifier: Apache-2.0
"""A model of hands from 2D detections and virtual hands; errors on another person's labelled hand.

    python -m benchmarks.real.hands --data DIR           train on Apache and MIT data
    python -m benchmarks.real.hands --data DIR --model hand21      only print
    python -m benchmarks.real.hands --data DIR --collections signs sila kinivi signers
    python -m benchmarks.real.hands --data DIR --virtual-hands 0   from 2D detections alone
    python -m benchmarks.real.hands --data DIR --network-of hand21   learn the last step alone

The network learns from detected hands, and from virtual ones in random views
(`deep_nrsfm_ros.data.virtual_hands`). The last step learns error covariance and bones from other
virtual hands and a third as many detected ones.

Left and right hands are mixed in the collections. `deep_nrsfm_ros.data.hands` sorts them by place,
by the detector's handedness, or as palms, and mirrors the left ones.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.table import Table, bars, print_tables
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.hands import mirrored, palms_as_right_hands, right_hands
from deep_nrsfm_ros.data.virtual_hands import FINGERS, virtual_hands
from deep_nrsfm_ros.layouts.presets import preset
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter, lift_all
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, load_model, save_model
from deep_nrsfm_ros.nrsfm.geometry import align, centre
from deep_nrsfm_ros.nrsfm.metrics import camera_errors
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, LayoutLossWeights

Float32 = NDArray[np.float32]

FREE = ("kinivi", "signers")
"""Collections whose licences allow to share a model: Apache-2.0, MIT."""
COLLECTIONS = ("kinivi", "signers", "signs", "sila")
COLUMNS = {
    "PA mm": "mean distance of 12 points after the best similarity transform",
    "camera mm": "the same without a rotation",
    "rotation deg": "median error of the orientation in the camera's axes",
    "mirrored %": "frames that a reflection would fit better",
}
_LEGEND = COLUMNS | {
    "labels": "a depth camera's hand labels of a person who is in no training; wrist, thumb and "
    "the tips and middle joints of four fingers, defined a little otherwise than MediaPipe's",
    "rigid": "the mean of the labelled shapes, turned to fit each frame: of the labels themselves",
}
_HIDDEN_HANDS = 200
_HIDDEN = "hidden keypoint %"
_HIDDEN_LEGEND = {
    _HIDDEN: f"each keypoint of {_HIDDEN_HANDS} hands is hidden in turn: mean distance in the "
    "image between its lifted and its detected place, in % of the hand's RMS radius",
}
_MIN_CONFIDENCE = 0.3  # of each keypoint of a hand that is learned from
_DETECTED = 1 / 3  # detected hands for each virtual one in the last step
_SILA_ASPECT = 4 / 3  # width over height of a webcam's image, by which x is normalised


class Labelled(NamedTuple):
    """Detections of one hand in the layout hand21, with labels.

    Attributes:
        points: (f, 21, 2) pixels.
        confidence: (f, 21) 1 where the detector has the joint, else 0.
        truth: (f, 21, 3) mm in the camera's axes, NaN without a label.
        intrinsics: of the camera.
    """

    points: Float32
    confidence: Float32
    truth: NDArray[np.float64]
    intrinsics: Intrinsics


def collection(folder: Path, name: str) -> Float32:
    """Return a collection as right hands (f, 21, 2), as `_of_one_size` returns them.

    Raises:
        ValueError: there is no such collection.
    """
    if name == "signers":
        hands = _signers(folder / "signers")
    elif name in COLLECTIONS:
        points = np.load(folder / f"hands_{name}" / f"hands_{name}.npz")["points"]
        if name == "signs":
            hands = right_hands(points, mirrored_image=True)
        else:
            aspect = _SILA_ASPECT if name == "sila" else 1.0
            hands = palms_as_right_hands(points * np.array([aspect, 1], np.float32))
    else:
        raise ValueError(f"no collection {name!r}; there are {', '.join(COLLECTIONS)}")
    return _of_one_size(hands)


def _of_one_size(hands: Float32) -> Float32:
    """Return hands (f, 21, 2) centred and of one size, without those that are incomplete."""
    hands = centre(hands)
    size = np.linalg.norm(hands, axis=(1, 2))
    known = np.isfinite(size) & (size > 0)
    scaled: Float32 = (100 * hands[known] / size[known, None, None]).astype(np.float32)
    return scaled


def _signers(folder: Path) -> Float32:
    """Return the complete hands of the signers; the detector says which are left and right."""
    found = []
    for path in sorted(folder.glob("*.npz")):
        recording = np.load(path)
        for side in ("left", "right"):
            points = recording[f"hand_{side}"]
            confident = recording[f"hand_{side}_confidence"] > _MIN_CONFIDENCE
            points = points[confident.all(1) & np.isfinite(points).all((1, 2))]
            found.append(mirrored(points) if side == "left" else points)
    return np.concatenate(found)


def labelled(folder: Path) -> Labelled:
    """Return the labelled recording, its 14 joints named as in hand21; the palm has no name."""
    recording = np.load(folder / "hand_nyu" / "hand_nyu_dev.npz")
    names = recording["joint_names"].tolist()
    sources = {"wrist": ("palm_1", "palm_2"), "thumb_tip": ("thumb_tip",)}
    sources |= {"thumb_ip": ("thumb_mid",), "thumb_mcp": ("thumb_root",)}
    sources |= {f"{finger}_tip": (f"{finger}_tip",) for finger in FINGERS}
    sources |= {f"{finger}_pip": (f"{finger}_mid",) for finger in FINGERS}
    layout, n = preset("hand21"), len(recording["points"])
    points, confidence = np.zeros((n, 21, 2), np.float32), np.zeros((n, 21), np.float32)
    truth = np.full((n, 21, 3), np.nan)
    for name, parts in sources.items():
        i, joints = layout.index(name), [names.index(part) for part in parts]
        points[:, i] = recording["points"][:, 0, 0, joints].mean(1)
        truth[:, i] = recording["truth"][:, 0, joints].mean(1)
        confidence[:, i] = 1
    K = recording["K"][0]
    intrinsics = Intrinsics((K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]))
    return Labelled(points, confidence, truth, intrinsics)


def errors(model: Model, hand: Labelled, *, intrinsics: bool) -> dict[str, float]:
    """Return the `COLUMNS` of a model on a labelled hand, lifted frame by frame."""
    lifter = Lifter(model)

    def lift(points: Float32, confidence: Float32) -> Lifted:
        if intrinsics:
            return lift_perspective(lifter, hand.intrinsics, points, confidence)
        return lifter.lift(points, confidence)

    return _figures(lift_all(lift, hand.points, hand.confidence).shapes, hand)


def _figures(shapes: NDArray[Any], hand: Labelled) -> dict[str, float]:
    """Return the `COLUMNS` of shapes (f, 21, 3), over the keypoints that have labels."""
    joints = np.isfinite(hand.truth).all((0, 2))
    found = camera_errors(shapes[:, joints], hand.truth[:, joints])
    values = (found.aligned, found.in_camera, found.rotation, 100 * found.mirrored)
    return dict(zip(COLUMNS, values, strict=True))


def rigid_errors(hand: Labelled) -> dict[str, float]:
    """Return the errors of the mean labelled shape in the orientation that fits each frame best."""
    known = np.asarray(np.isfinite(hand.truth).all(2), bool)
    truth = centre(np.where(known[..., None], hand.truth, 0.0)[:, known.all(0)])
    mean = align(truth, np.broadcast_to(truth[0], truth.shape)).aligned.mean(0)
    turned = align(np.broadcast_to(mean, truth.shape), truth).aligned
    shapes = np.full(hand.truth.shape, np.nan)
    shapes[:, known.all(0)] = turned
    return _figures(shapes, hand)


def hidden_keypoint_error(model: Model, hands: Float32) -> float:
    """Return the mean error in the image of keypoints that are hidden in turn; needs no label.

    Args:
        model: of hands.
        hands: (n, 21, 2) complete detections, in any unit.

    Returns:
        Percent of the RMS radius of the hand; 5 to 10 typical.
    """
    keypoints = len(model.layout)
    chosen = hands[np.linspace(0, len(hands) - 1, min(_HIDDEN_HANDS, len(hands))).astype(int)]
    points = np.repeat(chosen, keypoints, 0)
    at = np.arange(len(points)), np.tile(np.arange(keypoints), len(chosen))
    confidence = np.ones(points.shape[:2], np.float32)
    confidence[at] = 0
    lifted = lift_all(Lifter(model).lift, points, confidence)
    found = lifted.scale[:, None] * lifted.shapes[at][:, :2] + lifted.translation
    radius = np.sqrt(np.square(centre(points)).sum(2).mean(1))
    return float(100 * (np.linalg.norm(found - points[at], axis=1) / radius).mean())


class Options(NamedTuple):
    """How a model of hands is trained.

    Attributes:
        steps: of the training.
        seed: of the training and of the virtual hands.
        handedness_weight: of the loss of the layout's front; 0: off.
        virtual_hands: number of virtual hands that the network learns from, and of others that the
            last step learns from; 0: both learn from detected hands alone.
        network_of: name or file of a model whose network is kept, so that only the last step is
            learned; "": a network is trained.
    """

    steps: int = 4000
    seed: int = 0
    handedness_weight: float = 1.0
    virtual_hands: int = 10000
    network_of: str = ""


def train(folder: Path, collections: Sequence[str], options: Options) -> tuple[Model, float]:
    """Return a model of right hands of some collections, and the seconds that it took."""
    from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
    from deep_nrsfm_ros.training.finish import finish
    from deep_nrsfm_ros.training.loop import train as run
    from deep_nrsfm_ros.training.setup import Setup

    began = time.process_time()
    detected = np.concatenate([collection(folder, name) for name in collections])
    points, source = detected, f"hands detected by MediaPipe and OpenPose: {', '.join(collections)}"
    last_step_hands = None
    if options.virtual_hands:
        virtual = virtual_hands(options.virtual_hands, options.seed)
        points = np.concatenate((detected, _of_one_size(virtual.points)))
        source += f"; {len(virtual)} {virtual.source}"
        last_step_hands = _last_step_hands(detected, options)
    # The loss of the front leaves no seed mirrored, so one is enough.
    recipe = dataclasses.replace(
        PRESETS["default"].recipe, steps=options.steps, seed=options.seed, seeds=1
    )
    weights = LayoutLossWeights(0.0, options.handedness_weight)
    loss = LayoutLoss(weights, preset("hand21")) if options.handedness_weight else None
    start = _model(options.network_of) if options.network_of else None
    if start:
        recipe = dataclasses.replace(recipe, steps=0)
    trainer = run(
        points,
        np.ones(points.shape[:2], bool),
        PRESETS["default"]._replace(recipe=recipe),
        Setup(start=start.network if start else None, layout_loss=loss),
    )
    model = finish(trainer, "hand21", preset("hand21"), source, last_step_hands)
    if start:
        last_step = {"last_step": model.provenance.get("last_step")}
        model = dataclasses.replace(model, provenance=start.provenance | last_step)
    return model, time.process_time() - began


def _last_step_hands(detected: Float32, options: Options) -> Dataset:
    """Return virtual hands that the network has not learned from, and some of the detected ones."""
    virtual = virtual_hands(options.virtual_hands, options.seed + 1)
    order = np.random.default_rng(options.seed).permutation(len(detected))
    chosen = detected[order[: int(_DETECTED * len(virtual))]]
    points = np.concatenate((virtual.points, chosen))
    source = f"{len(virtual)} {virtual.source}, {len(chosen)} detected hands"
    return Dataset(points, np.ones(points.shape[:2], bool), virtual.layout, source)


def _model(name: str) -> Model:
    """Return the model of a name or a file."""
    return load_model(Path(name) if name.endswith(MODEL_SUFFIX) else name)


def benchmark(models: Sequence[tuple[str, float, Model]], hand: Labelled) -> Table:
    """Return the table of (label, minutes, model)."""
    table = Table(
        "hands",
        "Hands: another person's labelled hand",
        ("model", "lifted"),
        ("CPU minutes", *COLUMNS),
        _LEGEND,
        bars("PA mm", "rotation deg"),
    )
    for label, minutes, model in models:
        for intrinsics in (False, True):
            how = "with intrinsics" if intrinsics else "without intrinsics"
            figures = errors(model, hand, intrinsics=intrinsics)
            table.add((label, how), {"CPU minutes": minutes, **figures} if minutes else figures)
    table.add(("rigid", "-"), rigid_errors(hand))
    return table


def without_labels(label: str, model: Model, others: dict[str, Float32]) -> Table:
    """Return the table of a model on collections (name -> hands) that it has not learned from."""
    table = Table(
        "hidden_hand_keypoints",
        "Hands of other collections, no labels",
        ("model", "collection"),
        (_HIDDEN,),
        _HIDDEN_LEGEND,
        bars(_HIDDEN),
    )
    for name, hands in others.items():
        table.add((label, name), {_HIDDEN: hidden_keypoint_error(model, hands)})
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Train or load a model and print its errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the scenes")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks"))
    parser.add_argument("--collections", nargs="+", default=list(FREE), choices=COLLECTIONS)
    parser.add_argument("--model", help="name or file of a model, instead of a training")
    parser.add_argument("--steps", type=int, default=Options().steps)
    parser.add_argument("--seed", type=int, default=Options().seed)
    parser.add_argument(
        "--handedness-weight",
        type=float,
        default=Options().handedness_weight,
        help="of the layout's front; 0: off",
    )
    parser.add_argument(
        "--virtual-hands",
        type=int,
        default=Options().virtual_hands,
        help="virtual hands to learn from, beside the detected ones; 0: none",
    )
    parser.add_argument(
        "--network-of", default="", help="keep the network of this model; learn the last step anew"
    )
    args = parser.parse_args(argv)

    def tables() -> list[Table]:
        if args.model:
            row = (args.model, 0.0, _model(args.model))
        else:
            options = Options(*(getattr(args, name) for name in Options._fields))
            model, seconds = train(args.data, args.collections, options)
            save_model(args.output / f"hand21{MODEL_SUFFIX}", model)
            row = (", ".join(args.collections), seconds / 60, model)
        others = {
            name: collection(args.data, name)
            for name in COLLECTIONS
            if name not in (*FREE, *args.collections) and (args.data / f"hands_{name}").exists()
        }
        found = [benchmark([row], labelled(args.data))]
        return [*found, without_labels(row[0], row[2], others)] if others else found

    print_tables(tables, args.output)


if __name__ == "__main__":
    main()
