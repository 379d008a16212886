"""Trajectories about a Gaussian: what every integrator must keep, and the energy error of the corrected one."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from blackjax.mcmc.integrators import IntegratorState

from bayesreg.inference.gaussian.rotation import corrected_rotation, rotation


def bent(x):
    """A Gaussian times a factor close to one."""
    return -0.5 * (x @ x) - 0.02 * jnp.cos(1.3 * x).sum() - 0.01 * (x**4).sum() / (1 + x @ x)


def run(density, x, p, steps, corrected=True, angle=np.pi / 2):
    """The position and the momentum at the end of a trajectory, and the energy that it gained."""
    state = IntegratorState(x, p, *jax.value_and_grad(density)(x))
    if corrected:
        end = corrected_rotation(jnp.asarray(steps))(density, None)(state, angle / steps)
    else:
        end = state
        for _ in range(steps):
            end = rotation()(density, None)(end, angle / steps)
    energies = [-each.logdensity + each.momentum @ each.momentum / 2 for each in (state, end)]
    return end.position, end.momentum, energies[1] - energies[0]


def places(count):
    return np.random.default_rng(0).normal(size=(count, 2, 3))


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_a_gaussian_is_rotated_exactly(steps):
    x, p = places(1)[0]
    position, momentum, gain = run(lambda x: -0.5 * (x @ x), jnp.asarray(x), jnp.asarray(p), steps, angle=0.7)
    np.testing.assert_allclose(position, np.cos(0.7) * x + np.sin(0.7) * p, atol=1e-14)
    np.testing.assert_allclose(momentum, np.cos(0.7) * p - np.sin(0.7) * x, atol=1e-14)
    assert abs(float(gain)) < 1e-14


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_a_trajectory_can_be_reversed_and_keeps_volumes(steps):
    x, p = (jnp.asarray(each) for each in places(1)[0])
    position, momentum, _ = run(bent, x, p, steps)
    back, opposite, _ = run(bent, position, -momentum, steps)
    np.testing.assert_allclose(back, x, atol=1e-13)
    np.testing.assert_allclose(opposite, -p, atol=1e-13)
    jacobian = jax.jacfwd(lambda xp: jnp.concatenate(run(bent, xp[:3], xp[3:], steps)[:2]))(jnp.concatenate([x, p]))
    assert float(jnp.linalg.det(jacobian)) == pytest.approx(1, abs=1e-12)


def test_one_step_is_a_whole_kick():
    x, p = (jnp.asarray(each) for each in places(1)[0])
    for corrected, plain in zip(run(bent, x, p, 1), run(bent, x, p, 1, corrected=False), strict=True):
        np.testing.assert_allclose(corrected, plain, rtol=1e-13)


def test_the_correction_makes_the_energy_error_one_order_smaller():
    """With twice as many steps, an error of order three falls to an eighth, not to a quarter."""
    starts = jnp.asarray(places(200))

    def error(steps, corrected):
        gains = jax.vmap(lambda start: run(bent, *start, steps, corrected)[2])(starts)
        return float(jnp.sqrt((gains**2).mean()))

    assert error(16, True) < 0.3 * error(16, False)
    assert error(8, False) / error(16, False) == pytest.approx(4, rel=0.1)
    assert error(8, True) / error(16, True) > 7
