"""ROS parameters from dataclass options: declared with descriptors, read back as the dataclass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import Field
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from deep_nrsfm_ros.configuration import Option, options

Config = TypeVar("Config")


def declare(node: Node, cls: type[Config], prefix: str = "") -> Config:
    """Declare a parameter for every option of the dataclass `cls` and return their values.

    prefix: "train." gives train.steps and so on. Raises ValueError, or rclpy's
    ParameterException, for a value from outside that does not fit.
    """
    for field, _, opt in options(cls):
        descriptor = _descriptor(field.default, opt)
        node.declare_parameter(parameter_name(field, prefix), _to_ros(field.default), descriptor)
    return read(node, cls, prefix)


def read(
    node: Node, cls: type[Config], prefix: str = "", changes: Sequence[Parameter] = ()
) -> Config:
    """Return the dataclass `cls` as it stands in the node's parameters, once `changes` are made.

    Raises ValueError that names the first parameter outside its range.
    """
    proposed = {parameter.name: parameter.value for parameter in changes}
    values = {}
    for field, _, opt in options(cls):
        name = parameter_name(field, prefix)
        # `[]` in a parameter file leaves an array without a value: that is the default too.
        now = node.get_parameter_or(name, Parameter(name, value=_to_ros(field.default)))
        value = proposed.get(name, now.value)
        values[field.name] = _from_ros(name, value, field.default)
        opt.check(name, values[field.name])
    return cls(**values)


def parameter_name(field: Field[Any], prefix: str = "") -> str:
    """Return the name of the parameter of an option, e.g. "train.from" of the field `from_`."""
    return prefix + field.name.rstrip("_")


def _descriptor(default: Any, opt: Option) -> ParameterDescriptor:
    """Say what the parameter means and allows, for `ros2 param describe` and for tools."""
    descriptor = ParameterDescriptor(description=opt.description, read_only=opt.read_only)
    # People write `0` for `0.0`; only a parameter of dynamic type takes it (see _from_ros).
    descriptor.dynamic_typing = isinstance(default, float)
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
    # rclpy takes an empty list for an array of bytes; a single empty string stands for it.
    return (list(value) or [""]) if isinstance(value, tuple) else value


def _from_ros(name: str, value: Any, default: Any) -> Any:
    """Return the value of a parameter as that of an option whose default is `default`."""
    if isinstance(default, tuple):
        return tuple(item for item in value if item != "")
    if isinstance(default, float):
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"{name} is {value!r}; it must be a number")
        return float(value)
    return value
