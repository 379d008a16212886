"""The similarity of linear combinations in patches, against least squares patch by patch and differences."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayesreg.image import Image
from bayesreg.model.observations.images.linear_combination import FREEDOM, RIDGE, regression_at
from bayesreg.model.observations.images.pointwise import Intensities

RNG = np.random.default_rng(0)
AFFINE = np.diag([2.0, 2.0, 2.0, 1.0])
FIXED = Image(np.cumsum(RNG.normal(size=(14, 14, 14)), axis=0), AFFINE).interpolator("cubic")
POSITIONS = RNG.uniform(2, 24, size=(400, 3))
MOVING = jnp.asarray(RNG.normal(size=400))
REGRESSION = regression_at(POSITIONS, FIXED, 12.0, jnp.asarray(1.0))
ONE = jnp.ones(())
SHARES = jnp.asarray(RNG.uniform(0, 1, size=400))


def pair(moving=MOVING, shares=None):
    return Intensities(FIXED(jnp.asarray(POSITIONS)), moving, jnp.full(400, 8.0), shares)


def expected(moving, shares):
    """Least squares with numpy in every patch."""
    slopes = np.array([np.linalg.norm(jax.grad(FIXED)(x)) for x in jnp.asarray(POSITIONS)])
    functions = np.stack([np.asarray(FIXED(jnp.asarray(POSITIONS))), slopes], axis=1)
    functions = (functions - functions.mean(axis=0)) / functions.std(axis=0)
    log, floor = 0.0, float(REGRESSION.floor)
    for patch in range(REGRESSION.patches.number):
        chosen = np.asarray(REGRESSION.patches.label) == patch
        m, w, F = np.asarray(moving)[chosen], np.asarray(shares)[chosen], functions[chosen]
        centred_m, centred_F = m - np.average(m, weights=w), F - np.average(F, axis=0, weights=w)
        rows = np.concatenate([np.sqrt(w)[:, None] * centred_F, np.sqrt(RIDGE * w.sum()) * np.eye(2)])
        goal = np.concatenate([np.sqrt(w) * centred_m, np.zeros(2)])
        left = ((goal - rows @ np.linalg.lstsq(rows, goal, rcond=None)[0]) ** 2).sum()
        whole = (w * centred_m**2).sum()
        log += (FREEDOM + w.sum() - 1) / 2 * np.log((floor + whole) / (floor + left))
    return log


@pytest.mark.parametrize("shares", [None, SHARES])
def test_the_energy_is_that_of_least_squares_in_every_patch(shares):
    weights = np.ones(400) if shares is None else SHARES
    assert float(REGRESSION.energy(pair(shares=shares), ONE)) == pytest.approx(-expected(MOVING, weights), rel=1e-10)


def test_gradients_equal_differences_in_values_and_shares():
    direction = jnp.asarray(RNG.normal(size=400))
    for energy, at in (
        (lambda m: REGRESSION.energy(pair(m, SHARES), ONE), MOVING),
        (lambda shares: REGRESSION.energy(pair(shares=shares), ONE), 0.2 + 0.6 * SHARES),
    ):
        difference = (energy(at + 1e-5 * direction) - energy(at - 1e-5 * direction)) / 2e-5
        assert float(jax.grad(energy)(at) @ direction) == pytest.approx(float(difference), rel=1e-6)


def of_all(curvature):
    """The matrix of a curvature."""
    shared, groups = curvature.shared, np.asarray(curvature.shared.groups)
    together = groups[:, None] == groups
    return np.diag(np.asarray(curvature.diagonal)) + sum(
        float(sign) * together * np.outer(v, v)
        for sign, v in zip(shared.signs, np.asarray(shared.vectors), strict=True)
    )


def test_the_curvature_is_the_hessian():
    hessian = jax.hessian(lambda m: REGRESSION.energy(pair(m, SHARES), ONE))(MOVING)
    np.testing.assert_allclose(of_all(REGRESSION.curvature(pair(shares=SHARES), ONE)), hessian, atol=1e-9)


def test_the_convexity_is_positive_and_ignores_what_a_linear_combination_explains():
    convexity = of_all(REGRESSION.convexity(pair(), ONE))
    assert np.linalg.eigvalsh(convexity).min() > -1e-9
    np.testing.assert_allclose(convexity @ np.ones(400), 0, atol=1e-9)


def test_any_linear_combination_is_as_good_in_every_patch():
    """f, |∇f| and a constant with other coefficients in each patch, without noise, up to the floor and the ridge."""
    coefficients = RNG.normal(size=(REGRESSION.patches.number, 3))[np.asarray(REGRESSION.patches.label)]
    combined = coefficients[:, 0] + (coefficients[:, 1:] * np.asarray(REGRESSION.functions)).sum(axis=1)
    fit = REGRESSION.fit(pair(jnp.asarray(combined)))
    assert float(fit.left.sum() / fit.whole.sum()) < 0.05


def test_a_patch_without_contrast_says_nothing():
    flat = 1e-4 * MOVING
    assert abs(float(REGRESSION.energy(pair(flat), ONE))) < 1e-3


def test_a_pair_that_is_not_seen_says_nothing():
    assert float(REGRESSION.energy(pair(shares=jnp.zeros(400)), ONE)) == pytest.approx(0, abs=1e-12)


def test_the_expected_slope_is_the_gradient_of_the_best_combination():
    fit = REGRESSION.fit(pair())

    def combined(shift):
        moved = regression_values(POSITIONS + shift)
        return (np.asarray(fit.coefficients) * (moved - regression_values(POSITIONS)) / sd()).sum(axis=1)

    expected = np.stack([(combined(1e-5 * e) - combined(-1e-5 * e)) / 2e-5 for e in np.eye(3)], axis=1)
    np.testing.assert_allclose(REGRESSION.expected_slope(pair()), expected, atol=1e-5)


def regression_values(places):
    """f and |∇f|."""
    values = FIXED(jnp.asarray(places))
    slopes = jnp.linalg.norm(jax.vmap(jax.grad(FIXED))(jnp.asarray(places)), axis=1)
    return np.stack([values, slopes], axis=1)


def sd():
    return regression_values(POSITIONS).std(axis=0)
