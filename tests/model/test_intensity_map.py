"""A slow shading between the images, smoothing, and a random choice of voxels."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import bayesreg as br
from bayesreg.model.observations.images.intensity_map import shading_basis
from tests.model.test_gradients import assert_gradient
from tests.options import posterior_of
from tests.phantoms import ball_mesh, smooth_image

MESH = ball_mesh(spacing=24.0)
FIXED = smooth_image(MESH.points, seed=1)


def shaded(image):
    """The image with a gain that is linear in x, and an offset."""
    x = image.grid_points()[..., 0] / 40
    return image.with_voxels(np.asarray(image.voxels) * (1.1 + 0.2 * x) + 0.05)


def posterior(moving, **options):
    return posterior_of(FIXED, moving, MESH, quadrature="voxels", **options)


def test_a_shading_is_all_that_tells_images_at_rest_apart():
    """Least squares over the basis, by NumPy, leaves nothing."""
    post = posterior(shaded(FIXED), intensity_map=1)
    zero, images = np.zeros(MESH.points.shape), post.images
    basis = np.asarray(images.shading)
    difference = -np.asarray(images.residuals(zero, post.reference()))
    coefficients = np.linalg.lstsq(basis, difference, rcond=None)[0]
    assert np.abs(difference).max() > 0.1
    residuals = post.images.residuals(zero, {"images_shading": coefficients})
    np.testing.assert_allclose(residuals, 0.0, atol=1e-9)


def test_functions_are_orthogonal_and_as_great_as_the_image():
    rng = np.random.default_rng(0)
    values, positions = rng.uniform(size=500), rng.normal(size=(500, 3))
    basis = shading_basis(values, positions, 2)
    assert basis.shape == (500, 11)
    np.testing.assert_allclose(basis.T @ basis, (values @ values) * np.eye(11), atol=1e-9)
    # A constant, and the image itself, are among what they span.
    for target in (np.ones(500), values):
        assert np.linalg.lstsq(basis, target, rcond=None)[1] < 1e-15


def test_the_gradient_is_that_of_differences():
    post = posterior(shaded(FIXED), intensity_map=1, interpolation="cubic", t_similarity=5.0)
    assert_gradient(post.logdensity, post.initial(jax.random.key(0)))


def test_it_is_refused_with_a_map_in_every_window():
    with pytest.raises(ValueError, match="intensity_map"):
        br.ImagePair(FIXED, FIXED, similarity="lncc", intensity_map=1)


def test_fewer_points_weigh_as_much_as_all():
    every, some = posterior(FIXED), posterior(FIXED, most_points=200)
    assert len(some.images.fixed_values) == 200
    weights = [np.asarray(post.images.quadrature.weights) for post in (every, some)]
    assert weights[0].sum() == pytest.approx(weights[1].sum())
    again = posterior(FIXED, most_points=200)
    np.testing.assert_array_equal(again.images.positions, some.images.positions)


def test_both_images_are_smoothed():
    moving = smooth_image(MESH.points, seed=2)
    sd = 0.8 * FIXED.voxel_volume ** (1 / 3)
    smoothed = posterior(moving, smoothing=0.8)
    by_hand = posterior_of(FIXED.smoothed(sd), moving.smoothed(sd), MESH, quadrature="voxels")
    state = {"u_boundary": np.ones((len(MESH.boundary), 3)), "lam": np.ones(3), "mu": np.ones(3)}
    assert float(smoothed.evaluate(state).similarity_energy) == pytest.approx(
        float(by_hand.evaluate(state).similarity_energy)
    )
