"""The elastic prior as a proper density: against SciPy's Gaussian, and what dropping its normaliser does."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from bayesreg.inference.target import logdensity, without_normaliser
from tests.model.test_gradients import assert_gradient
from tests.options import posterior_of
from tests.oracles import paper
from tests.phantoms import LAM, MU, ball_mesh, linear_image, smooth_image

MESH = ball_mesh(spacing=24.0)
SMALL = ball_mesh(spacing=30.0)
BOUNDARY = len(MESH.boundary)
T_ELASTIC = 30.0
PRIORS = {name: {"high": 60.0} for name in ("lam", "mu")}
PROPER = {"normalised": True, "priors": PRIORS, "t_elastic": T_ELASTIC, "t_similarity": 5.0}


@cache
def images():
    return tuple(smooth_image(MESH.points, seed=seed) for seed in (1, 2))


def posterior(**options):
    return posterior_of(*images(), MESH, **(PROPER | options))


def states(count=4, nodes=BOUNDARY, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        lam, mu = 10 ** rng.uniform(-1, 1.3, (2, 3))
        yield {"u_boundary": rng.normal(size=(nodes, 3)), "lam": lam, "mu": mu}


def schur(lam, mu, sampled, held=()):
    """S of the sampled nodes while the held ones rest."""
    K = paper.stiffness(MESH.points, MESH.cells, lam[MESH.tissue], mu[MESH.tissue])
    return paper.schur_complement(K, np.r_[sampled, held].astype(int))[: 3 * len(sampled), : 3 * len(sampled)]


@pytest.mark.parametrize("held", [0, 1, 3])
def test_elastic_prior_is_scipys_gaussian(held):
    """log p(u_B | λ, μ, T_r) where the held nodes rest, the rigid motions left taken out; normalised to the last 2π."""
    still, sampled = MESH.boundary[:held], MESH.boundary[held:]
    post = posterior(held={int(node): (0.0, 0.0, 0.0) for node in still})
    for state in states(nodes=len(sampled)):
        covariance = T_ELASTIC * np.linalg.pinv(schur(state["lam"], state["mu"], sampled, still), 1e-10, hermitian=True)
        u = covariance @ np.linalg.pinv(covariance, 1e-10, hermitian=True) @ state["u_boundary"].ravel()
        gaussian = stats.multivariate_normal(np.zeros(len(u)), covariance, allow_singular=True)
        terms = post.energies(state | {"u_boundary": u.reshape(-1, 3)})
        log_prior = float(terms["elastic"])
        assert log_prior == pytest.approx(gaussian.logpdf(u), rel=1e-9)


@pytest.mark.parametrize("elasticity", ["tissue", "uniform", "element"])
def test_density_is_the_papers_and_the_normaliser(elasticity):
    proper, improper = (posterior(elasticity=elasticity, fixed={}, normalised=which) for which in (True, False))
    size = len(proper.target.variables.entry_names)
    for state in states(count=2):
        values = state | {name: np.resize(state[name], size) for name in ("lam", "mu")}
        estimands = proper.estimands(values)
        plain = without_normaliser(proper.target, proper.data)
        without = proper.target.evaluate_estimands(plain, estimands)
        assert float(without.logdensity) == float(improper.logdensity_constrained(values))
        both = without.logdensity + proper.target.normaliser.log(proper.data, estimands)
        assert float(proper.logdensity_constrained(values)) == pytest.approx(float(both), rel=1e-12)
        assert improper.target.normaliser is None
        assert float(proper.target.normaliser.log(plain, estimands)) == 0
        position = proper.unconstrain(values)
        less = proper.logdensity(position) - logdensity(proper.target, plain, position)
        assert float(less) == pytest.approx(float(proper.target.normaliser.log(proper.data, estimands)), rel=1e-9)


def test_chains_side_by_side():
    post = posterior()
    trial = list(states())
    trial[1]["mu"][0] = -1.0
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *trial)
    alone = np.array([float(post.logdensity_constrained(values)) for values in trial])
    np.testing.assert_allclose(jax.vmap(post.logdensity_constrained)(batch), alone, rtol=1e-10)
    np.testing.assert_array_equal(np.isfinite(alone), [True, False, True, True])


def test_gradient_in_everything_but_the_images():
    post = posterior(t_elastic={"median": 20.0}, interpolation="cubic")
    values = {"u_boundary": next(states())["u_boundary"], "lam": LAM, "mu": MU, "t_elastic": jnp.asarray(T_ELASTIC)}
    assert_gradient(post.logdensity, post.unconstrain(values))


LEVELS = np.linspace(np.log(0.1), np.log(20.0), 61)
TRUTHS = np.random.default_rng(0).uniform(LEVELS[0], LEVELS[-1], 150)


def drawn(theta, t_elastic=T_ELASTIC, seed=0):
    """u_B from the model itself: μ of the outermost tissue e^θ, all else known."""
    mu = np.array([MU[0], np.exp(theta), MU[2]])
    K = paper.stiffness(SMALL.points, SMALL.cells, LAM[SMALL.tissue], mu[SMALL.tissue])
    values, vectors = np.linalg.eigh(paper.schur_complement(K, SMALL.boundary))
    return vectors[:, 6:] @ (np.random.default_rng(seed).normal(size=len(values) - 6) * np.sqrt(t_elastic / values[6:]))


@cache
def replicated():
    """Posterior means of θ = log μ less the truth, for u drawn at θ from a flat prior: the paper's, the proper one's.

    The moving image is constant: the images say nothing, u is what is observed.
    """
    blank = linear_image(SMALL.points, np.zeros(3), 0.5)
    fixed = {"mu": {"csf": MU[0], "wm": MU[2]}, "lam": dict(zip(SMALL.names, LAM, strict=True))}
    post = posterior_of(blank, blank, SMALL, **PROPER, fixed=fixed)
    grid = jnp.exp(LEVELS)[:, None]
    draws = np.stack([drawn(theta, seed=i).reshape(-1, 3) for i, theta in enumerate(TRUTHS)])

    def density(u):
        def at(mu):
            return post.target.evaluate_estimands(
                without_normaliser(post.target, post.data), {"u_boundary": u, "mu": mu}
            ).logdensity

        return jax.vmap(at)(grid)

    without = np.asarray(jax.lax.map(density, draws))
    normaliser = np.array(
        [float(post.target.normaliser.log(post.data, {"u_boundary": draws[0], "mu": mu})) for mu in grid]
    )
    return tuple(mean_of_level(log_p) - TRUTHS for log_p in (without, without + normaliser))


def mean_of_level(log_p):
    """E θ by quadrature, the prior being flat in θ on the grid."""
    weights = np.exp(log_p - log_p.max(axis=1, keepdims=True))
    return weights @ LEVELS / weights.sum(axis=1)


@pytest.mark.long
def test_the_proper_density_recovers_stiffness_and_the_papers_drives_it_to_zero():
    """Over draws of (θ, u) from the model the posterior mean of θ is right on average, if the posterior is."""
    errors = dict(zip(("paper", "proper"), replicated(), strict=True))
    z = {name: error.mean() / (error.std(ddof=1) / np.sqrt(len(error))) for name, error in errors.items()}
    assert abs(z["proper"]) < 3.5
    assert errors["proper"].std() < 0.5 * TRUTHS.std()
    assert z["paper"] < -10
    assert errors["paper"].mean() < -1
