# SPDX-License-Identifier: Apache-2.0
"""Sentences of a training in the words of Python, whose `train` has arguments and no options."""

from __future__ import annotations

import re

_TERMS = (
    (r", or name the value \(--missing-value=[^)]*\)", ""),
    (r"give the size of the image \(image_width and image_height\), or multiply", "multiply"),
    (r"\(--hands, train.hands\)", "(hands)"),
    (r"\(--object, train.object\)", "(object)"),
    (r"\(parameter keypoint_layout, option --keypoint-layout\)", "(layout)"),
    (r"lower --min-confidence", "the confidence"),
    (r"--min-confidence", "the confidence"),
    (r"set the keypoint layout to (\w+)", r"give layout='\1'"),
    (r"--outlier-threshold 0 keeps them", "the program `train` can keep them"),
    (
        r"sides, start from a model of such an object \(--from, train.from\), or let the layout "
        r"help \([^)]*\)",
        "sides, or start from a model of such an object (start)",
    ),
    (r"\(--from, train.from\)", "(start)"),
    (r"\(--steps (\d+), train.steps\)", r"(Recipe.steps, \1 are usual)"),
    (r"\(--start-share, train.start_share\)", "(Recipe.start_share)"),
    (r"--start-share ([\d.]+) keeps", r"Recipe(start_share=\1) keeps"),
    (
        r"the layout's losses \([^)]*\)",
        "the layout's losses, which the program `train` offers,",
    ),
    (
        r"look at it from the side \(replay FILE [^)]*\)",
        "look at its shapes from the side",
    ),
)


def in_python(sentence: str) -> str:
    """Return a sentence that names options of the command line or parameters in Python's words."""
    for pattern, words in _TERMS:
        sentence = re.sub(pattern, words, sentence)
    return sentence
