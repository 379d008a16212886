"""A costly normaliser kept out of trajectories: its stand-in, and that the draws are of the true density anyway."""

from __future__ import annotations

from functools import cache
from math import comb

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayesreg as br
from bayesreg.inference.chains.initialise import starting_points
from bayesreg.inference.deadline import NEVER
from bayesreg.inference.gaussian.density import log_normaliser_at, mark_normaliser
from bayesreg.inference.gaussian.laplace import Gaussian
from bayesreg.inference.gaussian.normaliser import (
    REACH,
    TOGETHER,
    Delayed,
    StandIn,
    delay_acceptance,
    make_stand_in,
    no_stand_in,
    smooth_coordinates,
)
from bayesreg.inference.gaussian.whitened import setup_about
from bayesreg.inference.kernel import Info, joined
from bayesreg.inference.layout import slices
from bayesreg.inference.samplers.hamiltonian import hmc
from bayesreg.inference.samplers.settings import Hmc
from tests.options import posterior_of
from tests.phantoms import box_mesh, smooth_image

MESH = box_mesh(2)


@pytest.fixture(autouse=True)
def costly(monkeypatch):
    """A mesh of few nodes treated like one of many."""
    monkeypatch.setattr("bayesreg.model.target.CHEAP_NODES", 0)


@cache
def posterior():
    images = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    return posterior_of(
        *images,
        MESH,
        normalised=True,
        interpolation="cubic",
        priors={name: {"high": 20.0} for name in ("lam", "mu")},
        t_elastic=30.0,
        t_similarity=5.0,
        rigid_sd=1.0,
    )


def flat_of(post):
    return np.asarray(jax.flatten_util.ravel_pytree(post.unconstrain(post.reference()))[0])


def test_the_stand_in_is_close_to_the_normaliser_over_many_standard_deviations():
    """Also where the first Lamé parameters, small already, are next to nothing."""
    post = posterior()
    flat = np.array(flat_of(post))
    flat[slices(post.target)["lam"]] = -3.0
    stand_in = make_stand_in(post.target, Gaussian(jnp.asarray(flat), 0.3 * jnp.eye(len(flat))), flat)
    entries = np.flatnonzero(mark_normaliser(post.target))
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20, len(entries)))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    places = np.tile(flat, (21, 1))
    places[:20, entries] += 0.3 * REACH * rng.uniform(size=20)[:, None] * directions
    places[20, np.arange(len(flat))[slices(post.target)["lam"]]] = -8.0
    expected = np.array([float(log_normaliser_at(post.target, post.data, place)) for place in places])
    error = expected - [
        float(stand_in(smooth_coordinates(post.target, post.data, jnp.asarray(place)))) for place in places
    ]
    error -= error[:20].mean()
    assert expected[:20].std() > 5
    assert error[:20].std() < 0.1
    assert abs(error[20]) < 0.3


def test_beyond_where_it_was_fitted_the_stand_in_is_linear():
    post = posterior()
    flat = flat_of(post)
    stand_in = make_stand_in(post.target, Gaussian(jnp.asarray(flat), 0.3 * jnp.eye(len(flat))), flat)
    direction = stand_in.unit / np.sqrt(len(stand_in.unit))
    near, beyond, far = (float(stand_in(stand_in.centre + scale * stand_in.reach * direction)) for scale in (1, 2, 3))
    assert beyond - near == pytest.approx(far - beyond, rel=1e-9)


def test_many_parameters_have_a_stand_in_of_lower_degree(monkeypatch):
    post = posterior()
    count, flat = len(no_stand_in(post.target).centre), flat_of(post)
    for degree in (3, 2, 1):
        monkeypatch.setattr("bayesreg.inference.gaussian.normaliser.MOST_TERMS", comb(count + degree, degree))
        assert no_stand_in(post.target).factors.shape == (comb(count + degree, degree), degree)
    stand_in = make_stand_in(post.target, Gaussian(jnp.asarray(flat), 0.02 * jnp.eye(len(flat))), flat)
    step = np.zeros(len(flat))
    step[np.flatnonzero(mark_normaliser(post.target))] = 0.02
    true, approximate = (
        float(of(flat + step) - of(flat - step))
        for of in (
            lambda x: log_normaliser_at(post.target, post.data, x),
            lambda x: stand_in(smooth_coordinates(post.target, post.data, jnp.asarray(x))),
        )
    )
    assert approximate == pytest.approx(true, rel=0.02)


def log_normaliser(data, flat):
    return 1.5 * jnp.sin(2 * flat[0])


@pytest.mark.parametrize("coefficients", [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.5, 1.0, 0.15)])
def test_draws_are_of_the_density_with_the_normaliser(coefficients):
    """Whatever the stand-in: against sums over a grid."""
    factors = jnp.array([[0, 0], [0, 1], [1, 1]])
    approximate = StandIn(jnp.zeros(1), jnp.ones(1), jnp.array(5.0), factors, jnp.array(coefficients))
    kernel = blackjax.additive_step_random_walk(
        lambda x: -0.5 * (x @ x) + approximate(x), blackjax.mcmc.random_walk.normal(jnp.array([1.5]))
    )

    def step(data, setup, key, state):
        state, info = kernel.step(key, state)
        no = jnp.zeros((), bool)
        return state, Info(info.acceptance_rate, no, no, no, no, no, no)

    def stand_in(data, setup, flat):
        return approximate(flat)

    def move(data, setup, key, state):
        return step(data, setup, key, state)[0]

    whole_step = delay_acceptance(step, move, lambda setup, state: state.position, log_normaliser, stand_in)

    def chain(key):
        first = kernel.init(jnp.zeros(1))
        state = Delayed(first, log_normaliser(None, jnp.zeros(1)))
        _, positions = jax.lax.scan(
            lambda state, key: (lambda new: (new, new.kernel.position[0]))(whole_step(None, None, key, state)[0]),
            state,
            jax.random.split(key, 2100),
        )
        return positions[100:]

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
    """With random loads, whose normaliser depends on hyperparameters that move alone."""
    images = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    scale = br.ScalePrior(median=0.1, log_sd=3.0)
    priors = {name: {"high": 20.0} for name in ("lam", "mu")}
    post = posterior_of(*images, MESH, priors=priors, body_load=scale, surface_load=scale)
    sampler = hmc(post.target, Hmc())
    estimands = post.estimands(post.reference())
    flat = jax.flatten_util.ravel_pytree(post.target.coordinates.unconstrain(post.data, estimands))[0]
    gaussian = Gaussian(flat, 0.002 * jnp.eye(len(flat)))
    setup = setup_about(post.target, gaussian, flat)
    setup = setup._replace(stand_in=make_stand_in(post.target, gaussian, flat), step_size=jnp.asarray(0.3))

    @jax.jit
    def moved(data, setup, key):
        def step(states, keys):
            states, info = jax.vmap(lambda key, state: sampler.step(data, setup, key, state))(keys, states)
            return states, info.gradients

        states = jax.vmap(lambda key: sampler.init(data, setup, estimands))(jax.random.split(key, 2))
        states, gradients = jax.lax.scan(step, states, jax.random.split(key, (3, 2)))
        return jax.vmap(lambda state: sampler.observe(data, setup, state))(states), gradients

    observed, gradients = moved(sampler.data(setup), setup, jax.random.key(0))
    # Those of trajectories of one step.
    assert (gradients == TOGETHER).all()
    expected = jax.vmap(lambda estimands: post.target.evaluate_estimands(post.data, estimands).logdensity)(
        observed.estimands
    )
    np.testing.assert_allclose(observed.evaluation.logdensity, expected, rtol=1e-9)
    for name in ("u_boundary", "surface_load"):
        assert (observed.estimands[name] != estimands[name]).reshape(2, -1).any(axis=1).all()


@pytest.mark.long
@pytest.mark.slow
def test_the_stand_in_is_close_to_the_normaliser_where_the_warm_up_ends():
    post = posterior()
    points = starting_points(post.target, br.Start(), 2, jax.random.key(0))
    setup, _ = hmc(post.target, Hmc(warm_up=2)).prepare(points, jax.random.key(1), NEVER)
    sd = np.linalg.norm(np.asarray(setup.gaussian.factor), axis=1) * mark_normaliser(post.target)
    places = np.asarray(setup.middle) + sd * np.random.default_rng(0).normal(size=(10, len(sd)))
    true, approximate = (
        np.array([float(of(post.target, post.data, jnp.asarray(place))) for place in places])
        for of in (log_normaliser_at, lambda *arguments: setup.stand_in(smooth_coordinates(*arguments)))
    )
    assert true.std() > 1
    assert (true - approximate).std() < 0.05


def test_the_reports_of_two_transitions_are_joined():
    rates, flags, counts = jnp.array([0.5, 1.0]), jnp.array([False, True]), jnp.array([3, 4])
    infos = [Info(rates[k], flags[k], ~flags[k], counts[k], flags[0], counts[k], 0 * counts[k]) for k in range(2)]
    joint = joined(*infos)
    assert joint.acceptance_rate == 1.5
    assert (bool(joint.outside_support), bool(joint.solver_failed), bool(joint.diverging)) == (True, True, False)
    assert (int(joint.solver_iterations), int(joint.gradients), int(joint.densities)) == (7, 7, 0)
