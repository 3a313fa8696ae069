# SPDX-License-Identifier: Apache-2.0
"""Keypoint layouts ranked by how well a model explains keypoints in their order.

Layouts of the same number of keypoints cannot be told apart by a count: human17 and coco17 both
have 17. In the wrong order the keypoints are no projection of a shape of the model, so the
reprojection error of a few objects shows the right one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.lifting.lifter import Lifter, lift_all
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.sanity import POOR_RESIDUAL, Finding, find_sentinel
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.wording import wording

MAX_OBJECTS = 200
"""Objects of a sample: they take 2 to 10 ms a layout."""

_CLEAR_RATIO = 0.6  # a residual below this fraction of another is clearly better
_PART_RATIO = 0.85  # of the residual with all keypoints, below which some of them are not meant
_MIN_MAPPED = 10  # keypoints of the model, or half of them; fewer fit any shape in any order
_FAST_OPTIONS = LiftingOptions(correction="none", test_time_rotations=1, refill=0)


class LayoutFit(NamedTuple):
    """How well a model explains keypoints in the order of a layout.

    Attributes:
        layout: the layout.
        residual: median reprojection error; 0 = perfect, below 0.1 typical, above 0.3 poor.
    """

    layout: KeypointLayout
    residual: float


def fit_layouts(
    points: NDArray[np.float32],
    confidence: NDArray[np.float32],
    model: Model,
    layouts: Iterable[KeypointLayout] = (),
) -> list[LayoutFit]:
    """Return the layouts of q keypoints that the model can lift, the best fit first.

    Args:
        points: (n, q, 2) in pixels; at most `MAX_OBJECTS` of them, evenly spaced, are lifted.
        confidence: (n, q); 0 where missing.
        model: lifts them.
        layouts: tried besides the presets and the model's own.

    Returns:
        Layouts that map to 10 or half of the model's keypoints, and with which an object can
        be lifted. Layouts that fit equally well are in the order of `layouts`,
        the model's own, the presets. A layout that is another one without some of its keypoints
        comes after it unless it fits better by 15 %: fewer keypoints always fit a little better.
    """
    chosen = sample_objects(confidence)
    points, confidence = points[chosen], confidence[chosen]
    if sentinel := find_sentinel(points, confidence > 0):
        confidence = np.where((points == sentinel[0]).all(-1), np.float32(0), confidence)
    lifter = Lifter(model, _FAST_OPTIONS)
    fits = []
    for layout in candidate_layouts(confidence.shape[1], model, layouts):
        mapped = KeypointMap(layout, model.layout)(points, confidence)
        residual = lift_all(lifter.lift, *mapped).residual
        if not np.isnan(residual).all():
            fits.append(LayoutFit(layout, float(np.nanmedian(residual))))
    visible = np.ones(confidence.shape[1], bool)
    sources = [_sources(fit.layout, model, visible) for fit in fits]
    ranks = [
        fit.residual / (_PART_RATIO if any(_is_part(own, other) for other in sources) else 1)
        for fit, own in zip(fits, sources, strict=True)
    ]
    return [fits[i] for i in np.argsort(ranks, kind="stable")]


def _is_part(own: NDArray[np.float32], other: NDArray[np.float32]) -> bool:
    """Return whether a layout gives the model some of what another one gives, and no more.

    Args:
        own: (p, 2) `_sources` of the layout.
        other: (p, 2) those of the other one.
    """
    taken = own[:, 0] > 0
    return bool((own[taken] == other[taken]).all() and (other[~taken, 0] > 0).any())


def candidate_layouts(
    q: int, model: Model, layouts: Iterable[KeypointLayout] = ()
) -> Iterator[KeypointLayout]:
    """Yield the different layouts of q keypoints that map to enough of the model's.

    Args:
        q: keypoints of an object.
        model: lifts them.
        layouts: come first; the model's own and the presets follow.
    """
    seen: set[tuple[str, ...]] = set()
    for layout in (*layouts, model.layout, *LAYOUTS.values()):
        if len(layout) != q or layout.keypoints in seen:
            continue
        seen.add(layout.keypoints)
        try:
            mapping = KeypointMap(layout, model.layout)
        except ValueError:  # it shares too few keypoints with the model
            continue
        ones = np.ones((1, q), np.float32)
        _, mapped = mapping(np.ones((1, q, 2), np.float32), ones)
        if (mapped > 0).sum() >= min(_MIN_MAPPED, len(model.layout) / 2):
            yield layout


def choose_layout(fits: list[LayoutFit], preferred: KeypointLayout) -> LayoutFit | None:
    """Return the fit of the preferred layout, or of the best one if it is clearly better.

    Args:
        fits: as `fit_layouts` returns them.
        preferred: taken if it is among the fits and none is clearly better.

    Returns:
        None if there is no fit.
    """
    if not fits:
        return None
    best = fits[0]
    current = next((fit for fit in fits if fit.layout.keypoints == preferred.keypoints), None)
    return best if current is None or is_clearly_better(best, current.residual) else current


def ambiguity(
    points: NDArray[np.float32],
    confidence: NDArray[np.float32],
    model: Model,
    fits: list[LayoutFit],
    chosen: LayoutFit,
) -> Finding | None:
    """Return the finding that another layout may be meant as well as the chosen one.

    Another one may be meant if the chosen one does not fit clearly better, or if too few keypoints
    are visible to try it. A layout that gives the model the same keypoints, or some of them, is no
    other one: posetrack18_17 is coco17 without the eyes.

    Args:
        points: as in `fit_layouts`.
        confidence: as in `fit_layouts`.
        model: as in `fit_layouts`.
        fits: as `fit_layouts` returns them.
        chosen: one of them.
    """
    visible = np.asarray((confidence > 0).any(0))
    own = _sources(chosen.layout, model, visible)
    residuals = {fit.layout.keypoints: fit.residual for fit in fits}
    rivals = []
    for layout in candidate_layouts(confidence.shape[1], model, [fit.layout for fit in fits]):
        sources = _sources(layout, model, visible)
        taken = sources[:, 0] > 0
        if (sources[taken] == own[taken]).all():
            continue
        residual = residuals.get(layout.keypoints)
        if residual is None:
            rivals.append(f"{layout.name} (too few visible keypoints to try it)")
        elif not chosen.residual < _CLEAR_RATIO * residual:
            rivals.append(f"{layout.name} ({residual:.2f})")
    if not rivals:
        return None
    return Finding(
        "ambiguous-layout",
        f"the keypoint layout is ambiguous: {chosen.layout.name} is taken, which fits "
        f"{chosen.residual:.2f}, but {' or '.join(rivals)} may be meant: name the keypoint layout",
    )


def _sources(
    layout: KeypointLayout, model: Model, visible: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return from which visible keypoint of a layout each keypoint of the model is taken, (p, 2).

    Its number from 1 and the square of that, which tell pairs of the same middle apart: a keypoint
    between two others has their means. 0 where it is missing.
    """
    numbers = np.arange(1, len(layout) + 1, dtype=np.float32)
    pairs = np.stack([numbers, numbers**2], -1)[None]
    mapped, confidence = KeypointMap(layout, model.layout)(pairs, visible[None].astype(np.float32))
    return np.where(confidence[0, :, None] > 0, mapped[0], np.float32(0))


def better_layout(
    fits: list[LayoutFit], current: KeypointLayout, residual: float
) -> Finding | None:
    """Return the finding that another layout fits clearly better than the current one.

    Args:
        fits: as `fit_layouts` returns them.
        current: layout with which the objects were lifted.
        residual: their median residual.
    """
    if not fits:
        return None
    best = fits[0]
    if best.layout.keypoints == current.keypoints or not is_clearly_better(best, residual):
        return None
    name = best.layout.name
    remedy = wording(f"set the keypoint layout to {name}", python=f"give layout={name!r}")
    if name not in LAYOUTS:  # that of the model
        remedy = wording(
            "set the keypoint layout to that of the model (-p keypoint_layout:=model, or no "
            "--keypoint-layout)",
            python="leave layout out",
        )
    return Finding(
        "layout",
        f"poor fit as {current.name}: is it {name}? It fits {best.residual:.2f} instead of "
        f"{residual:.2f}; {remedy}",
    )


def is_clearly_better(fit: LayoutFit, residual: float) -> bool:
    """Return whether a fit is sound and clearly better than another residual."""
    return fit.residual < POOR_RESIDUAL and fit.residual < _CLEAR_RATIO * residual


def sample_objects(confidence: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the indices of at most `MAX_OBJECTS` objects, evenly spaced, with many keypoints.

    Args:
        confidence: (n, q); 0 where missing.
    """
    visible = (confidence > 0).sum(1)
    full = np.flatnonzero(visible >= np.median(visible)) if len(visible) else np.arange(0)
    if len(full) <= MAX_OBJECTS:
        return full
    return np.asarray(full[np.linspace(0, len(full) - 1, MAX_OBJECTS).astype(int)], np.int64)
