"""Draws of the exact density from kernels that see a surrogate of it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayesreg as br
from bayesreg.inference.gaussian.delayed_acceptance import TOGETHER, Delayed, Exact, delay_acceptance
from bayesreg.inference.gaussian.laplace import Gaussian
from bayesreg.inference.gaussian.normaliser import make_stand_in
from bayesreg.inference.gaussian.whitened import setup_about, surrogate_density
from bayesreg.inference.kernel import Info, joined
from bayesreg.inference.layout import unravel
from bayesreg.inference.samplers.hamiltonian import hmc
from bayesreg.inference.samplers.settings import Hmc
from bayesreg.inference.target import logdensity
from tests.options import posterior_of
from tests.phantoms import box_mesh, smooth_image

MESH = box_mesh(2)


CORRELATION = 0.95


@pytest.mark.parametrize("bend", [0.0, 0.5])
def test_draws_are_of_the_exact_density(bend):
    """Whatever the surrogate: a correlated Gaussian times a factor, against sums over a grid.

    A step draws x given y from the surrogate, and a move draws y given x. Only a palindrome of both is reversible.
    """
    sd = np.sqrt(1 - CORRELATION**2)

    def factor(x, y):
        return 1.5 * jnp.sin(2 * x) * bend + bend * jnp.cos(y)

    def draw_x(key, state):
        no = jnp.zeros((), bool)
        x = CORRELATION * state[1] + sd * jax.random.normal(key)
        return jnp.stack([x, state[1]]), Info(jnp.ones(()), no, no, no, no, no, no)

    def draw_y(key, state):
        return jnp.stack([state[0], CORRELATION * state[0] + sd * jax.random.normal(key)])

    def evaluate(state):
        return Exact(None, factor(*state))

    def chain(key):
        def transition(state, key):
            state, _ = delay_acceptance(draw_x, draw_y, evaluate, key, state)
            return state, state.kernel

        first = jnp.zeros(2)
        _, states = jax.lax.scan(transition, Delayed(first, evaluate(first)), jax.random.split(key, 2100))
        return states[100:]

    draws = np.asarray(jax.jit(jax.vmap(chain))(jax.random.split(jax.random.key(0), 256)))
    x, y = np.meshgrid(*[np.linspace(-6, 6, 601)] * 2, indexing="ij")
    weights = np.exp(-0.5 * (x**2 - 2 * CORRELATION * x * y + y**2) / sd**2 + np.asarray(factor(x, y)))
    weights /= weights.sum()
    for function in (lambda x, y: np.sin(x), lambda x, y: y, lambda x, y: x * y, lambda x, y: (x - y) ** 2):
        per_chain = function(draws[..., 0], draws[..., 1]).mean(axis=1)
        error = per_chain.std(ddof=1) / np.sqrt(len(per_chain))
        assert abs(per_chain.mean() - (weights * function(x, y)).sum()) < 4.5 * error
        assert error < 0.02


@pytest.mark.long
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
        return states, jax.vmap(lambda state: sampler.observe(data, setup, state))(states), gradients

    data = sampler.data(setup)
    states, observed, gradients = moved(data, setup, jax.random.key(0))
    # Those of trajectories of one step.
    assert (gradients == TOGETHER).all()
    expected = jax.vmap(lambda estimands: post.target.evaluate_estimands(post.data, estimands).logdensity)(
        observed.estimands
    )
    np.testing.assert_allclose(observed.evaluation.logdensity, expected, rtol=1e-9)
    flats = jax.vmap(setup.gaussian.place)(states.kernel.position)
    exact = jax.vmap(lambda flat: logdensity(post.target, post.data, unravel(post.target)(flat)))(flats)
    surrogate = jax.vmap(lambda flat: surrogate_density(post.target, data.surrogate, setup, flat))(flats)
    np.testing.assert_allclose(states.exact.log_ratio, exact - surrogate, atol=1e-3)
    assert jnp.ptp(exact - surrogate) > 0.01
    for name in ("u_boundary", "surface_load"):
        assert (observed.estimands[name] != estimands[name]).reshape(2, -1).any(axis=1).all()


def test_the_reports_of_two_transitions_are_joined():
    rates, flags, counts = jnp.array([0.5, 1.0]), jnp.array([False, True]), jnp.array([3, 4])
    infos = [Info(rates[k], flags[k], ~flags[k], counts[k], flags[0], counts[k], 0 * counts[k]) for k in range(2)]
    joint = joined(*infos)
    assert joint.acceptance_rate == 1.5
    assert (bool(joint.outside_support), bool(joint.solver_failed), bool(joint.diverging)) == (True, True, False)
    assert (int(joint.solver_iterations), int(joint.gradients), int(joint.densities)) == (7, 7, 0)
