"""Inferred temperatures and the likelihoods they belong to, against SciPy's distributions."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from tests.model.test_gradients import assert_gradient
from tests.options import posterior_of
from tests.phantoms import LAM, MU, ball_mesh, smooth_image

MESH = ball_mesh(spacing=30.0)
BOTH = {"t_similarity": {"median": 5.0, "log_sd": 0.7}, "t_elastic": {"median": 100.0}}
PROPER = {"normalised": True, "priors": {name: {"high": 60.0} for name in ("lam", "mu")}}
NU = 3.5


@cache
def images():
    return tuple(smooth_image(MESH.points, seed=seed) for seed in (1, 2))


def posterior(**options):
    return posterior_of(*images(), MESH, **options)


def values(seed=0, **temperatures):
    u = np.random.default_rng(seed).normal(size=(len(MESH.boundary), 3))
    return {"u_boundary": u, "lam": LAM, "mu": MU, **{name: jnp.asarray(t) for name, t in temperatures.items()}}


def residuals_and_scales(post, state, t_similarity):
    """Residual and √(T_s / 2w) at every quadrature point."""
    r = np.asarray(post.images.residuals(post.evaluate(state).u))
    return r, np.sqrt(t_similarity / (2 * np.asarray(post.images.quadrature.weights)))


def log_likelihood(post, state):
    terms = post.energies(state)
    return float(terms["images"])


@pytest.mark.parametrize("t_similarity", [0.4, 7.0])
def test_likelihood_of_an_inferred_temperature_is_gaussian(t_similarity):
    post = posterior(t_similarity=BOTH["t_similarity"])
    state = values(t_similarity=t_similarity)
    residuals, scales = residuals_and_scales(post, state, t_similarity)
    assert log_likelihood(post, state) == pytest.approx(stats.norm.logpdf(residuals, scale=scales).sum(), rel=1e-10)


@pytest.mark.parametrize("t_similarity", [0.4, 7.0])
def test_students_t_is_scipys(t_similarity):
    post = posterior(t_similarity=BOTH["t_similarity"], similarity="student_t", degrees_of_freedom=NU)
    state = values(t_similarity=t_similarity)
    residuals, scales = residuals_and_scales(post, state, t_similarity)
    expected = stats.t.logpdf(residuals, NU, scale=scales).sum()
    assert log_likelihood(post, state) == pytest.approx(expected, rel=1e-10)
    # Of a known temperature the same but for a constant, and its energy alone.
    known_posterior = posterior(t_similarity=t_similarity, similarity="student_t", degrees_of_freedom=NU)
    difference = log_likelihood(post, state) - float(known_posterior.energies(values())["images"])
    at_zero = stats.t.logpdf(0 * residuals, NU, scale=scales).sum()
    assert difference == pytest.approx(at_zero, rel=1e-10)


def test_students_t_of_many_degrees_is_the_sum_of_squares():
    squares = posterior(t_similarity=5.0).energies(values())["similarity_energy"]
    heavy, light = (
        posterior(t_similarity=5.0, similarity="student_t", degrees_of_freedom=nu).energies(values())
        for nu in (4.0, 1e9)
    )
    assert float(light["similarity_energy"]) == pytest.approx(float(squares), rel=1e-6)
    assert float(heavy["similarity_energy"]) < 0.9 * float(squares)


def test_an_outlier_counts_little_under_students_t():
    """Where the image is wrong by far, E_s grows with the square of the error, and with its logarithm."""
    fixed, moving = images()
    wrong = np.array(fixed.voxels)
    wrong[7, 5, 8] += 30
    energies = {}
    for name in ("ssd", "student_t"):
        options = {"similarity": name, "t_similarity": 5.0}
        clean, spoilt = (posterior_of(f, moving, MESH, **options) for f in (fixed, fixed.with_voxels(wrong)))
        energies[name] = [float(post.energies(values())["similarity_energy"]) for post in (clean, spoilt)]
    assert energies["ssd"][1] > 5 * energies["ssd"][0]
    assert energies["student_t"][1] < 1.5 * energies["student_t"][0]


@pytest.mark.parametrize("name", ["t_similarity", "t_elastic"])
def test_prior_is_scipys_log_normal(name):
    post = posterior(**PROPER, **BOTH)
    prior = BOTH[name]
    for value in (0.3, 20.0, 4e3):
        state = values(**({"t_similarity": 5.0, "t_elastic": 100.0} | {name: value}))
        expected = stats.lognorm.logpdf(value, prior.get("log_sd", 1.0), scale=prior["median"])
        assert float(post.energies(state)[f"prior_{name}"]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("similarity", ["ssd", "student_t"])
def test_gradient(similarity):
    post = posterior(**BOTH, **PROPER, similarity=similarity, interpolation="cubic", independent_points=20.0)
    assert_gradient(post.logdensity, post.unconstrain(values(t_similarity=3.0, t_elastic=60.0)))


def test_terms_add_up_and_independent_points_temper_the_likelihood():
    options = BOTH | PROPER | {"similarity": "student_t"}
    every = posterior(**options)
    count = len(every.images.quadrature.weights)
    few = posterior(**options, independent_points=count / 8)
    state = values(t_similarity=3.0, t_elastic=60.0)
    terms, tempered = every.energies(state), few.energies(state)
    for name, value in terms.items():
        share = 1 / 8 if name == "images" else 1
        assert float(tempered[name]) == pytest.approx(share * float(value), rel=1e-12), name
    total = sum(float(value) for name, value in tempered.items() if not name.endswith("_energy"))
    assert float(few.logdensity_constrained(state)) == pytest.approx(total, rel=1e-12)
    with pytest.raises(ValueError, match=f"the quadrature has {count} points"):
        posterior(independent_points=count + 1.0)


def test_coordinates():
    post = posterior(**BOTH, **PROPER)
    state = values(t_similarity=3.0, t_elastic=60.0)
    position = post.unconstrain(state)
    assert set(position) == {"u_boundary", "lam", "mu", "t_similarity", "t_elastic"}
    assert position["t_elastic"] == pytest.approx(np.log(60.0))
    constrained = post.constrain(position)
    for name, value in state.items():
        np.testing.assert_allclose(constrained[name], value, rtol=1e-12)
    assert {name: np.shape(value) for name, value in post.estimands(state).items()}["t_similarity"] == ()
    assert post.reference()["t_similarity"] == 5.0
    assert {name: value.shape for name, value in post.initial(jax.random.key(0)).items()} == {
        name: np.shape(value) for name, value in position.items()
    }
    jacobian = [
        np.linalg.slogdet(np.atleast_2d(jax.jacobian(lambda z, n=name: post.constrain(position | {n: z})[n])(z)))[1]
        for name, z in position.items()
        if name.startswith("t_")
    ]
    only_lame = posterior(**PROPER, t_similarity=3.0, t_elastic=60.0)
    of_lame = only_lame.logdensity({n: position[n] for n in ("u_boundary", "lam", "mu")})
    of_lame -= only_lame.logdensity_constrained(state)
    log_jacobian = post.logdensity(position) - post.logdensity_constrained(state)
    assert float(log_jacobian) == pytest.approx(float(of_lame) + sum(jacobian), rel=1e-9)


def test_known_temperatures_are_no_estimands():
    post = posterior(t_similarity=BOTH["t_similarity"])
    assert "t_similarity" in post.reference()
    assert "t_elastic" not in post.unconstrain(post.reference())


@pytest.mark.parametrize("name", ["t_similarity", "t_elastic"])
@pytest.mark.parametrize("value", [0.0, -2.0, np.nan, np.inf])
def test_a_temperature_that_is_not_positive_is_outside_the_support(name, value):
    post = posterior(**BOTH, **PROPER)
    state = values(**({"t_similarity": 5.0, "t_elastic": 100.0} | {name: value}))
    assert not post.target.supports(post.data, post.estimands(state))
    assert float(post.logdensity_constrained(state)) == -np.inf


def test_noise_that_a_temperature_stands_for():
    weight = float(np.mean(posterior().images.quadrature.weights))
    assert posterior().images.noise_sd(0.8) == pytest.approx(np.sqrt(0.8 / (2 * weight)))
    heavy = posterior(similarity="student_t", degrees_of_freedom=NU).images
    assert heavy.noise_sd(0.8) == pytest.approx(stats.t.std(NU, scale=np.sqrt(0.8 / (2 * weight))))
    assert heavy.noise_sd(3.2) == pytest.approx(2 * heavy.noise_sd(0.8))


def test_values_must_hold_the_inferred_temperatures():
    with pytest.raises(ValueError, match="lack 't_similarity'"):
        posterior(t_similarity=BOTH["t_similarity"]).logdensity_constrained(values())
