"""A costly normaliser kept out of trajectories: its stand-in, and that the draws are of the true density anyway."""

from __future__ import annotations

from functools import cache
from math import comb
from typing import NamedTuple

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayesreg as br
from bayesreg.inference.chains.initialise import starting_points
from bayesreg.inference.gaussian.density import log_normaliser_at
from bayesreg.inference.gaussian.laplace import Gaussian
from bayesreg.inference.gaussian.normaliser import (
    REACH,
    Delayed,
    StandIn,
    delay_acceptance,
    make_stand_in,
    no_stand_in,
)
from bayesreg.inference.gaussian.whitened import setup_about
from bayesreg.inference.kernel import Info
from bayesreg.inference.samplers.hamiltonian import hmc
from bayesreg.inference.samplers.settings import Hmc
from bayesreg.inference.target import estimands_of
from tests.phantoms import box_mesh, smooth_image

MESH = box_mesh(2)


@pytest.fixture(autouse=True)
def costly(monkeypatch):
    """A mesh of few nodes treated like one of many."""
    monkeypatch.setattr("bayesreg.model.posterior.CHEAP_NODES", 0)


@cache
def posterior():
    images = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    model = br.ModelConfig(
        normalised=True,
        interpolation="cubic",
        priors={name: {"high": 20.0} for name in ("lam", "mu")},
        t_elastic=30.0,
        t_similarity=5.0,
        rigid_sd=1.0,
    )
    return br.build_posterior(*images, MESH, model=model)


def test_the_stand_in_is_close_to_the_normaliser_over_many_standard_deviations():
    """Far closer than a polynomial of second degree would be, with a constant slope beyond."""
    post = posterior()
    position = post.unconstrain(post.reference())
    flat = jax.flatten_util.ravel_pytree(position)[0]
    found = make_stand_in(post, Gaussian(flat, 0.3 * jnp.eye(len(flat))), flat)
    count = len(flat) - 3 * len(post.sampled)
    np.testing.assert_array_equal(found.entries, np.arange(count))
    np.testing.assert_allclose(found.unit, 0.3)

    def true(x):
        away = flat.at[:count].add(x)
        estimands = estimands_of(post, post.data, jax.flatten_util.ravel_pytree(position)[1](away))
        return float(post.normaliser.log(post.data, estimands))

    def approximate(x):
        return float(found(jnp.zeros(len(flat)).at[:count].set(x)))

    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20, count))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    places = 0.3 * REACH * rng.uniform(size=20)[:, None] * directions
    expected = np.array([true(x) for x in places])
    error = expected - np.array([approximate(x) for x in places])
    assert error.std() < 0.02 * expected.std()
    step = 0.3 * directions[0]
    beyond = [approximate(scale * step) for scale in (REACH, REACH + 1, REACH + 2)]
    assert beyond[1] - beyond[0] == pytest.approx(beyond[2] - beyond[1], rel=1e-9)


def test_many_parameters_have_a_stand_in_of_lower_degree(monkeypatch):
    post = posterior()
    count = len(no_stand_in(post).entries)
    for degree in (3, 2, 1):
        monkeypatch.setattr("bayesreg.inference.gaussian.normaliser.MOST_TERMS", comb(count + degree, degree))
        found = no_stand_in(post)
        assert found.factors.shape == (comb(count + degree, degree), degree)
    flat = jax.flatten_util.ravel_pytree(post.unconstrain(post.reference()))[0]
    found = make_stand_in(post, Gaussian(flat, 0.1 * jnp.eye(len(flat))), flat)
    step = jnp.zeros(len(flat)).at[0].set(1e-4)
    ahead, behind = (log_normaliser_at(post, post.data, flat + sign * step) for sign in (1, -1))
    assert float(found(step) - found(-step)) == pytest.approx(float(ahead - behind), rel=1e-5)


class Setup(NamedTuple):
    middle: jax.Array
    stand_in: StandIn


def log_normaliser(data, flat):
    return 1.5 * jnp.sin(2 * flat[0])


@pytest.mark.parametrize("coefficients", [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.5, 1.0, 0.15)])
def test_draws_are_of_the_density_with_the_normaliser(coefficients):
    """Whatever the stand-in: against sums over a grid."""
    factors = jnp.array([[0, 0], [0, 1], [1, 1]])
    approximate = StandIn(jnp.array([0]), jnp.ones(1), factors, jnp.array(coefficients))
    setup = Setup(jnp.zeros(1), approximate)
    kernel = blackjax.additive_step_random_walk(
        lambda x: -0.5 * (x @ x) + approximate(x), blackjax.mcmc.random_walk.normal(jnp.array([1.5]))
    )

    def step(data, setup, key, state):
        state, info = kernel.step(key, state)
        no = jnp.zeros((), bool)
        return state, Info(info.acceptance_rate, no, no, no, no, no, no)

    whole_step = delay_acceptance(step, lambda setup, state: state.position, log_normaliser)

    def chain(key):
        first = kernel.init(jnp.zeros(1))
        state = Delayed(first, log_normaliser(None, jnp.zeros(1)))
        _, found = jax.lax.scan(
            lambda state, key: (lambda new: (new, new.kernel.position[0]))(whole_step(None, setup, key, state)[0]),
            state,
            jax.random.split(key, 2100),
        )
        return found[100:]

    draws = np.asarray(jax.jit(jax.vmap(chain))(jax.random.split(jax.random.key(0), 64)))
    x = np.linspace(-7, 7, 4001)
    weights = np.exp(-0.5 * x**2 + 1.5 * np.sin(2 * x))
    weights /= weights.sum()
    for function in (np.sin, np.cos, np.square):
        per_chain = function(draws).mean(axis=1)
        error = per_chain.std(ddof=1) / np.sqrt(len(per_chain))
        assert abs(per_chain.mean() - weights @ function(x)) < 4.5 * error
        assert error < 0.03


def test_a_chain_knows_the_whole_density_where_it_stands():
    post = posterior()
    sampler = hmc(post, Hmc())
    estimands = post.estimands(post.reference())
    flat = jax.flatten_util.ravel_pytree(post.coordinates.unconstrain(post.data, estimands))[0]
    gaussian = Gaussian(flat, 0.05 * jnp.eye(len(flat)))
    setup = setup_about(post, gaussian, flat, np.array([0, 5]))
    setup = setup._replace(stand_in=make_stand_in(post, gaussian, flat), step_size=jnp.asarray(0.3))

    @jax.jit
    def moved(data, setup, key):
        def step(states, keys):
            states, info = jax.vmap(lambda key, state: sampler.step(data, setup, key, state))(keys, states)
            return states, info.gradients

        states = jax.vmap(lambda key: sampler.init(data, setup, estimands))(jax.random.split(key, 2))
        states, gradients = jax.lax.scan(step, states, jax.random.split(key, (3, 2)))
        return jax.vmap(lambda state: sampler.observe(data, setup, state))(states), gradients

    found, gradients = moved(sampler.data(setup), setup, jax.random.key(0))
    # One of a trajectory of one step, one where two nodes were moved alone.
    assert (gradients == 2).all()
    expected = jax.vmap(lambda estimands: post.evaluate_estimands(post.data, estimands).logdensity)(found.estimands)
    np.testing.assert_allclose(found.evaluation.logdensity, expected, rtol=1e-9)
    assert (found.estimands["u_boundary"] != 0).any(axis=(1, 2)).all()


@pytest.mark.slow
def test_the_stand_in_is_about_the_centre_that_the_warm_up_ends_with():
    post = posterior()
    points = starting_points(post, br.Start(), 2, jax.random.key(0))
    setup, _ = hmc(post, Hmc(warm_up=2)).prepare(points, jax.random.key(1), lambda text: None)
    expected = make_stand_in(post, setup.gaussian, setup.middle)
    np.testing.assert_allclose(setup.stand_in.unit, expected.unit, rtol=1e-9)
    np.testing.assert_allclose(setup.stand_in.coefficients, expected.coefficients, rtol=1e-6, atol=1e-9)
