# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from benchmarks.baselines.sparse import (
    Effort,
    Factors,
    _block_focuss,
    factorise,
    recover,
    sparse,
)
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.nrsfm.metrics import shape_errors

K, ACTIVE, FRAMES, POINTS = 5, 2, 100, 30


class Problem:
    """Shapes that are two of five Gaussian atoms, each frame from a random camera."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.atoms = centre(rng.standard_normal((K, POINTS, 3)))
        self.codes = np.zeros((FRAMES, K))
        for codes in self.codes:
            codes[rng.choice(K, ACTIVE, replace=False)] = rng.standard_normal(ACTIVE)
        self.shapes = np.einsum("fk,kpc->fpc", self.codes, self.atoms)
        self.cameras = random_cameras(FRAMES, rng).astype(float)
        self.points = self.shapes @ self.cameras

    def factors(self) -> Factors:
        """The true factorisation, each atom mixed by a matrix of its own."""
        T = np.random.default_rng(1).standard_normal((K, 3, 3))
        d = np.einsum("fk,fca,kce->fkae", self.codes, self.cameras, np.linalg.inv(T))
        return Factors(self.atoms @ T.swapaxes(1, 2), d)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return Problem()


@pytest.mark.parametrize("repaired", [True, False])
def test_cameras_and_codes_are_exact_if_the_factorisation_is(
    problem: Problem, repaired: bool
) -> None:
    factors = problem.factors()
    np.testing.assert_allclose(factors.images(), problem.points, atol=1e-9)
    S = recover(factors, problem.points, np.random.default_rng(2), repaired=repaired)
    # R and c of a frame are exact up to a common sign, which mirrors the frame.
    assert shape_errors(S, problem.shapes).shape < 1e-5


def test_factorisation_finds_the_blocks(problem: Problem) -> None:
    rng = np.random.default_rng(0)
    found = factorise(problem.points, K, ACTIVE, Effort(admm=300, ksvd=30), rng)
    assert ((found.d != 0).any((2, 3)).sum(1) == ACTIVE).all()
    assert np.linalg.norm(found.images() - problem.points) < 1e-2


@pytest.mark.parametrize(
    ("repaired", "focuss"), [(True, False), (False, False), (False, True), (True, True)]
)
def test_whole_method_is_exact_on_the_problem_that_it_is_made_for(
    problem: Problem, repaired: bool, focuss: bool
) -> None:
    effort = Effort(admm=300, ksvd=20 if focuss else 40)
    S = sparse(problem.points, K, ACTIVE, repaired=repaired, focuss=focuss, effort=effort)
    assert shape_errors(S, problem.shapes).shape < 0.01


def test_focuss_finds_codes_that_exist_and_leaves_no_more_blocks_than_asked(
    problem: Problem,
) -> None:
    rng = np.random.default_rng(0)
    Y = problem.points.transpose(1, 0, 2).reshape(POINTS, -1)
    D = np.linalg.qr(problem.atoms)[0].transpose(1, 0, 2)
    start = rng.standard_normal((K, 3, FRAMES, 2))
    for active in (ACTIVE, 1):
        X = _block_focuss(Y, D, active, start, ridge=1e-9)
        assert ((X != 0).any((1, 3)).sum(0) == active).all()
        left = np.linalg.norm(Y - D.reshape(POINTS, -1) @ X.reshape(3 * K, -1))
        assert (left < 1e-3 * np.linalg.norm(Y)) == (active == ACTIVE)


def test_repair_bears_noise_that_two_random_frames_do_not(problem: Problem) -> None:
    factors = problem.factors()
    noise = 0.05 * np.random.default_rng(3).standard_normal(factors.d.shape)
    noisy = factors._replace(d=factors.d + noise * (factors.d != 0))
    errors = {
        repaired: np.mean(
            [
                shape_errors(
                    recover(noisy, noisy.images(), np.random.default_rng(i), repaired=repaired),
                    problem.shapes,
                ).shape
                for i in range(3)
            ]
        )
        for repaired in (True, False)
    }
    assert errors[True] < 0.5 * errors[False]
