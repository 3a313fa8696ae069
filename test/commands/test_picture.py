"""The demo's picture shows the truth beside what was lifted, however wrong that is."""

from __future__ import annotations

import numpy as np

from deep_nrsfm_ros.commands.demo.picture import _fit


def test_the_truth_is_as_large_as_a_shape_with_left_and_right_exchanged() -> None:
    truth = np.random.default_rng(0).standard_normal((12, 3))
    shape = 0.002 * truth * [-1, 1, -1] + 5
    found = _fit(truth, shape)
    np.testing.assert_allclose(found.mean(0), shape.mean(0))
    np.testing.assert_allclose(np.ptp(found[:, 1]), np.ptp(shape[:, 1]))
    np.testing.assert_allclose(_fit(truth, 3 * truth + 1), 3 * truth + 1)
