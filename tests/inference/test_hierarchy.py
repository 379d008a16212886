"""Scales whose evidence is known.

Of a field y_i = sd z_i + σ e_i, marginally N(0, sd² + σ²), and of displacements y_i = u_i + σ e_i with precisions
p_i / T_r, marginally N(0, T_r / p_i + σ²).
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize

from bayesreg.inference.gaussian.hierarchy import (
    balance_field,
    newton_step,
    volume_of,
)

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


@pytest.mark.parametrize("first", [1e-3, 1e3])
@pytest.mark.parametrize(("temperature", "noise"), [(0.2, 0.5), (3.0, 0.5), (1.0, 0.01), (0.3, 2.0)])
def test_scales_come_to_the_maximum_of_their_evidence(temperature, noise, first):
    """T_r and the noise together, from far off: below lies the joint mode. Log-normal priors about 1, of sd 2."""
    rng = np.random.default_rng(0)
    precision = 10 ** rng.uniform(-1, 2, COUNT)
    y = np.sqrt(temperature / precision) * rng.normal(size=COUNT) + noise * rng.normal(size=COUNT)

    def evidence(logs):
        variance = np.exp(logs[0]) / precision + np.exp(2 * logs[1])
        return stats.norm.logpdf(y, scale=np.sqrt(variance)).sum() + stats.norm.logpdf(logs, scale=2.0).sum()

    logs = np.log([first, first])
    for _ in range(60):
        prior, data = precision * np.exp(-logs[0]), np.full(COUNT, np.exp(-2 * logs[1]))
        u = data * y / (prior + data)
        energies = np.array([prior @ u**2 / 2, data @ (y - u) ** 2 / 2])
        slope = np.array([energies[0] - COUNT / 2, 2 * energies[1] - COUNT]) - logs / 4
        own = np.diag([energies[0], 4 * energies[1]]) + np.eye(2) / 4
        cross = np.array([prior * u, -2 * data * (y - u)])
        derivatives = [(np.diag(-prior), np.diag(prior)), (np.diag(-2 * data), np.diag(4 * data))]
        volume = volume_of(np.diag(prior + data), derivatives)
        found = volume.curvature + own - cross @ volume.covariance @ cross.T
        logs = logs + newton_step(slope + volume.slope, found)
    best = minimize(lambda logs: -evidence(logs), np.zeros(2), tol=1e-9).x
    np.testing.assert_allclose(logs, best, atol=1e-3)

    # At the maximum this is the evidence's own curvature.
    step, ways = 1e-3 * np.eye(2), [(1, 1), (-1, -1), (1, -1), (-1, 1)]
    corners = [[sum(a * b * evidence(best + a * e + b * f) for a, b in ways) for f in step] for e in step]
    np.testing.assert_allclose(found, -np.array(corners) / (2 * 1e-3) ** 2, rtol=1e-3, atol=1e-3)
