# SPDX-License-Identifier: Apache-2.0
"""Options that are set and cannot have an effect, with the reason."""

from __future__ import annotations

from dataclasses import Field, fields
from typing import Any, ClassVar, Protocol

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.options import GravityOptions, HistoryOptions, LiftingOptions
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.options import InputOptions


class Sources(Protocol):
    """Sources of the direction of gravity; "": not used."""

    @property
    def imu(self) -> str:
        """Topic of an IMU."""

    @property
    def frame(self) -> str:
        """Frame on /tf."""


_DEFAULT_HISTORY = HistoryOptions()


def unused_options(
    inputs: InputOptions,
    lifting: LiftingOptions,
    smoothing: SmoothingOptions,
    history: HistoryOptions = _DEFAULT_HISTORY,
    layout: KeypointLayout | None = None,
) -> dict[str, str]:
    """Return a warning for each parameter of the lifter that has no effect, by its name.

    Args:
        inputs: how messages are read.
        lifting: how keypoints are lifted.
        smoothing: the filter after the correction.
        history: what is remembered.
        layout: of the model; None: unknown.
    """
    warnings: dict[str, str] = {}
    size = {"image_width": inputs.image_width, "image_height": inputs.image_height}
    if any(size.values()) and not all(size.values()):
        given, missing = sorted(size, key=lambda name: not size[name])
        text = f"{given} is {size[given]} and has no effect without {missing}: set both"
        warnings |= dict.fromkeys(size, text)
    if lifting.correction == "none" and lifting.noise != LiftingOptions.noise:
        text = f"noise is {lifting.noise:g} and has no effect, since correction is 'none'"
        warnings["noise"] = text
    if not smoothing.enabled:
        for field in fields(SmoothingOptions):
            value = getattr(smoothing, field.name)
            if value != field.default:
                name = f"smoothing.{field.name}"
                text = f"{name} is {value:g} and has no effect, since smoothing.enabled is false"
                warnings[name] = text
    if not history.enabled or lifting.correction == "none":
        reason = "history.enabled is false" if not history.enabled else "correction is 'none'"
        for field in fields(HistoryOptions):
            value = getattr(history, field.name)
            if value != field.default and field.name != "enabled":
                name = f"history.{field.name}"
                warnings[name] = f"{name} is {value:g} and has no effect, since {reason}"
    if layout and (reason := lifting.unused_height(layout)):
        text = f"person_height is {lifting.person_height:g} and has no effect, since {reason}"
        warnings["person_height"] = text
    return warnings


class DepthParameters(Protocol):
    """A dataclass of the parameters of measured depth."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def topic(self) -> str:
        """Topic of measured depth; "": not used."""


def unused_depth(depth: DepthParameters) -> dict[str, str]:
    """Return a warning for each parameter of measured depth that has no effect, by its name."""
    if depth.topic:
        return {}
    changed = [f for f in fields(depth) if getattr(depth, f.name) != f.default]
    names = {f"depth.{f.name.rstrip('_')}": getattr(depth, f.name) for f in changed}
    return {
        name: f"{name} is {value} and has no effect, since depth.topic is empty"
        for name, value in names.items()
    }


def unused_height(
    height: float, up: GravityOptions, sources: Sources, target_frame: str
) -> dict[str, str]:
    """Return a warning, by its name, if the camera's height has no effect.

    Args:
        height: of the camera above the floor in metres, above 0.
        up: the direction that a parameter gives.
        sources: the other sources of gravity.
        target_frame: fixed frame, which has z up; "" = none.
    """
    if up.direction is not None or sources.imu or sources.frame or target_frame:
        return {}
    return {
        "camera_height": f"camera_height is {height:g} and has no effect, since the direction of "
        "gravity is unknown: set gravity.up, gravity.imu, gravity.frame or target_frame"
    }


def unused_gravity(
    up: GravityOptions, sources: Sources, lifting: LiftingOptions, layout: KeypointLayout
) -> dict[str, str]:
    """Return a warning for each parameter of gravity that has no effect, by its name.

    Args:
        up: the direction that a parameter gives.
        sources: the other sources of gravity.
        lifting: how keypoints are lifted.
        layout: of the model.
    """
    named = {
        "gravity.up": str(list(up.up)) if up.direction is not None else "",
        "gravity.imu": sources.imu,
        "gravity.frame": sources.frame,
    }
    if lifting.correction == "none":
        reason = "correction is 'none'"
    elif not layout.top:
        reason = f"the model's layout {layout.name!r} names no top and bottom"
    else:
        return {}
    return {
        name: f"{name} is {value} and has no effect, since {reason}"
        for name, value in named.items()
        if value
    }
