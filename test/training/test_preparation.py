"""What the arguments of a training make of its data before it starts."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.commands.train import arguments
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.training.preparation import prepare


def people(f: int = 60) -> Dataset:
    """Return f views of people, each of them twice."""
    rng = np.random.default_rng(0)
    shapes = centre(rng.standard_normal((17, 3)) + 0.3 * rng.standard_normal((f, 17, 3)))
    points = np.repeat(shapes @ random_cameras(f, rng), 2, axis=0).astype(np.float32)
    return Dataset(points, np.ones((2 * f, 17), bool), HUMAN17, "made up")


@pytest.mark.parametrize(
    ("words", "left"),
    [
        (("--cmu", "folder"), 120),
        (("--cmu", "folder", "--min-change", "0.02"), 60),
        (("--bag", "bag"), 60),
        (("--bag", "bag", "--min-change", "0"), 120),
    ],
)
def test_motion_capture_is_left_as_it_is_unless_told(words: tuple[str, ...], left: int) -> None:
    said: list[str] = []
    curated, sufficiency = prepare(arguments().parse_args(words), people(), said.append)
    assert len(curated.dataset) == sufficiency.frames == left
    assert any("near-duplicates" in sentence for sentence in said) == (left == 60)
    assert any(sentence.startswith("warning: ") for sentence in said)


def test_hopeless_data_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot be learned from this: .*at least 10"):
        prepare(arguments().parse_args(["--bag", "bag"]), people(3), print)
