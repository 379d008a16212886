"""Chains solve less exactly than the density by itself: no acceptance, and no draw, may tell."""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from bayesreg.inference.gaussian.laplace import laplace
from bayesreg.inference.gaussian.whitened import setup_about
from bayesreg.inference.samplers.registry import choose_sampler
from tests.options import posterior_of
from tests.phantoms import ball_mesh, smooth_image

MESH = ball_mesh(spacing=24.0)


@cache
def posterior():
    """One image twice, so that the mode is at rest."""
    image = smooth_image(MESH.points, seed=1)
    return posterior_of(image, image, MESH, t_similarity=5.0, t_elastic=100.0, interpolation="cubic", rigid_sd=2.0)


def test_the_density_of_chains_is_the_density_to_a_hundredth():
    post = posterior()
    conditioned = post.target.condition(post.estimands(post.reference()))
    for seed in range(5):
        rng = np.random.default_rng(seed)
        values = post.reference() | {"u_boundary": jnp.asarray(0.3 * rng.normal(size=(len(MESH.boundary), 3)))}
        values |= {name: values[name] * np.exp(0.4 * rng.normal(size=3)) for name in ("lam", "mu")}
        exact, near = (
            post.target.evaluate_estimands(data, post.estimands(values)) for data in (post.data, conditioned)
        )
        assert near.solver_iterations < exact.solver_iterations
        assert 0 < abs(near.logdensity - exact.logdensity) < 0.01


@cache
def chains():
    """Data conditioned for chains, and (data) → where 60 transitions of 4 chains lead, and how probably they go."""
    post, count = posterior(), 4
    estimands = post.estimands(post.reference())
    flat = np.asarray(ravel_pytree(post.target.coordinates.unconstrain(post.data, estimands))[0])
    setup = setup_about(post.target, laplace(post.target, flat), flat)._replace(
        step_size=jnp.asarray(0.3), steps=jnp.asarray(5)
    )
    kernel = choose_sampler("hmc", post.target).sampler

    @jax.jit
    def draws(data):
        def step(states, keys):
            states, info = jax.vmap(partial(kernel.step, data, setup))(keys, states)
            return states, (states.position, info.acceptance_rate)

        states = jax.vmap(lambda _: kernel.init(data, setup, estimands))(jnp.arange(count))
        return jax.lax.scan(step, states, jax.random.split(jax.random.key(0), (60, count)))[1]

    return post.target.condition(estimands), draws


def with_tolerances(data, solve, slope):
    system = data.body.system
    tolerances = {"tolerance": system.tolerance / solve, "adjoint_tolerance": system.adjoint_tolerance / slope}
    return data._replace(body=data.body._replace(system=system._replace(**tolerances)))


@pytest.mark.long
def test_solves_a_hundred_times_as_exact_give_the_same_draws():
    conditioned, draws = chains()
    sampled, rate = draws(conditioned)
    expected, _ = draws(with_tolerances(conditioned, 100, 1))
    assert 0.5 < rate.mean() < 0.999
    # In standard deviations of the reference.
    assert 0 < abs(sampled - expected).max() < 0.01


@pytest.mark.long
def test_slopes_a_million_times_as_exact_are_accepted_no_more_often():
    """A slope only proposes: what it is off by may cost acceptance, and does not."""
    conditioned, draws = chains()
    (sampled, rate), (exact, best) = draws(conditioned), draws(with_tolerances(conditioned, 1, 1e6))
    # After one transition, before what is rounding to a trajectory grows.
    assert 0 < abs(sampled[0] - exact[0]).max() < 0.01
    assert abs(rate.mean() - best.mean()) < 0.01


def test_steps_of_the_papers_kernel_are_as_probable_as_exact_ones():
    """Its solves begin at the chain's present displacement, and end as early as those of the others."""
    post, count = posterior(), 200
    kernel = choose_sampler("rwmh", post.target, sigma_u=0.05).sampler
    start = post.estimands(post.reference())
    near = kernel.data(start)
    exact = with_tolerances(near, 1e4, 1)

    def step(state, key):
        transition, expected = (kernel.step(data, start, key, state) for data in (near, exact))
        return transition[0], (transition[1].acceptance_rate, expected[1].acceptance_rate)

    keys = jax.random.split(jax.random.key(0), count)
    acceptance, expected = jax.jit(lambda state: jax.lax.scan(step, state, keys))(kernel.init(near, start, start))[1]
    assert 0.1 < expected.mean() < 0.9
    assert 0 < abs(acceptance - expected).max() < 0.01
