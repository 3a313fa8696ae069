# SPDX-License-Identifier: Apache-2.0
"""The factorisation of least nuclear norm."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.nrsfm.factorisation.block_matrix import least_nuclear_norm
from deep_nrsfm_ros.nrsfm.geometry import centre


def test_a_matrix_for_which_lapack_does_not_converge_is_decomposed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(0)
    rotations = np.linalg.qr(rng.standard_normal((12, 3, 3)))[0]
    shapes = rng.standard_normal((7, 3)) + 0.1 * rng.standard_normal((12, 7, 3))
    W = (centre(shapes) @ rotations)[..., :2]
    expected = least_nuclear_norm(W, rotations[..., :2].swapaxes(1, 2))
    svd = np.linalg.svd

    def fails(matrix: Any, *args: Any, **options: Any) -> Any:
        if matrix.shape == (12, 21):  # as it does for some matrices; not so for the transposed
            raise np.linalg.LinAlgError("SVD did not converge")
        return svd(matrix, *args, **options)

    monkeypatch.setattr(np.linalg, "svd", fails)
    found = least_nuclear_norm(W, rotations[..., :2].swapaxes(1, 2))
    np.testing.assert_allclose(found, expected, atol=1e-9)
