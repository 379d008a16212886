"""The NumPyro program: it is what the samplers see, its observations are observed, and replicates follow the noise."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from numpyro.infer.util import log_density
from scipy import stats

import bayesreg as br
from bayesreg.model.observations.images.pointwise import Intensities, StudentTNoise
from bayesreg.model.program import registration
from tests.options import image_options_of, model_of
from tests.phantoms import LAM, MU, ball_mesh, smooth_image

MESH = ball_mesh(spacing=30.0)
OPTIONS = {
    "t_similarity": {"median": 5.0, "log_sd": 0.5},
    "t_elastic": 100.0,
    "priors": {"lam": {"alpha": 2.0, "beta": 3.0, "low": 0.5, "high": 40.0}},
}
NU = 6.0


def posterior(**options):
    fixed, moving = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    points = MESH.points[MESH.cells[:5]].mean(axis=1)
    options = OPTIONS | options
    observed = [br.ImagePair(fixed, moving, **image_options_of(**options)), br.Landmarks(points, points + 0.4, sd=0.7)]
    return br.build_posterior(MESH, observed, model_of(**options))


def values():
    u = np.random.default_rng(0).normal(size=(len(MESH.boundary), 3))
    return {"u_boundary": u, "lam": LAM, "mu": MU, "t_similarity": np.array(3.0)}


@pytest.mark.parametrize("options", [{}, {"similarity": "student_t", "independent_points": 30.0}])
def test_the_samplers_density_is_the_programs_and_the_jacobian(options):
    post = posterior(**options)
    position = post.unconstrain(values())
    program, _ = log_density(registration, (post.data,), {}, post.constrain(position))
    log_jacobian = 0.0
    for name in ("lam", "mu", "t_similarity"):

        def moved(z, name=name):
            return post.estimands(post.constrain({**position, name: z}))[name]

        log_jacobian += np.linalg.slogdet(np.atleast_2d(jax.jacobian(moved)(position[name])))[1]
    assert abs(log_jacobian) > 0.1
    assert float(post.logdensity(position)) == pytest.approx(float(program) + log_jacobian, rel=1e-12)


def test_images_and_landmarks_are_observed_sites_of_the_program():
    post = posterior()
    program = numpyro.handlers.substitute(registration, post.constrain(post.unconstrain(values())))
    trace = numpyro.handlers.trace(program).get_trace(post.data)
    observed = {name: np.asarray(trace[name]["value"]) for name in ("images", "landmarks")}
    assert all(trace[name]["type"] == "sample" and trace[name]["is_observed"] for name in observed)
    np.testing.assert_array_equal(observed["images"], post.images.fixed_values)
    np.testing.assert_allclose(observed["landmarks"], 0.4, rtol=1e-12)
    unknown = {name for name, site in trace.items() if site["type"] == "sample" and not site["is_observed"]}
    assert unknown == {"u_boundary", "lam", "mu", "t_similarity"}


@pytest.mark.parametrize(
    ("options", "noise"),
    [({}, stats.norm()), ({"similarity": "student_t", "degrees_of_freedom": NU}, stats.t(NU))],
    ids=["ssd", "student_t"],
)
def test_replicates_have_the_variance_of_the_noise(options, noise):
    post, count = posterior(**options, independent_points=30.0), 4000
    program = numpyro.handlers.substitute(registration, post.constrain(post.unconstrain(values())))
    likelihood = numpyro.handlers.trace(program).get_trace(post.data)["images"]["fn"]
    replicates = np.asarray(likelihood.sample(jax.random.key(0), (2, count // 2)))
    assert replicates.shape == (2, count // 2, *post.images.fixed_values.shape)
    weights = np.asarray(post.images.quadrature.weights)
    sd = np.sqrt(3.0 / (2 * weights)) * noise.std()
    z = (replicates.reshape(count, -1) - np.asarray(likelihood.compared.moving)) / sd
    standard_error = np.sqrt((noise.stats(moments="k") + 2) / count)
    assert abs(z.mean(axis=0)).max() < 5 / np.sqrt(count)
    assert abs((z**2).mean(axis=0) - 1).max() < 6 * standard_error
    assert np.ptp(sd) > 0.1 * sd.mean()
    mean_sd = np.sqrt(3.0 / (2 * weights.mean())) * noise.std()
    assert post.images.noise_sd(3.0) == pytest.approx(mean_sd)


@pytest.mark.parametrize("nu", [2.5, 4.0, 30.0])
def test_the_noise_of_students_t_has_scipys_distribution(nu):
    nothing = jnp.zeros(20_000)
    pair = Intensities(nothing, nothing, jnp.ones(20_000))
    draws = np.asarray(StudentTNoise(nu).draw(jax.random.key(0), pair))
    assert np.isfinite(draws).all()
    assert stats.kstest(draws, stats.t(nu).cdf).pvalue > 0.01
    assert abs(np.corrcoef(draws[1:], draws[:-1])[0, 1]) < 0.05
