"""The data of a training is curated and assessed before the training starts."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.commands.train import parser
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.training.config import TrainingConfig
from deep_nrsfm_ros.training.preparation import prepare
from deep_nrsfm_ros.training.reporter import Reporter

REPORTER = Reporter(as_json=False, should_stop=lambda: False)


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
def test_motion_capture_keeps_all_frames_by_default(
    words: tuple[str, ...], left: int, capsys: pytest.CaptureFixture[str]
) -> None:
    config = TrainingConfig.from_arguments(parser().parse_args(words))
    prepared = prepare(config.curation, people(), REPORTER)
    assert len(prepared.dataset) == prepared.sufficiency.frames == left
    sentences = capsys.readouterr().err.splitlines()
    assert any("near-duplicates" in sentence for sentence in sentences) == (left == 60)
    assert any(sentence.startswith("warning: ") for sentence in sentences)


def test_hopeless_data_is_refused() -> None:
    with pytest.raises(ValueError, match=r"cannot be learned from this: .*at least 10"):
        prepare(Curation(), people(3), REPORTER)
