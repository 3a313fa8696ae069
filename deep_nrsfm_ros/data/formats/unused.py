# SPDX-License-Identifier: Apache-2.0
"""What a file holds and a reader does not use: said, so that nothing is lost without a word."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from deep_nrsfm_ros.lifting.sanity import Finding

_SHOWN = 6  # names that a sentence lists
_MEANINGS = {
    "the frame": ("frame", "image", "img", "file", "filename", "path"),
    "the time": (
        *("time", "times", "timestamp", "timestamps", "stamp", "stamps", "sec", "seconds", "ms"),
        *("us", "µs", "μs", "usec", "ns", "pts", "fps"),
    ),
    "an identity": ("id", "ids", "track", "tracks", "person", "individual", "animal", "subject"),
    "a confidence": (
        *("conf", "confidence", "confidences", "score", "scores", "prob", "probability", "vis"),
        *("visible", "visibility", "likelihood", "certainty"),
    ),
}
"""What a name may mean -> its words."""


def words_of(name: str) -> set[str]:
    """Return the words of a name in small letters: frame and number of `frameNumber`."""
    spaced = re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", name).lower()
    return {word for word in re.split(r"[^a-zµμ]+", spaced) if word}


def meaning(name: str) -> str:
    """Return what an unused name seems to hold: a key of `_MEANINGS`, or ""."""
    words = words_of(name)
    words |= {word.removesuffix("s") for word in words}
    return next((what for what, known in _MEANINGS.items() if not words.isdisjoint(known)), "")


def unused_sentence(kind: str, names: Sequence[str]) -> str:
    """Return the sentence that names what is not used.

    Args:
        kind: of the names, in the plural: "columns", "fields", "arrays".
        names: in the order of the file.
    """
    more = ", ..." * (len(names) > _SHOWN)
    return f"not used: {kind} {', '.join(names[:_SHOWN])}{more}"


def find_unused(kind: str, names: Sequence[str], remedies: Mapping[str, str]) -> list[Finding]:
    """Return a finding if unused names seem to hold a frame, a time, an identity or a confidence.

    Args:
        kind: as in `unused_sentence`.
        names: likewise.
        remedies: for each meaning that the reader knows, the name under which it reads it; a
            meaning that is left out is no finding, such as that of the frame where frames are
            known.
    """
    suspects = [(name, what) for name in names if (what := meaning(name)) in remedies]
    if not suspects:
        return []
    listed = ", ".join(f"{name} (is it {what}?)" for name, what in suspects[:_SHOWN])
    cures = dict.fromkeys(f"call it {remedies[what]!r}" for _, what in suspects)
    return [Finding("unused", f"not used: {kind} {listed}; {', or '.join(cures)} if it is")]
