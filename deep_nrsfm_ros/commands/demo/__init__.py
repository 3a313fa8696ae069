# SPDX-License-Identifier: Apache-2.0
"""The demo: a real person, seen by four cameras, lifted to 3D and shown on a page."""

from deep_nrsfm_ros.commands.demo.first_look import arguments, main

__all__ = ["arguments", "main"]
