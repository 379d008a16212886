"""Chains that start where the density is steep come home by steps of their own."""

from typing import Any, NamedTuple

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayesreg.inference.gaussian import about_gaussian
from bayesreg.inference.gaussian.laplace import laplace
from bayesreg.inference.gaussian.warm_up import FIRST_STEP, Tuning, _transition, tune, with_step_size
from bayesreg.inference.gaussian.whitened import Moved
from bayesreg.types import InputError
from tests.inference.gaussians import DIMENSION, NODES, GaussianTarget


class Steps(NamedTuple):
    step_size: Any = jnp.asarray(FIRST_STEP)
    steps: Any = jnp.asarray(1)


def density(z):
    """The tail of a log parameter: beyond a unit Gaussian, a wall whose curvature is e^z."""
    return -(z**2).sum() / 2 - jnp.exp(z[0])


class Walk:
    def init(self, data, setup, estimands):
        return blackjax.mcmc.hmc.init(estimands["u_boundary"], density)

    def step(self, data, setup, key, state):
        kernel = blackjax.mcmc.hmc.build_kernel()
        state, info = kernel(key, state, density, setup.step_size, jnp.ones(3), setup.steps)
        return state, Moved(info.acceptance_rate)

    def move_hyperparameters(self, data, setup, key, state):
        return state

    def estimands(self, data, setup, state):
        return {"u_boundary": state.position}


def test_a_chain_that_starts_where_it_is_steep_comes_home_if_it_has_a_step_of_its_own():
    starts = {"u_boundary": jnp.zeros((4, 3)).at[3, 0].set(9.0)}
    tuning = Tuning(60, 0.75, quarter_turns=True)
    outcomes = {}
    for apart in (True, False):
        setup, points = tune(None, Walk(), Steps(), starts, jax.random.key(0), tuning, per_chain=apart)
        outcomes[apart] = float(setup.step_size), float(points["u_boundary"][3, 0])
    assert outcomes[True][1] < 3
    # With one step for all it stands where it began, and the others pay for it.
    assert outcomes[False][1] == 9.0
    assert outcomes[False][0] < outcomes[True][0]


def test_transitions_are_compiled_once():
    compiled = _transition._cache_size()
    tune(None, Walk(), Steps(), {"u_boundary": jnp.zeros((5, 3))}, jax.random.key(0), Tuning(4, 0.7))
    assert _transition._cache_size() == compiled + 1


class Stuck(Walk):
    """Chains that accept nothing."""

    def step(self, data, setup, key, state):
        return state, Moved(jnp.zeros(()))


def test_a_warm_up_that_accepts_nothing_names_the_cause():
    starts = {"u_boundary": jnp.zeros((4, 3))}
    with pytest.raises(InputError, match=r"accepts 0.0% of its transitions.*the pose and the mask"):
        tune(None, Stuck(), Steps(), starts, jax.random.key(0), Tuning(20, 0.75, quarter_turns=True))


@pytest.mark.parametrize("size", [0.011, 0.3, 0.46, 0.53, 0.79, 1.2, 1.5, 1.6, 4.0])
def test_steps_make_a_quarter_turn_and_none_is_too_long(size):
    setup = with_step_size(Tuning(60, 0.75, quarter_turns=True), Steps(), jnp.asarray(size))
    assert float(setup.step_size * setup.steps) == pytest.approx(np.pi / 2)
    assert setup.step_size <= size
    assert (setup.steps - 1) * size < np.pi / 2
    alone = with_step_size(Tuning(60, 0.75), Steps(), jnp.asarray(size))
    assert (float(alone.step_size), int(alone.steps)) == (min(size, np.pi / 2), int(Steps().steps))


def test_a_place_without_a_slope_has_no_part_in_the_reference():
    class Broken(GaussianTarget):
        def height(self, data, u):
            return super().height(data, u) + jnp.sqrt(50 - u.max())

    target, mode = Broken(), np.zeros(DIMENSION)
    sound = jnp.asarray(target.exact_draws(np.random.default_rng(0), 3))
    lost = sound.at[1].set(jnp.array([-1.0, 60.0, 0.0]))
    gaussian = laplace(target, mode)
    setup = about_gaussian._setup_on_average(target, gaussian, mode, {"u_boundary": lost})
    expected = about_gaussian._setup_on_average(target, gaussian, mode, {"u_boundary": sound[jnp.array([0, 2])]})
    np.testing.assert_array_equal(setup.gaussian.centre, expected.gaussian.centre)
    np.testing.assert_array_equal(setup.middle, expected.middle)
    assert np.isfinite(setup.middle).all()


class Ledge(GaussianTarget):
    """A Gaussian that ends in a steep slope at a little way from the mode."""

    def height(self, data, u):
        return super().height(data, u) - 1e6 * jnp.maximum(jnp.abs(u.ravel()[0]) - 0.1, 0.0) ** 2


def test_chains_start_where_the_density_is_not_next_to_nothing():
    keys, mode = jax.random.split(jax.random.key(0), 8), np.zeros(DIMENSION)
    heights = {}
    for target in (GaussianTarget(), Ledge()):
        gaussian = laplace(target, mode)
        starts = jnp.stack([about_gaussian._scatter(target, gaussian, key)["u_boundary"] for key in keys])
        heights[type(target)] = np.array([float(target.height(target.data, u)) for u in starts])
        assert np.isfinite(heights[type(target)]).all()
        assert len(np.unique(np.asarray(starts)[:, 0, 0])) == 8
    # The curvature at the mode knows nothing of the slope: drawn from it, most chains would start far below.
    lowest = -about_gaussian.DEEPEST * DIMENSION
    assert heights[Ledge].min() > lowest + float(Ledge().height(Ledge().data, jnp.zeros((NODES, 3))))
    # A Gaussian itself is not narrowed.
    assert heights[GaussianTarget].mean() < -0.6 * DIMENSION
