"""Scales whose evidence is known.

Of a field y_i = sd z_i + σ e_i, marginally N(0, sd² + σ²), and of displacements y_i = u_i + σ e_i with precisions
p_i / T_r, marginally N(0, T_r / p_i + σ²).
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize_scalar

from bayesreg.inference.gaussian.hierarchy import balance_field, balance_temperature, is_scale

COUNT, NOISE = 100, 0.5


class Field:
    """What `balance_field` asks of a target; flat positions are field, field_sd, lam."""

    def __init__(self, **position):
        self.position = position

    data = None

    @property
    def coordinates(self):
        return self

    def reference(self):
        return self.position

    def unconstrain(self, data, estimands):
        return estimands

    def constrain(self, data, position):
        return position, 0.0

    def least_curvature(self, data, position):
        return position


TARGET = Field(field=np.zeros(COUNT), field_sd=np.array(0.0), lam=np.zeros(2))


def given_scale(y, sd):
    """The mode of z, and a covariance of (z, log sd, λ) that is the exact one of z where sd is given."""
    z = sd * y / (sd**2 + NOISE**2)
    slope = np.append(-z, [1.0, 0.3, -0.2])
    own = np.append(np.full(COUNT, NOISE**2 / (sd**2 + NOISE**2)), [0.0, 0.5, 0.5])
    covariance = np.diag(own) + np.outer(slope, slope) * 0.01
    return np.concatenate([z, [np.log(sd)], [1.0, 2.0]]), np.linalg.cholesky(covariance + 1e-12 * np.eye(len(own)))


@pytest.mark.parametrize("first", [0.2, 5.0])
@pytest.mark.parametrize("truth", [0.5, 2.0])
def test_fixed_point_is_the_maximum_of_the_evidence(truth, first):
    rng = np.random.default_rng(0)
    y = truth * rng.normal(size=COUNT) + NOISE * rng.normal(size=COUNT)
    sd = first
    for _ in range(60):
        flat, factor = given_scale(y, sd)
        moved = balance_field(TARGET, flat, lambda factor=factor: factor)
        # The field stays, and so does what has nothing to do with it.
        np.testing.assert_allclose(np.exp(moved[COUNT]) * moved[:COUNT], sd * flat[:COUNT], rtol=1e-10)
        np.testing.assert_array_equal(moved[COUNT + 1 :], [1.0, 2.0])
        sd = float(np.exp(moved[COUNT]))
    best = np.sqrt((y**2).mean() - NOISE**2)
    assert sd == pytest.approx(best, rel=0.03)


def test_without_a_field_nothing_is_asked_for():
    target = Field(lam=np.zeros(2), u_boundary=np.zeros((3, 3)))
    flat = np.arange(11.0)

    def never():
        raise AssertionError("no factor is needed")

    np.testing.assert_array_equal(balance_field(target, flat, never), flat)
    assert not is_scale(target).any()
    np.testing.assert_array_equal(np.flatnonzero(is_scale(TARGET)), [COUNT])


@pytest.mark.parametrize("first", [1e-4, 1e3])
@pytest.mark.parametrize("truth", [0.2, 3.0])
def test_a_temperature_comes_to_the_maximum_of_its_evidence(truth, first):
    """From far below, where the joint mode lies, and from far above."""
    rng = np.random.default_rng(0)
    precision = 10 ** rng.uniform(-1, 2, COUNT)
    y = np.sqrt(truth / precision) * rng.normal(size=COUNT) + NOISE * rng.normal(size=COUNT)
    target = Field(t_elastic=np.array(0.0), lam=np.zeros(2))
    log_t = np.log(first)
    for _ in range(60):
        prior = precision / np.exp(log_t)
        mode = y / (1 + NOISE**2 * prior)
        energy, shares = 0.5 * (prior * mode**2).sum(), np.diag(prior / (prior + NOISE**-2))
        moved = balance_temperature(target, np.array([1.0, 2.0, log_t]), energy - COUNT / 2, energy, shares)
        np.testing.assert_array_equal(moved[:2], [1.0, 2.0])
        log_t = moved[2]

    def evidence(log_t):
        return stats.norm.logpdf(y, scale=np.sqrt(np.exp(log_t) / precision + NOISE**2)).sum()

    best = minimize_scalar(lambda log_t: -evidence(log_t), bounds=(-12, 8), method="bounded").x
    assert log_t == pytest.approx(best, abs=1e-3)
