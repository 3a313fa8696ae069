# SPDX-License-Identifier: Apache-2.0
"""Whether a new model is better than the one at hand, judged without labels.

Both models lift the same frames, which the training has not used (`data.held_out`). Errors of 2D
alone say little: a model that has folded its frames reprojects well, but lengths of bones vary in
its shapes. So a new model is better if its misfit, of keypoints and bones together, is less, and if
nothing says that it mirrors more frames than the one at hand. Otherwise it is doubtful.
`benchmarks/real/judge.py` compares figures and rule with true errors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.dataset import Dataset, concatenate
from deep_nrsfm_ros.data.hands import MIXED, mixed_sides
from deep_nrsfm_ros.data.held_out import MIN_HELD_OUT, Split
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout, Tetrahedron
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.layouts.spelling import match_names
from deep_nrsfm_ros.lifting.lifter import Lifter, lift_all
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.sanity import Finding
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.geometry import align, centre_visible
from deep_nrsfm_ros.nrsfm.handedness import MIN_VISIBLE_SHARE, votes
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.training.data_check import SourceFinding, sentences, serious
from deep_nrsfm_ros.training.fine_tuning import RARELY_SHOWN
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.learned_frames import learned_by
from deep_nrsfm_ros.training.mirror import MIN_TESTED, MirrorCheck
from deep_nrsfm_ros.training.steps import FROM_RANDOM
from deep_nrsfm_ros.training.verdicts import ALONE, AS_GOOD, BETTER, DOUBTFUL, UNKNOWN
from deep_nrsfm_ros.wording import wording

Floats = NDArray[Any]

_Lifted = tuple[Floats, Floats, NDArray[np.bool_]]

_MOST_FRAMES = 2000
_SHARE_OF_SPEAKERS = 0.8  # with it whole people are lifted as by the start; see docs/devlog
_MOST_NAMES = 3  # keypoints that a sentence lists
_NETWORK_ALONE = LiftingOptions(correction="none", test_time_rotations=1)
_WITH_CORRECTION = LiftingOptions()


class Figures(NamedTuple):
    """Figures of a model that need no labels; less is better. NaN: unknown.

    Attributes:
        image_error: of the network alone, without test-time rotations and correction: distance of
            its keypoints from the detected ones, relative to the size of the object; median over
            the held-out frames.
        bone_variation: mean absolute deviation of a bone's length from its median over the held-out
            frames, mean over the bones. A length is relative to the bone's median and to the
            median of its frame's bones; 0.04 typical of people.
        mirrored_share: share of all frames with mirrored depth, by the test of their neighbours.
        front_disagreement: share of all frames whose votes on the front say that it is behind.
        opposed: share of all frames of which the model compared with has the mirror image.
        side_difference: difference of the lengths of left and right bones, relative to their
            mean; mean over bones and held-out frames.
        flatness: share of the size of a held-out shape that lies within the image plane, 0 to 1.
        difference: distance from the shapes of the model compared with, relative to their size.
        turned: share of all frames whose mirror image it has, lifted with the correction, where it
            was trained on from the model compared with. NaN for other models.
        learned_image_error: `image_error` over the frames of the training; NaN where none are held
            out.
    """

    image_error: float
    bone_variation: float
    mirrored_share: float
    front_disagreement: float
    opposed: float
    side_difference: float
    flatness: float
    difference: float
    turned: float = math.nan
    learned_image_error: float = math.nan

    @property
    def misfit(self) -> float:
        """Return the root of the summed squares of `image_error` and `bone_variation`.

        Both are relative to the size of the object. Bones count where they are known.
        """
        return math.hypot(self.image_error, _or_zero(self.bone_variation))

    @property
    def wrong_sides(self) -> float:
        """Return the share of frames that are known to be mirrored or turned; 0 if none is."""
        return max(_or_zero(self.mirrored_share), _or_zero(self.front_disagreement))


IN_WORDS = {
    "misfit": "its misfit, image error and bones together, is {} of the size of the object",
    "mirrored_share": "{} of its frames are mirrored against their neighbours",
    "front_disagreement": "in {} of the frames its front is behind",
    "opposed": "it lifts {} of the frames to the mirror image of the other's",
    "turned": "it turns {} of the frames to the mirror image of what its start makes of them",
    "bone_variation": "its bone lengths vary by {}",
}
"""The figures by which the rule decides, in words."""

_BESIDE = ("opposed", "turned")  # figures that need a model beside it
_SHOWN = {
    "image_error": "image error of the network before the correction {} of the size of the object",
    "bone_variation": "bone lengths vary by {}",
    "misfit": "misfit, the root of their summed squares, {}",
    "wrong_sides": "frames that look mirrored {}",
}
MIN_SEEN_SHARE = 0.25
"""Share of an object's keypoints that a frame must show to tell its side: of 4 of 25 keypoints the
mirror image is as good, and the network's prior alone decides."""

MORE_WRONG_SIDES = 0.005
"""Share of mirrored or turned frames by which a model must differ from another to be worse.

A model that was trained on has the depth of its start, so that no frame of it should be turned.
"""
MOST_OPPOSED = 0.05
"""Share of frames with the other's mirror image above which one of both mirrors them."""
STEADIER_BONES = 0.5
"""Of the other's variation of bones, up to which a model is the one that does not mirror them."""
SAME_MISFIT = 1.02
"""Times the other's misfit up to which both fit the held-out frames alike.

The new model is then better: the frames that it has learned, it fits more closely.
"""
MOST_FOLDED = 0.9
"""Share of opposed frames up to which one of both models may be folded, which mirrors some frames.

Above it one of both is the mirror image of the other as a whole. Only the front that the layout
names tells which: not steady bones, and not neighbours, which are mirrored as well. And a model
that was trained on from the other has not turned it by learning.
"""
MOST_BEHIND = 0.5
"""Share of frames whose front is behind, above which a model is mirrored as a whole."""
LOOSER_BONES = 2.5
"""Times the other's variation of bones above which a model has fitted its keypoints too closely.

These limits are chosen on the people of `benchmarks/real/judge.py`; the table there says how well
they do.
"""

MOST_IMAGE_ERROR = 0.5
"""Image error above which a model does not fit the frames: doubtful beside any other."""
MOST_MIRRORED = 0.05
"""Share of mirrored frames above which a model is doubtful where there is none to compare with."""


LARGE_IMAGE_ERROR = 0.25
"""Image error on new frames above which a model without another one is said to fit badly.

Each model of `benchmarks/real/judge.py` with more is a tenth or more worse than the best one of its
scene. A good model of a mouse has 0.19.
"""
LARGE_LEARNED_IMAGE_ERROR = 0.2
"""The same on the frames of its training, where none are held out."""
MISFIT_OF_LEARNED = 2.5
"""Times the misfit of a model that was trained on the held-out frames: a new one of more is worse.

A model fits the frames of its training up to 2.3 times as well as others like them (a mouse: 6.7
and 15 %), so that less says nothing.
"""

FEW_STEPS = 2000
"""Steps from random weights below which more steps help."""
LEARNED_IMAGE_ERROR = 0.05
"""Image error above which a model of few steps is a first look, which is too poor for use."""


class Comparable(NamedTuple):
    """The frames on which a new model is compared with the one at hand.

    Attributes:
        frames: of the training, and those held out that count.
        left_out: number of held-out frames that do not, since the other was trained on them.
        has_advantage: whether the other was trained on those that count, as too few others are
            there.
    """

    frames: Split
    left_out: int = 0
    has_advantage: bool = False


def comparable(frames: Split, rival: Model | None) -> Comparable:
    """Return the frames on which a new model is compared with the one at hand.

    Args:
        frames: those that the new model was trained on, and those held out. Where nothing is held
            out, both models may have learned all of them.
        rival: the one at hand; None: there is none.
    """
    if rival is None or frames.held_out is frames.training:
        return Comparable(frames)
    learned = learned_by(rival, frames.held_out)
    others = np.flatnonzero(~learned)
    if not learned.any():
        return Comparable(frames)
    if len(others) < MIN_HELD_OUT:
        return Comparable(frames, has_advantage=True)
    return Comparable(Split(frames.training, frames.held_out[others]), int(learned.sum()))


class Rank(NamedTuple):
    """What orders models on the same frames; the least is the best.

    Attributes:
        doubtful: whether the rule doubts the model.
        at_hand: whether it is the model at hand, which comes after all that are better, or one that
            cannot be compared with it.
        score: sum of its misfit, and the shares of frames that are turned or opposed. Few opposed
            frames say nothing: which of both models is right is unknown.
    """

    doubtful: bool
    at_hand: bool
    score: float


class Judgement(NamedTuple):
    """What the judge says of a new model.

    Attributes:
        reason: one sentence on why it should not replace the one at hand, and what would help; ""
            if it should.
        summary: a sentence that calls the model better, with the figures of both.
        figures: of the new model.
        rival: name of the model at hand; "" where there is none with its keypoints.
        rival_figures: its figures.
        verdict: BETTER, AS_GOOD, ALONE, UNKNOWN or DOUBTFUL.
        faults: of its data, a sentence each: a model learns what is wrong in its data, and the
            figures on such data do not show it.
        shown: a sentence with a few figures of both; reason or summary ends with it.
        brief_reason: the reason, without the remedies of faults in the data; "": there are none.
        repeated: the end of the summary that is the layout's warning.
        is_first_look: whether it has learned too little for use, in few steps from random weights,
            and the verdict is ALONE.
        fits_badly: whether it fits new frames badly, and the verdict is ALONE.
        has_rival_learned: whether the model at hand was trained on the frames of the figures.
    """

    reason: str
    summary: str
    figures: Figures
    rival: str = ""
    rival_figures: Figures | None = None
    verdict: str = DOUBTFUL
    faults: tuple[str, ...] = ()
    shown: str = ""
    brief_reason: str = ""
    repeated: str = ""
    is_first_look: bool = False
    fits_badly: bool = False
    has_rival_learned: bool = False

    @property
    def doubtful(self) -> bool:
        """Return whether the new model should not replace the one at hand."""
        return bool(self.reason)

    def __str__(self) -> str:
        """Return the judgement as a sentence."""
        return f"the new model is doubtful: {self.reason}" if self.doubtful else self.summary

    @property
    def brief(self) -> str:
        """Return the judgement as a sentence, for those who have read the warnings."""
        if self.doubtful:
            return str(self._replace(reason=self.brief_reason or self.reason))
        return self.summary.removesuffix(self.repeated)

    def record(self) -> dict[str, Any]:
        """Return the judgement for the provenance of the new model."""
        result: dict[str, Any] = {"doubtful": self.doubtful, "reason": str(self)}
        result["verdict"] = DOUBTFUL if self.doubtful else self.verdict
        result["figures"] = _rounded(self.figures)
        if self.rival_figures:
            result |= {"rival": self.rival, "rival_figures": _rounded(self.rival_figures)}
        if self.is_first_look:
            result["first_look"] = True
        if self.fits_badly:
            result["fits_badly"] = True
        if self.has_rival_learned:
            result["rival_has_learned_the_frames"] = True
        if self.faults:
            result["faults"] = list(self.faults)
        return result


def judge(
    frames: Split, model: Model, rival: Model | None, findings: Sequence[SourceFinding] = ()
) -> Judgement:
    """Return whether a new model should replace the one at hand; without labels.

    Args:
        frames: as in `compare`.
        model: as in `compare`.
        rival: as in `compare`.
        findings: what looks wrong in the data. For serious ones the model is doubtful whatever its
            figures: more frames, or other options, would not help.
    """
    judgement = compare(frames, model, rival)
    found = serious(findings)
    if sides := mixed_sides(frames.training, MIXED):
        found.append(SourceFinding("", Finding("mixed-hands", sides)))
    if not found:
        return judgement
    faults, figures = sentences(found), f". {judgement.shown}" if judgement.shown else ""
    reason = f"its data looks wrong: {'; '.join(faults)}. Mend it and train again{figures}"
    symptoms = "; ".join(sentences(found, is_brief=True))
    brief = f"its data looks wrong: {symptoms}. Mend it as the warnings say, and train again"
    return judgement._replace(
        reason=reason, verdict=DOUBTFUL, faults=tuple(faults), brief_reason=brief + figures
    )


def compare(frames: Split, model: Model, rival: Model | None) -> Judgement:
    """Return whether a new model is better than the one at hand, by their figures.

    Args:
        frames: those that the model was trained on, and those held out.
        model: the new one.
        rival: the one at hand; None, or one that lifts none of the frames: the new model is judged
            by its mirrored frames alone.
    """
    basis = comparable(frames, rival)
    frames, comparison = basis.frames, Judge(basis.frames)
    old = None
    if rival is not None:
        with suppress(ValueError):
            old = comparison.figures(rival)
    has_advantage = basis.has_advantage and old is not None
    try:
        new = comparison.figures(model, rival if old else None)
    except ValueError as error:  # no training is lost because its model is poor
        unknown = Figures(*[math.nan] * len(Figures._fields))
        return Judgement(f"{error}; {_advice(model, '')} would help", "", unknown)
    name = rival.name if rival is not None and old else ""
    verdict = _verdict(new, old, has_advantage=has_advantage)
    figures, repeated = f"{_on(basis, name)}: {_shown(new, old, name)}", ""
    figures += _guessed(model)
    if old is None and not model.layout.handedness:
        figures += f". These figures say nothing of depth: {_mirrored_as_a_whole(model.name)}"
    elif old is None and model.layout.warning:
        repeated = f". But {model.layout.warning}"
        figures += repeated
    beside = f" beside model {name!r}" if name else ""
    reason, shown = "", f"Judged{beside} {figures}"
    if worse := worse_figures(new, old, has_advantage=has_advantage):
        reason = "; ".join(_in_words(each, new, old, name) for each in worse)
        if old is None and worse == ["front_disagreement"]:
            reason += _fronts_in_words(comparison.fronts(model), model)
        else:
            reason += f"; {_advice(model, name)} would help"
            if rival and worse == ["misfit"] and (files := _same_sources(frames.training, rival)):
                reason += (
                    f". But model {name!r} was trained on {files}: if it has learned other frames "
                    "of these seconds, it is at an advantage"
                )
    if reason:
        verdict, reason = DOUBTFUL, f"{reason}. {shown}"
    in_sentence = _IN_SENTENCES[verdict].format(name, *_gains(new, old))
    is_held_out = frames.held_out is not frames.training
    most = LARGE_IMAGE_ERROR if is_held_out else LARGE_LEARNED_IMAGE_ERROR
    fits_badly = verdict == ALONE and new.image_error > most
    is_poor = new.image_error > LEARNED_IMAGE_ERROR
    is_first_look = _has_few_steps(model) and is_poor and verdict == ALONE
    if is_first_look:
        in_sentence = (
            f"is a first look, and has no other to compare with: {model.provenance['step']} steps "
            f"from random weights leave an image error of {percent(new.image_error)}; "
            f"{FROM_RANDOM} steps are usual"
        )
    elif fits_badly:
        kind = "new frames" if is_held_out else "the frames of its training"
        in_sentence = (
            f"has no other to compare with, and fits {kind} badly: an image error of "
            f"{percent(new.image_error)}, where above {percent(most)} is much; "
            f"{_advice(model, '')} would help"
        )
    elif verdict == ALONE:
        in_sentence = f"has no other to compare with{_side_in_words(model.layout, new)}"
    summary = f"the new model {in_sentence}"
    summary += f". Judged {figures}"
    return Judgement(
        *(reason, summary, new, name, old, verdict),
        shown=shown,
        repeated=repeated,
        is_first_look=is_first_look,
        fits_badly=fits_badly,
        has_rival_learned=has_advantage,
    )


def _has_few_steps(model: Model) -> bool:
    """Return whether a model has few steps from random weights."""
    return "from" not in model.provenance and model.provenance.get("step", FEW_STEPS) < FEW_STEPS


_IN_SENTENCES = {
    BETTER: "is better than model {!r}: image error and bones together are {}, and it mirrors {} "
    "frames",
    AS_GOOD: "is as good as model {!r}: image error and bones together are alike, within "
    f"{round(100 * SAME_MISFIT - 100)} %, and it mirrors no more frames",
    ALONE: "has no other to compare with",
    UNKNOWN: "cannot be compared with model {!r}, which fits the held-out frames more closely, but "
    "was trained on them",
    DOUBTFUL: "is doubtful",
}


def _mirrored_as_a_whole(name: str) -> str:
    """Return a sentence on a model whose depth nothing decides."""
    look = wording(
        f"it from the side (replay FILE --model {name} --html look.html)",
        node="the shapes in the report",
        python="its shapes from the side",
    )
    undo = wording(
        "mirrored (lift --mirrored, the lifter's parameter mirrored)",
        node="the parameter mirrored",
        python="LiftingOptions(mirrored=True)",
    )
    return (
        f"the layout names no handedness, so the whole may be a mirror image: look at {look}; if "
        f"it is one, lift with {undo}, or name a handedness and train again"
    )


def _verdict(new: Figures, old: Figures | None, *, has_advantage: bool = False) -> str:
    """Return the verdict on a model that the rule does not doubt."""
    if old is None:
        return ALONE
    if has_advantage and worse_figures(new, old):
        return UNKNOWN
    return AS_GOOD if _gains(new, old) == ("alike", "no more") else BETTER


def _gains(new: Figures, old: Figures | None) -> tuple[str, str]:
    """Return how a model that is not doubted fits, and how many frames it mirrors."""
    old = old or new
    closer = SAME_MISFIT * new.misfit < old.misfit
    looser = new.misfit > SAME_MISFIT * old.misfit  # allowed beside a model that mirrors frames
    is_opposed = _or_zero(new.opposed) > MOST_OPPOSED
    fewer = is_opposed or old.wrong_sides > new.wrong_sides + MORE_WRONG_SIDES
    fit = "smaller" if closer else "larger" if looser else "alike"
    return fit, "fewer" if fewer else "no more"


def _side_in_words(layout: KeypointLayout, figures: Figures) -> str:
    """Return what is known of mirrored frames of a model that has no other to compare with."""
    if not layout.handedness:
        return ", and may be mirrored as a whole"
    if layout.warning:
        return ", and its handedness contradicts the names of its keypoints"
    if not _is_side_known(figures):
        return ", and nothing tells whether it mirrors frames"
    if math.isnan(figures.mirrored_share):
        return (
            ", and only the front that its layout names tells of mirrored frames, which is weak "
            "evidence: too few frames show nearly the same shape from other sides"
        )
    return ": nothing shows that it mirrors frames"


def _is_side_known(figures: Figures) -> bool:
    """Return whether neighbours or the front tell which frames are mirrored."""
    return not (math.isnan(figures.mirrored_share) and math.isnan(figures.front_disagreement))


def _on(basis: Comparable, name: str) -> str:
    """Return on which frames models are compared; `name` is that of the model at hand."""
    count = len(basis.frames.held_out)
    if basis.frames.held_out is basis.frames.training:
        return f"on the {count} frames of its training, as none were held out"
    text = f"on {count} held-out frames, later ones that the new model was not trained on"
    if basis.left_out:
        text += f" (not on {basis.left_out} others, which model {name!r} was trained on)"
    if not basis.has_advantage or not name:
        return text
    later = wording(
        "--input or --bag", node="train.bags or train.inputs", python="as a sequence of its own"
    )
    return (
        f"{text}. Model {name!r} was trained on these frames, so it is at an advantage; add a "
        f"later recording ({later}), of which frames are held out that neither has learned. Figures"
    )


def _same_sources(data: Dataset, rival: Model) -> str:
    """Return the files and bags that a model was trained on by their names, too; "" if none was."""
    learned = str(rival.provenance.get("data", "")).split("; ")
    files = [each for each in data.source.split("; ") if each.startswith(("file ", "bag"))]
    same = [each for each in files if each in learned]
    more = f" and {len(same) - 1} more" if len(same) > 1 else ""
    return f"a {same[0]}{more}" if same else ""


def _shown(new: Figures, old: Figures | None, name: str) -> str:
    """Return a few figures of both models in words."""
    values = [
        (each, getattr(new, each), getattr(old, each) if old else math.nan) for each in _SHOWN
    ]
    texts = []
    for each, value, other in values:
        if each == "misfit" and math.isnan(new.bone_variation):
            continue  # it is the image error alone
        if each == "wrong_sides" and not _is_side_known(new):
            texts.append("neither other views nor a front tell which frames are mirrored")
        elif not math.isnan(value):
            beside = "" if math.isnan(other) else f" ({name}: {percent(other)})"
            if each == "image_error" and not math.isnan(new.learned_image_error):
                beside += f", {percent(new.learned_image_error)} on the frames of its training"
            texts.append(_SHOWN[each].format(percent(value)) + beside)
    return ", ".join(texts)


def _guessed(model: Model) -> str:
    """Return a sentence on the keypoints that the frames rarely show; "" if there are none."""
    rare = model.provenance.get(RARELY_SHOWN, [])
    if not rare:
        return ""
    more = f" and {len(rare) - _MOST_NAMES} more" if len(rare) > _MOST_NAMES else ""
    said = "only guessed"
    if "from" in model.provenance:
        said = "guessed mostly as the start does"
        if model.provenance["recipe"]["start_share"] < (share := _SHARE_OF_SPEAKERS):
            option = wording(
                f"--start-share {share}",
                node=f"train.start_share {share}",
                python=f"Recipe(start_share={share})",
            )
            said += f"; {option} keeps more of that"
    return f". Rarely shown: {', '.join(rare[:_MOST_NAMES])}{more} ({said})"


def percent(share: float) -> str:
    """Return a share as a percentage with two digits."""
    value = 100 * share
    return f"{value:.0f} %" if value >= 9.95 or value < 0.05 else f"{value:.1f} %"


def _fronts_in_words(fronts: Sequence[tuple[Tetrahedron, float]], model: Model) -> str:
    """Return where the fours of a handedness do not hold, the worst one first, and the remedy.

    Several fours of a layout of the package hold, so that the model is at fault.
    """
    four, behind = max(fronts, key=lambda each: each[1])
    left, right, up, front = four
    where = f": {front} lies behind {left}, {right} and {up} in {percent(behind)}"
    own = LAYOUTS.get(model.layout.name)
    if own and len(fronts) > 1 and model.layout.handedness == own.handedness:
        return f"{where}; {_advice(model, '')} would help"
    several = "" if len(fronts) > 1 else ", or several, which vote"
    return (
        f"{where}. This need not be the model's fault: the layout's four may not always hold (as "
        f"where an animal turns its head). Name fours of a part that does not bend{several}"
    )


def worse_figures(new: Figures, old: Figures | None, *, has_advantage: bool = False) -> list[str]:
    """Return the names of the figures by which the rule doubts a new model.

    Args:
        new: of the new model.
        old: of the one at hand; None where there is none.
        has_advantage: whether the one at hand has learned the held-out frames, so that its misfit
            on new ones is larger.
    """
    most_image_error = LARGE_IMAGE_ERROR if has_advantage else MOST_IMAGE_ERROR
    most_misfit = MISFIT_OF_LEARNED if has_advantage else SAME_MISFIT
    too_far = ["misfit"] if new.image_error > most_image_error else []
    return _worse(new, old, most_misfit) or too_far


def _worse(new: Figures, old: Figures | None, most_misfit: float) -> list[str]:
    """Return the names of the figures that are worse than those of the model at hand.

    Args:
        new: of the new model.
        old: of the one at hand; None where there is none.
        most_misfit: times its misfit that the new model may have.
    """
    values = _known(new)
    shares = ("mirrored_share", "front_disagreement")
    if old is None:
        return [name for name in shares if values.get(name, 0.0) > MOST_MIRRORED]
    known = _known(old)
    both = [name for name in shares if name in values and name in known]
    worse = [name for name in both if values[name] > known[name] + MORE_WRONG_SIDES]
    # A figure may rise where the other shows that as many were mirrored before.
    if worse and new.wrong_sides > old.wrong_sides + MORE_WRONG_SIDES:
        return worse
    is_opposed = _or_zero(new.opposed) > MOST_OPPOSED
    if _or_zero(new.turned) > MOST_FOLDED:
        return ["turned"]
    is_whole = _or_zero(new.opposed) > MOST_FOLDED
    if is_whole and not _or_zero(old.front_disagreement) > MOST_BEHIND:
        return ["opposed"]
    less = any(known[name] > values[name] + MORE_WRONG_SIDES for name in both)
    if less and (is_opposed or old.wrong_sides > MOST_MIRRORED):
        return []
    bones, other_bones = _or_zero(new.bone_variation), _or_zero(old.bone_variation)
    if is_opposed:
        is_folded = not is_whole and bones < STEADIER_BONES * other_bones
        return [] if is_folded else ["opposed"]
    # Frames that the start mirrors may turn. Others are too few for the mean of the bones to tell.
    mended = max(old.wrong_sides - new.wrong_sides, 0.0)
    if _or_zero(new.turned) > mended + MORE_WRONG_SIDES:
        return ["turned"]
    worse = ["bone_variation"] if bones > LOOSER_BONES * other_bones else []
    return worse + (["misfit"] if new.misfit > most_misfit * old.misfit else [])


def rank(new: Figures, old: Figures | None, *, has_advantage: bool = False) -> Rank:
    """Return the rank of a model beside the one at hand, if there is one."""
    # The mirror image of a model that turns its frames itself says nothing against another one.
    is_rival_worse = old is not None and old.wrong_sides > new.wrong_sides + MORE_WRONG_SIDES
    is_opposed = _or_zero(new.opposed) > MOST_OPPOSED and not is_rival_worse
    opposed = new.opposed if is_opposed else 0.0
    worse = worse_figures(new, old, has_advantage=has_advantage)
    is_doubtful = new is not old and bool(worse)
    is_unknown = has_advantage and not worse and bool(worse_figures(new, old))
    return Rank(is_doubtful, new is old or is_unknown, new.misfit + new.wrong_sides + opposed)


def _or_zero(value: float) -> float:
    """Return a figure, 0 where it is unknown."""
    return 0.0 if math.isnan(value) else value


def _known(figures: Figures) -> dict[str, float]:
    """Return the figures that are known."""
    values = figures._asdict() | {"misfit": figures.misfit}
    return {name: value for name, value in values.items() if not math.isnan(value)}


def _rounded(figures: Figures) -> dict[str, float]:
    """Return the figures that are known, for a file."""
    return {name: round(value, 5) for name, value in _known(figures).items()}


def _in_words(name: str, new: Figures, old: Figures | None, rival: str) -> str:
    """Return a figure of both models in words."""
    text = IN_WORDS[name].format(percent(getattr(new, name)))
    known = _known(old) if old and name not in _BESIDE else {}
    return f"{text} ({rival}: {percent(known[name])})" if name in known else text


def _advice(model: Model, rival: str) -> str:
    """Return what would help a doubtful model."""
    advice = ["more views", "more frames"]
    if minutes := model.provenance.get("factorisation_needs_minutes"):
        limit = wording(
            f"--minutes {minutes:g}, train.minutes", node=f"train.minutes {minutes:g}", python=""
        )
        advice.insert(0, f"more time ({limit}, or no limit)")
    elif _has_few_steps(model):
        steps = FROM_RANDOM
        option = wording(
            f"--steps {steps}, train.steps",
            node=f"train.steps {steps}",
            python=f"Recipe.steps, {steps} are usual",
        )
        advice.insert(0, f"more steps ({option})")
    if "from" in model.provenance:
        advice.append("fewer steps")
        option = wording(
            "--start-share, train.start_share",
            node="train.start_share",
            python="Recipe.start_share",
        )
        advice.append(f"a larger share of the start ({option})")
    else:
        option = wording("--from, train.from", node="train.from", python="start")
        advice.append(f"a start from {rival or 'a model of such an object'} ({option})")
    if model.layout.edges and model.layout.handedness:
        options = wording(
            " (--bone-length-weight, --handedness-weight, --depth-penalty, or train.*)",
            node=" (train.bone_length_weight, train.handedness_weight, train.depth_penalty)",
            python=", which the program `train` offers,",
        )
        advice.append(f"the layout's losses{options}")
    return f"{', '.join(advice[:-1])} or {advice[-1]}"


class Standing(NamedTuple):
    """A model beside others on the same frames.

    Attributes:
        model: the model.
        figures: beside the model at hand.
        verdict: "at hand", or BETTER, AS_GOOD, UNKNOWN or DOUBTFUL beside it; "" where there is
            none.
        rank: orders the models.
        has_learned: whether it was trained on some of the held-out frames.
    """

    model: Model
    figures: Figures
    verdict: str
    rank: Rank
    has_learned: bool = False


def standings(frames: Split, models: Sequence[Model], rival: Model | None) -> list[Standing]:
    """Return those models that lift the frames, the best first.

    Args:
        frames: those that a model was trained on, and those held out.
        models: the new one first.
        rival: the model at hand, with which each is compared; None: with itself.
    """
    basis = comparable(frames, rival)
    frames, comparison = basis.frames, Judge(basis.frames)
    is_held_out = frames.held_out is not frames.training
    at_hand, old = None, None
    if rival is not None:
        with suppress(ValueError):
            old, at_hand = comparison.figures(rival), rival
    result = []
    for model in ([at_hand] if at_hand else []) + list(models):
        with suppress(ValueError):
            new = old if model is at_hand and old else comparison.figures(model, at_hand)
            # A new model has learned them by its start alone, if at all.
            has_learned = model is not models[0] and is_held_out
            has_learned = has_learned and bool(learned_by(model, frames.held_out).any())
            has_advantage = basis.has_advantage and not has_learned
            place = rank(new, old, has_advantage=has_advantage)
            verdict = _verdict(new, old, has_advantage=has_advantage) if old else ""
            if model is at_hand or place.doubtful:
                verdict = "at hand" if model is at_hand else DOUBTFUL
            result.append(Standing(model, new, verdict, place, has_learned))
    return sorted(result, key=lambda each: each.rank)


class Judge:
    """Compares models on the frames of one dataset."""

    def __init__(self, frames: Split) -> None:
        """Take up to 2000 frames of each kind.

        Args:
            frames: of the training and held out.
        """
        self._held_out = _spread(frames.held_out)
        self._all = _spread(frames.training)
        self._trained_on = 0  # the first ones of all, where others are held out
        if frames.held_out is not frames.training:
            share = len(frames.held_out) / (len(frames.training) + len(frames.held_out))
            most = round(share * _MOST_FRAMES)
            kept = _spread(frames.training, _MOST_FRAMES - most)
            self._all = concatenate([kept, _spread(frames.held_out, most)])
            self._trained_on = len(kept)
        store = FrameStore.of(self._all.points, self._all.visible)
        self._mirror_check = MirrorCheck(store, Normaliser(), _MOST_FRAMES)
        self._lifted: dict[tuple[int, bool, bool], tuple[Model, _Lifted]] = {}

    def figures(self, model: Model, other: Model | None = None) -> Figures:
        """Return the figures of a model, whose keypoints are matched by name.

        Args:
            model: the model.
            other: the one that it is compared with; None: itself.

        Raises:
            ValueError: one of them shares fewer than 4 keypoints with the data, or lifts no frame.
        """
        layout = self._held_out.layout
        S, residual, visible = self._lift(model, held_out=True)
        T, rival_residual, also_visible = self._lift(other or model, held_out=True)
        sound = np.isfinite(residual) & np.isfinite(rival_residual)
        if not sound.any():
            raise ValueError(f"model {model.name!r} lifts none of the held-out frames")
        S, visible = S[sound], visible[sound]
        everything, _, shown = self._lift(model)
        test = self._mirror_check.test_shapes(everything, shown)
        X = _unit(S, visible)
        variation, side_difference = _bones(S, visible, layout)
        both = visible & also_visible[sound]
        Y, Z = _unit(S, both), _unit(T[sound], both)
        is_trained_on = other is not None and _origin(model) == other.name
        return Figures(
            float(np.median(residual[sound])),
            variation,
            test.share if test.tested.mean() >= MIN_TESTED else math.nan,
            _front_disagreement(everything, shown, layout),
            self._opposed(model, other or model),
            side_difference,
            float(np.linalg.norm(X[..., :2], axis=(1, 2)).mean()),
            float(np.linalg.norm(align(Y, Z).aligned - Z, axis=(1, 2)).mean()),
            self._opposed(model, other, corrected=True) if other and is_trained_on else math.nan,
            self._learned_image_error(model),
        )

    def _learned_image_error(self, model: Model) -> float:
        """Return the residual over the frames of the training; NaN where none are held out."""
        residual = self._lift(model)[1][: self._trained_on]
        is_known = np.isfinite(residual)
        return float(np.median(residual[is_known])) if is_known.any() else math.nan

    def _lift(self, model: Model, *, held_out: bool = False, corrected: bool = False) -> _Lifted:
        """Return a model's shapes of all or of the held-out frames, which are computed once."""
        key = id(model), held_out, corrected
        if key not in self._lifted:  # the model is kept: its id is the key
            data = self._held_out if held_out else self._all
            options = _WITH_CORRECTION if corrected else _NETWORK_ALONE
            self._lifted[key] = model, _lift(model, data, options)
        return self._lifted[key][1]

    def _opposed(self, model: Model, other: Model, *, corrected: bool = False) -> float:
        """Return the share of all frames of which `other` has the mirror image; 0 for one alone."""
        S, _, visible = self._lift(model, corrected=corrected)
        T, residual, also_visible = self._lift(other, corrected=corrected)
        both, sound = visible & also_visible, np.isfinite(residual)
        tells = sound & (both.sum(1) >= MIN_SEEN_SHARE * both.shape[1])
        if not tells.any():
            return 0.0
        aligned = align(_unit(S, both)[tells], _unit(T, both)[tells], allow_reflection=True)
        count = int(aligned.mirrored.sum())
        return count / int(sound.sum()) if count > 1 else 0.0

    def fronts(self, model: Model) -> list[tuple[Tetrahedron, float]]:
        """Return each four of the data's handedness that counts, with its share of frames behind.

        The front of a four is behind in such a frame.
        """
        S, _, visible = self._lift(model)
        layout = self._held_out.layout
        corners = np.array([[layout.index(name) for name in four] for four in layout.handedness])
        counts: NDArray[np.bool_] = np.asarray(visible[:, corners].all(2), bool)
        behind = (votes(S, layout) < 0) & counts
        shares = behind.sum(0) / np.maximum(counts.sum(0), 1)
        return list(zip(layout.handedness, map(float, shares), strict=True))


def _spread(dataset: Dataset, most: int = _MOST_FRAMES) -> Dataset:
    """Return at most `most` frames of a dataset, evenly spread."""
    n = len(dataset)
    return dataset[np.unique(np.linspace(0, n - 1, min(n, most)).astype(int))]


def _origin(model: Model) -> str:
    """Return the name of the model that a model was trained on from; "" if from none."""
    return str(model.provenance.get("from", {}).get("model", ""))


def _lift(model: Model, data: Dataset, options: LiftingOptions) -> _Lifted:
    """Return shapes (n, p, 3), residuals (n,) and the visible keypoints (n, p) that have a shape.

    The shapes are in the axes of the camera and the keypoints in the order of the data, 0 where
    the model lacks one or a frame is not lifted; the residual of such a frame is NaN.
    """
    confidence = data.visible.astype(np.float32)
    mapped = KeypointMap(data.layout, model.layout)(data.points, confidence)
    lifted = lift_all(Lifter(model, options).lift, *mapped)
    sound = np.isfinite(lifted.shapes).all((1, 2)) & np.isfinite(lifted.residual)
    S = np.zeros((*data.visible.shape, 3))
    places = match_names(model.layout.keypoints, data.layout.keypoints)
    common = [i for i, name in enumerate(data.layout.keypoints) if name in places]
    source = [places[data.layout.keypoints[i]] for i in common]
    S[:, common] = np.where(sound[:, None, None], lifted.shapes[:, source], 0)
    visible = np.zeros_like(data.visible)
    visible[:, common] = data.visible[:, common] & sound[:, None]
    return S, np.where(sound, lifted.residual, np.nan), visible


def _unit(S: Floats, visible: NDArray[np.bool_]) -> Floats:
    """Return shapes (n, p, 3) centred over their visible keypoints, 0 elsewhere, of norm 1."""
    mask = visible[..., None].astype(float)
    S = centre_visible(S, mask) * mask
    unit: Floats = S / np.maximum(np.linalg.norm(S, axis=(1, 2), keepdims=True), 1e-12)
    return unit


def _bones(S: Floats, visible: NDArray[np.bool_], layout: KeypointLayout) -> tuple[float, float]:
    """Return `bone_variation` and `side_difference` of shapes; NaN where there are too few bones.

    A length is relative to the bone's median and to the median of its frame's bones, so that hidden
    bones do not matter.
    """
    pairs = layout.bone_indices()
    if len(pairs) < 2:
        return math.nan, math.nan
    i, j = np.array(pairs).T
    both = visible[:, i] & visible[:, j]
    lengths = np.where(both, np.linalg.norm(S[:, i] - S[:, j], axis=2), np.nan)
    enough = both.mean(0) >= MIN_VISIBLE_SHARE
    lengths = lengths[:, enough][(both[:, enough].sum(1) >= 2)]
    if lengths.shape[1] < 2 or len(lengths) < 2:
        return math.nan, math.nan
    lengths = lengths / np.nanmedian(lengths, axis=0)
    lengths /= np.maximum(np.nanmedian(lengths, axis=1, keepdims=True), 1e-9)
    variation = float(np.nanmean(np.abs(lengths - np.nanmedian(lengths, axis=0))))
    sides, places = layout.sides(), {frozenset(pair): k for k, pair in enumerate(pairs)}
    opposite = [places.get(frozenset((sides[a], sides[b])), -1) for a, b in pairs]
    partners = [(k, other) for k, other in enumerate(opposite) if other > k]
    if not partners:
        return variation, math.nan
    left, right = np.array(partners).T
    raw = np.where(both, np.linalg.norm(S[:, i] - S[:, j], axis=2), np.nan)
    gaps = np.abs(raw[:, left] - raw[:, right]) / np.maximum(raw[:, left] + raw[:, right], 1e-9)
    return variation, float(np.nanmean(2 * gaps)) if np.isfinite(gaps).any() else math.nan


def _front_disagreement(S: Floats, visible: NDArray[np.bool_], layout: KeypointLayout) -> float:
    """Return the share of frames whose votes on the front are negative in sum; NaN without any."""
    if not layout.handedness:
        return math.nan
    corners = np.array([[layout.index(name) for name in four] for four in layout.handedness])
    counts: NDArray[np.bool_] = np.asarray(visible[:, corners].all(2), bool)
    sums = (votes(S, layout) * counts).sum(1)[counts.any(1)]
    return float((sums < 0).mean()) if len(sums) else math.nan
