"""Scales whose evidence is known.

Of a field y_i = sd z_i + σ e_i, marginally N(0, sd² + σ²), and of displacements y_i = u_i + σ e_i with precisions
p_i / T_r, marginally N(0, T_r / p_i + σ²).
"""

from __future__ import annotations

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize

from bayesreg.inference.gaussian import hierarchy
from bayesreg.inference.gaussian.evidence import Expansion, evidence, evidence_curvature, maximise_evidence
from bayesreg.inference.gaussian.hierarchy import balance_field
from bayesreg.inference.layout import unravel

COUNT, NOISE = 100, 0.5
# Components of displacements.
MOVED = 99


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
    diagonal = np.append(np.full(COUNT, NOISE**2 / (sd**2 + NOISE**2)), [0.0, 0.5, 0.5])
    covariance = np.diag(diagonal) + np.outer(slope, slope) * 0.01
    return np.concatenate([z, [np.log(sd)], [1.0, 2.0]]), np.linalg.cholesky(covariance + 1e-12 * np.eye(len(diagonal)))


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


class Displaced:
    """A target of T_r, the noise σ and displacements u of the data y = u + σ e, without images."""

    data = hard_wall = normaliser = surrogate = prepare_marginal = variables = None

    def unused(self, *_):
        raise AssertionError("nobody asks for it")

    condition = supports = continuation = curvature = least_curvature = unused

    def __init__(self, precision, y):
        self.precision, self.y = jnp.asarray(precision), jnp.asarray(y)

    @property
    def coordinates(self):
        return self

    mode_search = coordinates
    hyperparameters = ("noise", "t_elastic")
    separable = followed = ()

    def reference(self):
        return {"noise": jnp.ones(()), "t_elastic": jnp.ones(()), "u_boundary": jnp.zeros((MOVED // 3, 3))}

    def unconstrain(self, data, estimands):
        return {name: x if name == "u_boundary" else jnp.log(x) for name, x in estimands.items()}

    def constrain(self, data, position):
        return {name: x if name == "u_boundary" else jnp.exp(x) for name, x in position.items()}, jnp.zeros(())

    def evaluate_estimands(self, data, estimands):
        prior, noise = self.precision / estimands["t_elastic"], estimands["noise"]
        u, logs = estimands["u_boundary"].ravel(), jnp.log(jnp.stack([estimands["t_elastic"], noise]))
        log_density = -prior @ u**2 / 2 + jnp.log(prior).sum() / 2 - ((self.y - u) ** 2).sum() / noise**2 / 2
        return SimpleNamespace(logdensity=log_density - len(u) * jnp.log(noise) - logs @ logs / 8)

    def quadratic_part(self, data):
        return data

    def quadratic_curvature(self, data, estimands, near):
        return np.diag(np.asarray(self.precision / estimands["t_elastic"] + estimands["noise"] ** -2.0))

    def quadratic_trace(self, data, near, covariance):
        return lambda estimands: np.vdot(covariance, self.quadratic_curvature(data, estimands, near))


@pytest.mark.parametrize("first", [1e-3, 1e3])
@pytest.mark.parametrize(("temperature", "noise"), [(0.2, 0.5), (3.0, 0.5), (1.0, 0.01), (0.3, 2.0)])
def test_scales_come_to_the_maximum_of_their_evidence(temperature, noise, first, monkeypatch):
    """T_r and the noise together, from far off: below lies the joint mode. Log-normal priors about 1, of sd 2."""
    # As many directions as displacements: the traces are exact.
    monkeypatch.setattr(hierarchy, "DIRECTIONS", MOVED)
    rng = np.random.default_rng(0)
    precision = 10 ** rng.uniform(-1, 2, MOVED)
    y = np.sqrt(temperature / precision) * rng.normal(size=MOVED) + noise * rng.normal(size=MOVED)

    def log_evidence(logs):
        variance = np.exp(logs[1]) / precision + np.exp(2 * logs[0])
        return stats.norm.logpdf(y, scale=np.sqrt(variance)).sum() + stats.norm.logpdf(logs, scale=2.0).sum()

    target = Displaced(precision, y)
    flat, maximum = np.append(np.log([first, first]), np.zeros(MOVED)), None
    for _ in range(10):
        maximum = maximise_evidence(target, flat, target.quadratic_curvature(None, *[at(target, flat)] * 2))
        flat = maximum.flat
        if maximum.greatest_change < 1e-3:
            break
    best = minimize(lambda logs: -log_evidence(logs), np.zeros(2), tol=1e-9).x
    np.testing.assert_allclose(flat[:2], best, atol=1e-2)
    prior, data = precision * np.exp(-flat[1]), np.exp(-2 * flat[0])
    np.testing.assert_allclose(flat[2:], data * y / (prior + data), rtol=1e-8)

    # The evidence itself, up to a constant, and its slope; at the maximum also its curvature.
    curvature = target.quadratic_curvature(None, *[at(target, flat)] * 2)
    about = Expansion(flat, np.arange(2), np.zeros((MOVED, MOVED)), np.zeros(len(flat)))
    heights = [
        evidence(target, about, best + step)[0] - log_evidence(best + step) for step in ([0, 0], [1, 0], [0, -1])
    ]
    np.testing.assert_allclose(heights, heights[0], rtol=1e-6)
    step, ways = 1e-3 * np.eye(2), [(1, 1), (-1, -1), (1, -1), (-1, 1)]
    slope = [(log_evidence(flat[:2] + e) - log_evidence(flat[:2] - e)) / 2e-3 for e in step]
    np.testing.assert_allclose(evidence(target, about, flat[:2])[1], slope, atol=1e-2)
    corners = [[sum(a * b * log_evidence(flat[:2] + a * e + b * f) for a, b in ways) for f in step] for e in step]
    expected = -np.array(corners) / (2 * 1e-3) ** 2
    np.testing.assert_allclose(evidence_curvature(target, about, curvature), expected, rtol=2e-3, atol=2e-2)


def at(target, flat):
    """The estimands of a flat position."""
    return target.constrain(None, unravel(target)(jnp.asarray(flat)))[0]
