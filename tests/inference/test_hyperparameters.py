"""Moves of hyperparameters with the displacements fixed: their density by brute force, and what they keep."""

from __future__ import annotations

from functools import partial

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayesreg as br
from bayesreg.inference.gaussian.hyperparameters import mark_separable, move_hyperparameters
from bayesreg.inference.gaussian.laplace import Gaussian, laplace
from bayesreg.inference.gaussian.whitened import setup_about, whitened_density
from bayesreg.inference.layout import dimension, flat_position, slices, unravel
from bayesreg.inference.target import logdensity
from bayesreg.model.mode_search import ModeSearch
from bayesreg.model.options import PriorConfig
from tests.options import posterior_of
from tests.phantoms import LAM, MU, ball_mesh, smooth_image

MESH = ball_mesh(spacing=30.0)
PRIORS = {name: PriorConfig(high=60.0) for name in ("lam", "mu")}
WIDE = br.ScalePrior(median=0.1, log_sd=3.0)


LAM_OF, MU_OF = (dict(zip(MESH.names, values.tolist(), strict=True)) for values in (LAM, MU))
FIRST = MESH.names[0]
# λ and μ known, or the loads, the other λ and the other μ.
KNOWN_STIFFNESS = {"fixed": {"lam": LAM_OF, "mu": MU_OF}}
KNOWN_LOADS = {
    "fixed": {name: {k: v for k, v in known.items() if k != FIRST} for name, known in (("lam", LAM_OF), ("mu", MU_OF))},
    "body_load": 0.3,
    "surface_load": 0.7,
}
LOADS = {"body_load": WIDE, "surface_load": WIDE}


def posterior(**options):
    images = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    return posterior_of(*images, MESH, **({"priors": PRIORS} | LOADS | options))


def start(post, follows=False):
    """A setup about a position with displacements that hardly any surface load made, and a whitened state there."""
    u = 0.02 * np.random.default_rng(0).normal(size=(len(MESH.points), 3))
    reference = post.reference() | {"u_boundary": jnp.asarray(u)}
    flat = flat_position(post.target, post.data, post.estimands(reference))
    factor = np.triu(0.05 * np.random.default_rng(1).normal(size=(dimension(post.target),) * 2)) + np.eye(len(flat))
    gaussian = laplace(post.target, np.asarray(flat)) if follows else Gaussian(flat, jnp.asarray(factor))
    setup = setup_about(post.target, gaussian, flat)
    density = whitened_density(post.target, post.data, setup)
    return setup, density, blackjax.mcmc.hmc.init(setup.gaussian.whiten(flat), density)


@pytest.mark.parametrize(("follows", "rounding"), [(False, 1e-9), (True, 1e-3)])
def test_the_state_keeps_the_density_and_the_gradient_of_its_position(monkeypatch, follows, rounding):
    # What follows is rounded to single precision, seven times one after another.
    monkeypatch.setattr(ModeSearch, "followed", property(lambda search: search.separable if follows else ()))
    post = posterior()
    setup, density, state = start(post, follows)
    assert (setup.gaussian.following is not None) == follows
    moved = jax.jit(partial(move_hyperparameters, post.target, post.data, setup))(jax.random.key(3), state)
    before, after = (np.asarray(setup.gaussian.place(x.position)) for x in (state, moved))
    changed = np.flatnonzero(np.abs(after - before) > rounding)
    assert len(changed) > 0
    assert set(changed) <= set(np.flatnonzero(mark_separable(post.target)))
    height, slope = jax.value_and_grad(density)(moved.position)
    np.testing.assert_allclose(moved.logdensity, height, rtol=max(1e-9, rounding * 1e-3))
    allowed = max(1e-6, 5 * rounding) * np.abs(slope).max()
    np.testing.assert_allclose(moved.logdensity_grad, slope, rtol=1e-6, atol=allowed)


@pytest.mark.parametrize("options", [KNOWN_STIFFNESS, KNOWN_LOADS], ids=["loads", "stiffness"])
def test_draws_have_the_density_of_a_grid(options):
    """Two hyperparameters, given the displacements: quantiles of the whole density on a grid."""
    post = posterior(**options)
    setup, _, state = start(post)
    target, entries = post.target, np.flatnonzero(mark_separable(post.target))

    def density(flat):
        return logdensity(target, post.data, unravel(target)(flat))

    @jax.jit
    def chain(key):
        def step(state, key):
            state = move_hyperparameters(target, post.data, setup, key, state)
            return state, setup.gaussian.place(state.position)[entries]

        return jax.lax.scan(step, state, jax.random.split(key, 1000))[1]

    draws = np.asarray(chain(jax.random.key(0)))[125:]
    flat = setup.gaussian.place(state.position)
    axes = [np.linspace(column.min() - 0.3, column.max() + 0.3, 61) for column in draws.T]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    heights = jax.jit(lambda points: jax.lax.map(lambda x: density(flat.at[entries].set(x)), points))(jnp.asarray(grid))
    weights = np.exp(np.asarray(heights) - heights.max()).reshape(61, 61)
    for axis in range(2):
        marginal = weights.sum(axis=1 - axis) / weights.sum()
        for share in (0.1, 0.5, 0.9):
            quantile = np.interp(share, marginal.cumsum() - marginal / 2, axes[axis])
            assert abs((draws[:, axis] <= quantile).mean() - share) < 0.05
    if options is KNOWN_STIFFNESS:
        # The tail of the surface load is long: the moves cross it.
        assert draws[:, 1].std() > 1


def test_stiffness_that_moves_the_inside_is_not_separable():
    images = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    temperature = br.ScalePrior(median=10.0)
    post = posterior_of(*images, MESH, priors=PRIORS, normalised=True, t_elastic=temperature)
    assert mark_separable(post.target).sum() == 1
    assert mark_separable(post.target)[slices(post.target)["t_elastic"]].all()
