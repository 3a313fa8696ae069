# SPDX-License-Identifier: Apache-2.0
"""Declare the options of a dataclass as ROS parameters, and read them back.

A parameter's default, range and description stand in the dataclass: `lifting/options.py`,
`lifting/smoothing.py`, `messages/options.py`, `node/camera.py`, `node/gravity.py`,
`node/bodies.py`, and for train.* `training/request.py`, `training/limits.py`,
`nrsfm/recipe.py` and `data/curation.py`.
"""

from __future__ import annotations

import difflib
from array import array
from collections.abc import Sequence
from dataclasses import Field
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from deep_nrsfm_ros.configuration import Option, options

Config = TypeVar("Config")

_OF_ROS = ("qos_overrides.", "use_sim_time")  # declared when they are used
_ALIKE = 0.6  # difflib's ratio of two names, from which on one may be meant by the other


def declare(node: Node, cls: type[Config], prefix: str = "") -> Config:
    """Declare a parameter for every option of a dataclass, and return their values.

    Args:
        node: owns the parameters.
        cls: the dataclass.
        prefix: of their names; "train." gives train.steps.

    Raises:
        ValueError: a value from outside is invalid.
        ParameterException: rclpy refuses a value from outside.
    """
    for field, _, opt in options(cls):
        descriptor = _descriptor(field.default, opt)
        node.declare_parameter(parameter_name(field, prefix), _to_ros(field.default), descriptor)
    return read(node, cls, prefix)


def read(
    node: Node, cls: type[Config], prefix: str = "", changes: Sequence[Parameter] = ()
) -> Config:
    """Return a dataclass of the values of a node's parameters.

    Args:
        node: owns the parameters.
        cls: the dataclass.
        prefix: of their names.
        changes: new values, which take precedence.

    Raises:
        ValueError: a value is invalid; the text names the first such parameter.
    """
    proposed = {parameter.name: parameter.value for parameter in changes}
    values = {}
    for field, _, opt in options(cls):
        name = parameter_name(field, prefix)
        # `[]` in a parameter file leaves an array without a value; it means the default.
        present = node.get_parameter_or(name, Parameter(name, value=_to_ros(field.default)))
        value = proposed.get(name, present.value)
        values[field.name] = _from_ros(name, value, field.default)
        opt.check(name, values[field.name])
    try:
        return cls(**values)
    except ValueError as error:  # it begins with the name of the option
        raise ValueError(f"{prefix}{error}") from error


def undeclared(node: Node) -> list[str]:
    """Return a warning for each parameter that was set from outside and that no code declares.

    Args:
        node: has declared all of its parameters.
    """
    # rclpy has no public way to the overrides without declaring all of them.
    overrides = getattr(node, "_parameter_overrides", {})
    declared = node.list_parameters([], 0).names
    warnings = []
    for name in overrides:
        if name in declared or name.startswith(_OF_ROS):
            continue
        text = f"there is no parameter {name!r}; its value is not used"
        # The programs have options without the group: `--up` of `lift` is gravity.up here.
        alike = [whole for whole in declared if whole.endswith(f".{name}")]
        alike = alike or difflib.get_close_matches(name, declared, 1, _ALIKE)
        if alike:
            text += f"; do you mean {' or '.join(map(repr, alike))}?"
        warnings.append(text)
    return warnings


def parameter_name(field: Field[Any], prefix: str = "") -> str:
    """Return the name of an option's parameter: "train.from" for the field `from_`."""
    return prefix + field.name.rstrip("_")


def _descriptor(default: Any, opt: Option) -> ParameterDescriptor:
    """Return the descriptor that `ros2 param describe` and tools show."""
    descriptor = ParameterDescriptor(description=opt.description, read_only=opt.read_only)
    # Users write `0` for `0.0`; only a parameter of dynamic type accepts it (see _from_ros).
    numbers = isinstance(default, tuple) and bool(default) and isinstance(default[0], float)
    descriptor.dynamic_typing = isinstance(default, float) or numbers
    if opt.choices:
        descriptor.additional_constraints = "one of " + ", ".join(opt.choices)
    elif opt.low is None or opt.high is None:  # a range in ROS has both ends
        descriptor.additional_constraints = opt.allowed()
    elif isinstance(default, float):
        ends = {"from_value": float(opt.low), "to_value": float(opt.high)}
        descriptor.floating_point_range = [FloatingPointRange(**ends)]
    else:
        descriptor.integer_range = [IntegerRange(from_value=int(opt.low), to_value=int(opt.high))]
    return descriptor


def _to_ros(value: Any) -> Any:
    """Return the value of an option as a parameter's value."""
    # rclpy reads an empty list as an array of bytes; [""] stands for it.
    return (list(value) or [""]) if isinstance(value, tuple) else value


def _from_ros(name: str, value: Any, default: Any) -> Any:
    """Return the value of a parameter as that of an option whose default is `default`."""
    if isinstance(default, tuple) and default and isinstance(default[0], float):
        if not isinstance(value, (list, tuple, array)) or any(
            isinstance(item, bool) or not isinstance(item, (int, float)) for item in value
        ):
            raise ValueError(f"{name} is {value!r}; it must be numbers, as in {list(default)}")
        return tuple(map(float, value))
    if isinstance(default, tuple):
        return tuple(item for item in value if item != "")
    if isinstance(default, float):
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"{name} is {value!r}; it must be a number")
        return float(value)
    return value
