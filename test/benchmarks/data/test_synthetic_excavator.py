# SPDX-License-Identifier: Apache-2.0
import numpy as np

from benchmarks.data import synthetic_excavator
from benchmarks.real.train_from_bags import EXCAVATOR
from deep_nrsfm_ros.model_files.find_layout import find_layout
from deep_nrsfm_ros.nrsfm.handedness import votes

LAYOUT = find_layout("--object", str(EXCAVATOR))


def test_it_is_the_machine_of_the_layout_file() -> None:
    truth = synthetic_excavator.record(200, 0).truth
    assert truth.shape == (200, len(LAYOUT), 3)
    assert (votes(truth, LAYOUT) > 0).all()
    a, b = map(LAYOUT.index, LAYOUT.reference or ())
    lengths = np.linalg.norm(truth[:, a] - truth[:, b], axis=1)
    np.testing.assert_allclose(lengths, LAYOUT.reference_length or 0, rtol=1e-6)
    for name, parts in LAYOUT.derived.items():
        mean = truth[:, [LAYOUT.index(part) for part in parts]].mean(1)
        np.testing.assert_allclose(truth[:, LAYOUT.index(name)], mean, atol=1e-9)


def test_it_works_smoothly_and_its_camera_sees_it() -> None:
    points, truth = synthetic_excavator.record(200, 0)
    steps = np.linalg.norm(np.diff(truth, axis=0), axis=2)
    assert steps.max() < 1.5  # metres in a tenth of a second, of the bucket's tip
    assert truth.std(0).mean() > 0.3
    assert (points > 0).all() and (points < [1280, 720]).all()
    without_noise = truth[..., :2] / (truth[..., 2:] + synthetic_excavator.DISTANCE)
    noise = 1000 * (synthetic_excavator.CAMERA.rays(points) - without_noise)
    assert abs(noise.std() - synthetic_excavator.NOISE) < 0.1


def test_the_seed_fixes_the_work() -> None:
    first, again, other = (synthetic_excavator.record(20, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.points, again.points)
    assert np.abs(first.points - other.points).max() > 10
