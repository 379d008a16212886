"""Displacements that follow hyperparameters: a Gaussian model in closed form, and draws against another sampler."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.diagnostics import effective_sample_size

import bayesreg as br
from bayesreg.inference.gaussian.following import follow_by
from bayesreg.inference.gaussian.laplace import gaussian_of
from bayesreg.model.mode_search import ModeSearch
from bayesreg.model.observations.point_noise import NormalNoise
from tests.inference.test_gibbs import FIXED, MESH, MOVING

ROWS = 12


def positive_definite(seed, rank=ROWS):
    root = np.random.default_rng(seed).normal(size=(ROWS, rank))
    return root @ root.T / ROWS


def follow_scales(data, priors, push):
    """The whitened model u ~ N(0, P⁻¹), P = Σ P_k e^{−2 θ_k}, with data of the precision A: −½ uᵀ A u + pushᵀ u."""
    precision = data + sum(priors)
    gaussian = gaussian_of(np.linalg.solve(precision, push), precision)
    factor, mean = np.asarray(gaussian.factor), np.asarray(gaussian.centre)

    def prior_at(entry, by):
        return sum(priors) + np.expm1(-2 * by) * priors[entry]

    return factor, mean, follow_by(np.arange(len(priors)), np.ones(len(priors)), factor, mean, prior_at)


@pytest.mark.parametrize("change", [-2.0, -1.0, 0.0, 1.0, 2.0])
def test_one_scale_of_a_gaussian_prior_is_followed_exactly(change):
    """Up to single precision, in which the directions are computed."""
    # The data say nothing about most directions.
    data, prior, push = (
        5 * positive_definite(0, rank=4),
        positive_definite(1),
        np.random.default_rng(2).normal(size=ROWS),
    )
    push = data @ push
    factor, mean, following = follow_scales(data, [prior], push)
    changes = jnp.array([change])
    place = lambda z: mean + factor @ following.follow(changes, z)  # noqa: E731
    expected = np.linalg.inv(data + prior * np.exp(-2 * change))
    root = np.asarray(jax.jacobian(place)(jnp.zeros(ROWS)))
    np.testing.assert_allclose(root @ root.T, expected, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_allclose(place(jnp.zeros(ROWS)), expected @ push, atol=1e-4 * np.abs(mean).max())


def test_images_that_curve_the_wrong_way_leave_a_precision():
    prior = positive_definite(1)
    _, _, following = follow_scales(-0.5 * prior, [prior], np.ones(ROWS))
    changes = jnp.array([2.0])
    # The precision of the prior alone.
    np.testing.assert_allclose(following.log_jacobian(changes), 2.0 * ROWS, rtol=1e-3)
    assert np.isfinite(following.follow(changes, jnp.ones(ROWS))).all()


def test_the_inverse_and_the_jacobian_of_two_hyperparameters():
    priors = [positive_definite(1), positive_definite(2)]
    _, _, following = follow_scales(
        5 * positive_definite(0, rank=4), priors, np.random.default_rng(3).normal(size=ROWS)
    )
    changes, z = jnp.array([0.7, -0.5]), jnp.asarray(np.random.default_rng(4).normal(size=ROWS))
    followed = following.follow(changes, z)
    assert np.abs(followed - z).max() > 0.1
    np.testing.assert_allclose(following.unfollow(changes, followed), z, atol=1e-5)
    jacobian = jax.jacobian(lambda z: following.follow(changes, z))(z)
    np.testing.assert_allclose(following.log_jacobian(changes), np.linalg.slogdet(jacobian)[1], rtol=1e-5)


@pytest.mark.slow
def test_draws_are_those_of_another_sampler(monkeypatch):
    """Pairs of points, for which the Gibbs sampler integrates the displacements out.

    Displacements that follow nothing make a tenth as many effective draws of λ.
    """
    monkeypatch.setattr(ModeSearch, "followed", property(lambda search: search.separable))
    # With both loads unknown there is a second mode, which only one of both samplers visits.
    loads = br.RandomLoads(body=br.ScalePrior(median=0.1, log_sd=3.0), surface=0.2)
    model = br.ModelConfig(preset="registration", elastic_prior=loads, least_volume=0.0, fixed={"mu": {"organ": 1.0}})
    post = br.build_posterior(MESH, [br.Landmarks(FIXED, MOVING, 0.6, noise=NormalNoise())], model)
    assert set(post.target.mode_search.followed) == {"body_load", "lam"}
    ours, theirs = (
        br.sample(post, sampler=sampler, chains=4, draws=draws, seed=0, progress=False).idata.posterior
        for sampler, draws in (("hmc", 250), ("gibbs", 1500))
    )
    for name in ("body_load", "lam"):
        assert effective_sample_size(np.log(np.asarray(ours[name]).reshape(4, -1))) > 200
        for share in (0.1, 0.5, 0.9):
            below = np.asarray(ours[name]) <= np.quantile(theirs[name], share)
            assert abs(below.mean() - share) < 0.08
    (mean, sd), (their_mean, their_sd) = (
        (np.mean(draws["u_boundary"], axis=(0, 1)), np.std(draws["u_boundary"], axis=(0, 1)))
        for draws in (ours, theirs)
    )
    assert (np.abs(mean - their_mean) / their_sd).max() < 0.3
    np.testing.assert_allclose(sd, their_sd, rtol=0.2)
