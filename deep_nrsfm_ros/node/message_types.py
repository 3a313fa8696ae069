# SPDX-License-Identifier: Apache-2.0
"""Message classes by name, imported on demand: no detector's package is required."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from rclpy.serialization import deserialize_message

from deep_nrsfm_ros.lifting.observation import MessageError


def message_class(name: str) -> Any:
    """Return the class of the message type "package/Type".

    Raises:
        ValueError: the package is not installed or has no such message.
    """
    package, _, kind = name.partition("/")
    try:
        cls = getattr(import_module(f"{package}.msg"), kind, None)
    except ImportError as error:
        raise ValueError(
            f"messages of type {name} need the package {package}, not importable ({error}): "
            f"install it (ros-jazzy-{package.replace('_', '-')}, or from source) and source the "
            "workspace that it is in"
        ) from None
    if cls is None:
        raise ValueError(f"package {package} has no message {kind}")
    return cls


def decoder(name: str) -> Callable[[bytes], Any]:
    """Return the function that decodes serialised messages of type "package/Type".

    It raises MessageError for bytes that are no such message.

    Raises:
        ValueError: as `message_class`.
    """
    cls = message_class(name)

    def decode(raw: bytes) -> Any:
        try:
            return deserialize_message(raw, cls)
        except Exception as error:  # the middleware raises several kinds
            raise MessageError(f"{len(raw)} bytes that are no {name}: {error}") from None

    return decode
