"""Mutual information as a likelihood."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline

import bayesreg as br
from bayesreg.model.observations.images.mutual_information import BINS, JointInformation
from bayesreg.model.observations.images.pointwise import Intensities
from tests.model.test_contrast import FIXED, MESH, error_of, moved, other_contrast
from tests.model.test_gradients import assert_gradient
from tests.options import posterior_of

RNG = np.random.default_rng(0)
F = RNG.uniform(size=400)
M = np.cos(3 * F) + 0.1 * RNG.normal(size=400)
WEIGHTS = RNG.uniform(0.5, 2.0, size=400)
PAIR = Intensities(jnp.asarray(F), jnp.asarray(M), jnp.asarray(WEIGHTS))
SIMILARITY = JointInformation(jnp.asarray(0.05), jnp.array([0.0, 1.0]), jnp.array([-1.2, 1.2]))


def shares_of(values, low, high):
    """Each value's share in every bin, by SciPy's B-splines."""
    width = (high - low) / (BINS - 3)
    centres = low + (np.arange(BINS) - 1) * width
    spline = BSpline.basis_element(np.arange(-2, 3), extrapolate=False)
    return np.nan_to_num(spline((np.clip(values, low, high)[:, None] - centres) / width))


def test_the_energy_is_the_information_of_the_joint_histogram():
    joint = shares_of(F, 0, 1).T @ (WEIGHTS[:, None] * shares_of(M, -1.2, 1.2))
    joint /= joint.sum()
    inside = joint > 0
    product = joint.sum(1)[:, None] * joint.sum(0)
    information = (joint[inside] * np.log(joint[inside] / product[inside])).sum()
    energy = float(SIMILARITY.energy(PAIR, jnp.asarray(7.0)))
    assert energy == pytest.approx(-0.05 * 400 * information, rel=1e-4)


@pytest.mark.parametrize("change", [lambda m: 3 * m + 2, lambda m: -m])
def test_an_affine_map_of_the_moving_image_changes_nothing(change):
    ends = np.sort(change(np.array([-1.2, 1.2])))
    rescaled = SIMILARITY._replace(moving_range=jnp.asarray(ends))
    energy = float(rescaled.energy(PAIR._replace(moving=change(PAIR.moving)), jnp.asarray(1.0)))
    assert energy == pytest.approx(float(SIMILARITY.energy(PAIR, jnp.asarray(1.0))), rel=1e-9)


def test_the_curvature_is_the_square_of_the_slope_of_each_point():
    slope = jax.grad(lambda m: SIMILARITY.energy(PAIR._replace(moving=m), jnp.asarray(1.0)))(PAIR.moving)
    counted = WEIGHTS / WEIGHTS.mean()
    expected = 0.05 * counted * (np.asarray(slope) / (0.05 * counted)) ** 2
    np.testing.assert_allclose(SIMILARITY.convexity(PAIR, jnp.asarray(1.0)).diagonal, expected, rtol=1e-5, atol=1e-12)


def test_the_likelihood_is_a_density_of_f():
    """Replicates of f, given m, have the mean and the spread of p(f | m) that the histogram tells, point by point."""
    joint = np.asarray(SIMILARITY.histogram(PAIR).joint)
    conditional = shares_of(M, -1.2, 1.2) @ joint.T
    conditional /= conditional.sum(1, keepdims=True)
    centres = (np.arange(BINS) - 1) / (BINS - 3)
    keys = jax.random.split(jax.random.key(0), 2000)
    scale = np.sqrt(0.05 / (2 * WEIGHTS))
    draws = np.asarray(jax.vmap(lambda key: SIMILARITY.draw(key, PAIR))(keys)) * scale
    variance = conditional @ centres**2 - (conditional @ centres) ** 2 + (1 / (BINS - 3)) ** 2 / 12
    assert np.abs(draws.mean(0)).max() < 5 * np.sqrt(variance.max() / 2000)
    np.testing.assert_allclose(draws.var(0), variance, rtol=0.25)
    np.testing.assert_allclose(SIMILARITY.residuals(PAIR), F - conditional @ centres, atol=1e-9)


def test_the_gradient_is_that_of_differences():
    moving = FIXED.with_voxels(other_contrast(np.asarray(FIXED.voxels)))
    post = posterior_of(FIXED, moving, MESH, similarity="mi", quadrature="gauss32", interpolation="cubic")
    assert_gradient(post.logdensity, post.initial(jax.random.key(0)))


@pytest.mark.long
def test_the_mode_of_a_pair_of_unlike_contrast_is_as_near_as_that_of_one_contrast():
    assert error_of(moved(other_contrast), one_contrast=False, similarity="mi") < 0.4


def test_there_is_no_noise_to_infer():
    with pytest.raises(br.InputError, match=r"similarity\.mi\.temperature: .* number"):
        br.ImagePair(FIXED, FIXED, similarity={"kind": "mi", "temperature": {"median": 0.1}})


def test_a_constant_image_is_refused():
    with pytest.raises(ValueError, match="constant"):
        posterior_of(FIXED, FIXED.with_voxels(np.ones(FIXED.shape)), MESH, similarity="mi")
