"""Draws of the exact density from kernels that see a surrogate of it."""

from __future__ import annotations

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayesreg as br
from bayesreg.inference.gaussian.delayed_acceptance import TOGETHER, Delayed, Exact, delay_acceptance
from bayesreg.inference.gaussian.laplace import Gaussian
from bayesreg.inference.gaussian.normaliser import StandIn, make_stand_in
from bayesreg.inference.gaussian.whitened import setup_about
from bayesreg.inference.kernel import Draw, Info, joined
from bayesreg.inference.samplers.hamiltonian import hmc
from bayesreg.inference.samplers.settings import Hmc
from tests.options import posterior_of
from tests.phantoms import box_mesh, smooth_image

MESH = box_mesh(2)


@pytest.mark.parametrize("coefficients", [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.5, 1.0, 0.15)])
def test_draws_are_of_the_exact_density(coefficients):
    """Whatever the surrogate: against sums over a grid."""
    factors = jnp.array([[0, 0], [0, 1], [1, 1]])
    stand_in = StandIn(jnp.zeros(1), jnp.ones(1), jnp.array(5.0), factors, jnp.array(coefficients))
    kernel = blackjax.additive_step_random_walk(
        lambda x: -0.5 * (x @ x) + stand_in(x), blackjax.mcmc.random_walk.normal(jnp.array([1.5]))
    )

    def step(key, state):
        state, info = kernel.step(key, state)
        no = jnp.zeros((), bool)
        return state, Info(info.acceptance_rate, no, no, no, no, no, no)

    def move(key, state):
        return step(key, state)[0]

    def evaluate(state):
        x = state.position
        return Exact(Draw({"x": x[0]}, None), -0.5 * (x @ x) + 1.5 * jnp.sin(2 * x[0]) - state.logdensity)

    def chain(key):
        def transition(state, key):
            state, _ = delay_acceptance(step, move, evaluate, key, state)
            return state, state.exact.draw.estimands["x"]

        first = kernel.init(jnp.zeros(1))
        _, positions = jax.lax.scan(transition, Delayed(first, evaluate(first)), jax.random.split(key, 2100))
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


def test_a_chain_knows_the_exact_density_where_it_stands(monkeypatch):
    """With random loads, whose normaliser depends on hyperparameters that move alone, on few nodes treated as many."""
    monkeypatch.setattr("bayesreg.model.target.CHEAP_NODES", 0)
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


def test_the_reports_of_two_transitions_are_joined():
    rates, flags, counts = jnp.array([0.5, 1.0]), jnp.array([False, True]), jnp.array([3, 4])
    infos = [Info(rates[k], flags[k], ~flags[k], counts[k], flags[0], counts[k], 0 * counts[k]) for k in range(2)]
    joint = joined(*infos)
    assert joint.acceptance_rate == 1.5
    assert (bool(joint.outside_support), bool(joint.solver_failed), bool(joint.diverging)) == (True, True, False)
    assert (int(joint.solver_iterations), int(joint.gradients), int(joint.densities)) == (7, 7, 0)
