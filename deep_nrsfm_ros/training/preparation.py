"""What is done with an dataset before a training: curated, then looked at for variation."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from deep_nrsfm_ros.configuration import override
from deep_nrsfm_ros.data.curation import AS_IT_IS, Curated, Curation, curate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.sufficiency import Variation, examine


def prepare(
    given: argparse.Namespace, dataset: Dataset, say: Callable[[str], None]
) -> tuple[Curated, Variation]:
    """Return what is fit to be trained on and how it varies; raise ValueError if nothing is."""
    curated = curate(dataset, chosen_curation(given))
    if curated.summary:
        say(curated.summary)
    variation = examine(curated.dataset)
    if variation.refusal:
        raise ValueError(f"a model cannot be learned from this: {variation.refusal}")
    for warning in (*curated.warnings, *variation.warnings):
        say(f"warning: {warning}")
    return curated, variation


def chosen_curation(given: argparse.Namespace) -> Curation:
    """Return how the arguments want it curated.

    Motion capture is clean and is left as it is, unless they say otherwise.
    """
    return override(AS_IT_IS if given.cmu else Curation(), given)
