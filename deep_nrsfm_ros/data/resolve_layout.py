# SPDX-License-Identifier: Apache-2.0
"""Choose the keypoint layout of detections that do not name their own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.formats.names import (
    NAMED_BY_INPUT,
    are_mostly_known,
    misspelt,
    unknown_names,
)
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.spelling import match_names
from deep_nrsfm_ros.lifting.layout_fit import (
    LayoutFit,
    ambiguity,
    candidate_layouts,
    choose_layout,
    fit_layouts,
)
from deep_nrsfm_ros.lifting.sanity import POOR_RESIDUAL, Finding, is_person
from deep_nrsfm_ros.model_files.matching_model import model_of_count
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.wording import wording

_SHOWN = 4  # names in a text
_TIE = 0.02  # difference of residuals that chance makes
_LIMBS = 3  # keypoints of a side, without which a person has only one


class ResolvedLayout(NamedTuple):
    """The layout of keypoints of which nothing says it.

    Attributes:
        layout: the layout that fits best.
        reason: why it is taken, in words.
        ambiguity: the finding that another one may be meant; None if it is certain.
    """

    layout: KeypointLayout
    reason: str
    ambiguity: Finding | None = None


def resolve_layout(
    detections: Detections, model: Model, preferred: KeypointLayout | None = None
) -> ResolvedLayout:
    """Return the layout in which the keypoints fit best.

    The preferred layout is taken unless another one fits clearly better. Of several that fit
    equally well, the one that is usual in the input's format is taken.

    Args:
        detections: keypoints of which nothing says the layout.
        model: lifts them.
        preferred: None = the model's own.

    Raises:
        ValueError: no layout of that number of keypoints can be lifted by the model.
    """
    preferred = preferred or model.layout
    fits = fit_layouts(detections.points, detections.confidence, model, [preferred])
    q = detections.confidence.shape[1]
    chosen = choose_layout(fits, preferred)
    if chosen:
        usual = detections.usual_layout if is_person(model.layout) else None
        same = (fit for fit in fits if fit.layout is usual and _is_tie(fit, chosen))
        chosen = next(same, chosen)
        rivals = ambiguity(detections.points, detections.confidence, model, fits, chosen)
        poor = "taken although no layout fits well; " * (chosen.residual >= POOR_RESIDUAL)
        by_format = "usual in files like COCO's, and " * (chosen.layout is usual)
        reason = poor + by_format + _ranking(chosen, fits, model)
        return ResolvedLayout(chosen.layout, reason, rivals)
    for layout in candidate_layouts(q, model, [preferred]):
        return ResolvedLayout(layout, f"{q} keypoints; no object has enough of them to try it")
    if q == len(preferred):
        return ResolvedLayout(preferred, f"the order of {preferred.name}, {q} keypoints")
    other = model_of_count(q)
    options = f"--model {other}; to train --object {other}"
    hint = f", but model {other!r} lifts objects of {q} keypoints ({options})" if other else ""
    raise ValueError(
        f"the objects have {q} keypoints; no layout of {q} keypoints is known that model "
        f"{model.name!r} ({len(model.layout)} keypoints) can lift{hint}: name one with "
        f"{layout_option()}"
    )


def layout_option() -> str:
    """Return the option that names the layout of the detector's keypoints."""
    return wording("--keypoint-layout", node="train.keypoint_layout", python="layout")


class NameCheck(NamedTuple):
    """What is to be said of the names that an input gives its keypoints.

    Attributes:
        findings: what looks wrong.
        warnings: sentences about what may be meant so.
    """

    findings: tuple[Finding, ...] = ()
    warnings: tuple[str, ...] = ()


def check_names(layout: KeypointLayout, target: KeypointLayout, owner: str) -> NameCheck:
    """Return what is to be said of the names that an input gives its keypoints.

    Args:
        layout: of the input.
        target: layout to which the keypoints are mapped.
        owner: what has that layout, for the texts: "model 'human'".

    Raises:
        ValueError: the target has too few keypoints of these names.
    """
    if layout.name != NAMED_BY_INPUT:
        return NameCheck()
    wanted = target.keypoints
    own = {place: name for name, place in match_names(layout.keypoints, wanted).items()}
    names = [own.get(place, name) for place, name in enumerate(layout.keypoints)]
    close = misspelt(names, wanted)
    guesses = ", ".join(f"{name} ({other}?)" for name, other in list(close.items())[:_SHOWN])
    guesses += ", ..." * (len(close) > _SHOWN)
    try:
        mapping = KeypointMap(layout, target)
    except ValueError:
        raise ValueError(
            f"its keypoints are named {_shown(names)}, and those of {owner} "
            f"{_shown(wanted)}: rename them{f', such as {guesses}' if guesses else ''}, or name "
            f"the layout in whose order they are with {layout_option()}"
        ) from None
    filled = mapping.filled
    findings, warnings = list[Finding](), list[str]()
    if close and are_mostly_known(names, wanted):
        findings.append(
            Finding(
                "misspelt",
                f"{len(close)} of {len(names)} names of keypoints are unknown, and {owner} lacks "
                f"those that are nearly the same: {guesses}; correct them",
            )
        )
    unknown = unknown_names(names, wanted)
    for side, other in (("left", "right"), ("right", "left")):
        count = sum(name.startswith(f"{side}_") for name in wanted)
        seen = sum(name.startswith(f"{other}_") for name in filled)
        if count < _LIMBS or seen < _LIMBS or any(name.startswith(f"{side}_") for name in filled):
            continue
        if len(unknown) < _LIMBS:
            warnings.append(
                f"the input names {seen} {other}_ keypoints of {owner} and no {side}_ one: that "
                "side is guessed"
            )
            continue
        findings.append(
            Finding(
                "one-side",
                f"the input names {seen} {other}_ keypoints of {owner} and no {side}_ one, but "
                f"{len(unknown)} unknown ones ({_shown(unknown)}): that side is guessed; rename "
                "those that belong to it",
            )
        )
    if not findings and (unnamed := mapping.unnamed()):
        findings.append(
            Finding(
                "unnamed",
                f"the input names {unnamed.filled} of {owner}, and {unnamed.others}: "
                f"{unnamed.missing} are guessed; rename those that they are",
            )
        )
    return NameCheck(tuple(findings), tuple(warnings))


def _shown(names: Sequence[str]) -> str:
    """Return the first names of a list."""
    return ", ".join(names[:_SHOWN]) + ", ..." * (len(names) > _SHOWN)


def _ranking(chosen: LayoutFit, fits: list[LayoutFit], model: Model) -> str:
    """Return the residual of the chosen layout, and those of the others."""
    own = len(KeypointMap(chosen.layout, model.layout).filled)
    shown = []
    for fit in fits:
        if fit is chosen:
            continue
        fewer = own - len(KeypointMap(fit.layout, model.layout).filled)
        tie = f" with {fewer} keypoints fewer" if fewer > 0 and _is_tie(fit, chosen) else ""
        shown.append(f"{fit.layout.name} {fit.residual:.2f}{tie}")
    others = ", ".join(shown)
    text = f"it fits with residual {chosen.residual:.2f}"
    return f"{text} ({others})" if others else f"{text}; no other layout has that size"


def _is_tie(fit: LayoutFit, chosen: LayoutFit) -> bool:
    """Return whether a layout fits nearly as well as the chosen one."""
    return fit.residual < chosen.residual + _TIE
