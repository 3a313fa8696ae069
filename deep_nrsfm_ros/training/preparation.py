"""What is done with a dataset before a training: curated, then looked at for sufficiency."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from deep_nrsfm_ros.configuration import override
from deep_nrsfm_ros.data.curation import KEEP_ALL, Curated, Curation, curate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.sufficiency import Sufficiency, assess_sufficiency


def prepare(
    given: argparse.Namespace, dataset: Dataset, say: Callable[[str], None]
) -> tuple[Curated, Sufficiency]:
    """Return what is fit to be trained on and how it varies; raise ValueError if nothing is."""
    curated = curate(dataset, chosen_curation(given))
    if curated.summary:
        say(curated.summary)
    sufficiency = assess_sufficiency(curated.dataset)
    if sufficiency.refusal:
        raise ValueError(f"a model cannot be learned from this: {sufficiency.refusal}")
    for warning in (*curated.warnings, *sufficiency.warnings):
        say(f"warning: {warning}")
    return curated, sufficiency


def chosen_curation(given: argparse.Namespace) -> Curation:
    """Return how the arguments want it curated.

    Motion capture is clean and is left as it is, unless they say otherwise.
    """
    return override(KEEP_ALL if given.cmu else Curation(), given)
