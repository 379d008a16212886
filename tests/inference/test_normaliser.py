"""The stand-in for a costly normaliser."""

from __future__ import annotations

from functools import cache
from math import comb

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
    make_stand_in,
    no_stand_in,
    smooth_coordinates,
)
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


@pytest.mark.long
@pytest.mark.slow
def test_the_stand_in_is_close_to_the_normaliser_where_the_warm_up_ends():
    post = posterior()
    points = starting_points(post.target, br.Start(), 2, jax.random.key(0))
    setup, _ = hmc(post.target, Hmc(warm_up=2)).prepare(points, jax.random.key(1), NEVER, lambda _: None)
    sd = np.linalg.norm(np.asarray(setup.gaussian.factor), axis=1) * mark_normaliser(post.target)
    places = np.asarray(setup.middle) + sd * np.random.default_rng(0).normal(size=(10, len(sd)))
    true, approximate = (
        np.array([float(of(post.target, post.data, jnp.asarray(place))) for place in places])
        for of in (log_normaliser_at, lambda *arguments: setup.stand_in(smooth_coordinates(*arguments)))
    )
    assert true.std() > 1
    assert (true - approximate).std() < 0.05
