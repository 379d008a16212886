"""The surrogate of a posterior: images in single precision, without the costly normaliser."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayesreg as br
from bayesreg.inference.target import logdensity
from tests.options import posterior_of
from tests.phantoms import box_mesh, smooth_image

MESH = box_mesh(3)


@pytest.fixture(autouse=True)
def _costly(monkeypatch):
    """Treat a mesh of few nodes like one of many."""
    monkeypatch.setattr("bayesreg.model.target.CHEAP_NODES", 0)


def posterior(**options):
    fixed, moving = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    scale, priors = br.ScalePrior(median=0.1, log_sd=3.0), {name: {"high": 20.0} for name in ("lam", "mu")}
    loads = {"body_load": scale, "surface_load": scale, "priors": priors}
    return posterior_of(fixed, moving, MESH, interpolation="cubic", **loads, **options)


@pytest.mark.parametrize("similarity", ["ssd", "student_t", "lncc", "mi", "mind"])
def test_its_density_differs_by_a_constant_and_rounding(similarity):
    post = posterior(similarity=similarity, quadrature="gauss32")
    target, rng = post.target, np.random.default_rng(0)
    # The elastic energy of such displacements is much greater than that of the images.
    plain, simple = (data.without_term("elastic") for data in (post.data, target.surrogate(post.data)))
    at_rest = post.unconstrain(post.reference())
    shifts = rng.normal(size=(6, len(MESH.points), 3))
    positions = [{**at_rest, "u_boundary": at_rest["u_boundary"] + shift} for shift in shifts]

    @jax.jit
    def height_and_slope(data, position):
        return jax.value_and_grad(lambda position: logdensity(target, data, position))(position)

    exact_heights, rounded_heights = [], []
    for position in positions:
        (exact, slope), (rounded, rounded_slope) = (height_and_slope(data, position) for data in (plain, simple))
        exact_heights.append(float(exact))
        rounded_heights.append(float(rounded))
        slope, rounded_slope = slope["u_boundary"], rounded_slope["u_boundary"]
        assert jnp.abs(slope - rounded_slope).max() < 1e-3 * jnp.abs(slope).max()
    assert np.std(exact_heights) > 1
    assert 0 < np.std(np.subtract(exact_heights, rounded_heights)) < 0.01


def test_a_posterior_without_a_costly_normaliser_has_none(monkeypatch):
    monkeypatch.setattr("bayesreg.model.target.CHEAP_NODES", 200)
    assert posterior().target.surrogate is None
