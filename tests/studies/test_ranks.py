"""The machinery of calibration on draws whose law is known."""

from __future__ import annotations

import numpy as np
import pytest

from studies.calibration import sbc

REPLICATIONS, QUANTITIES, DRAWS = 200, 12, 150
NAMES = tuple(f"q{k}" for k in range(QUANTITIES))


def found(truth_sd=1.0, shift=0.0, correlation=0.0, seed=0):
    """Ranks of N(shift, truth_sd²) among draws of a chain (autoregressive) whose law is N(0, 1)."""
    rng = np.random.default_rng(seed)
    truths = shift + truth_sd * rng.normal(size=(REPLICATIONS, QUANTITIES))
    draws = np.empty((DRAWS, REPLICATIONS, QUANTITIES))
    draws[0] = rng.normal(size=draws.shape[1:])
    for i in range(1, DRAWS):
        draws[i] = correlation * draws[i - 1] + np.sqrt(1 - correlation**2) * rng.normal(size=draws.shape[1:])
    return sbc._ranks(NAMES, truths, draws, np.ones(REPLICATIONS), rng)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_the_right_posterior_passes(correlation):
    ranks = found(correlation=correlation)
    verdict = sbc.verdict(ranks.place)
    assert verdict.passes
    assert np.median(ranks.ess) == pytest.approx(DRAWS * (1 - correlation) / (1 + correlation), rel=0.35)
    np.testing.assert_allclose(verdict.coverage.mean(axis=1), sbc.LEVELS, atol=0.03)


@pytest.mark.parametrize(("error", "pattern"), [({"truth_sd": 0.7}, "inside"), ({"truth_sd": 1.4}, "outside")])
def test_a_posterior_of_the_wrong_width_fails(error, pattern):
    verdict = sbc.verdict(found(**error).place)
    assert not verdict.passes
    assert (verdict.coverage.mean(axis=1) > sbc.LEVELS).all() == (pattern == "inside")


def test_a_shifted_posterior_fails():
    assert not sbc.verdict(found(shift=0.5).place).passes


def test_ranks_are_uniform_in_distribution():
    """p-values of right posteriors are themselves spread over (0, 1): the test keeps its level."""
    p = np.concatenate([sbc.verdict(found(seed=seed).place).histogram for seed in range(8)])
    assert 0.35 < p.mean() < 0.65
    assert (p < 0.1).mean() < 0.2
