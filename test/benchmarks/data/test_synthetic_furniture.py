# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.data.synthetic_furniture import CATEGORIES

Maker = Callable[[np.random.Generator, int], np.ndarray]


@pytest.mark.parametrize("make", CATEGORIES.values(), ids=CATEGORIES.keys())
def test_furniture_stands_on_its_feet_and_is_symmetric(make: Maker) -> None:
    S = make(np.random.default_rng(0), 50)
    assert S.shape[0] == 50
    assert S[..., 2].min() >= 0
    np.testing.assert_array_equal(S[:, ::2] * [-1, 1, 1], S[:, 1::2])


@pytest.mark.parametrize("make", CATEGORIES.values(), ids=CATEGORIES.keys())
def test_furniture_varies_and_its_seed_fixes_it(make: Maker) -> None:
    S, again, other = (make(np.random.default_rng(seed), 20) for seed in (0, 0, 1))
    np.testing.assert_array_equal(S, again)
    assert np.abs(S - other).max() > 0.05
    spread = np.linalg.norm(S - S.mean(0)) / np.linalg.norm(S - S.mean(1, keepdims=True))
    assert spread > 0.1
