"""The signed distance to the skull against geometry that is known, and against the nearest voxel."""

from __future__ import annotations

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from bayesreg.distance import signed_distance
from bayesreg.image import Image
from bayesreg.model.elastic.skull import is_allowed
from bayesreg.model.state import state_of
from tests.options import posterior_of
from tests.oracles.paper import in_skull
from tests.phantoms import ball_mesh, flat_skull, rotated_affine, smooth_image

CORNERS = np.array(list(product((-40.0, 40.0), repeat=3)))


def blobs(shape=(34, 22, 28), **kwargs):
    """Irregular forbidden region of about two fifths on a rotated, anisotropic, left-handed grid."""
    values = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=shape), 3)
    return Image((values > np.quantile(values, 0.6)).astype(np.uint8), rotated_affine(CORNERS, shape, **kwargs))


def sphere(radius, shape=(44, 52, 40)):
    """All forbidden but a ball about the origin."""
    empty = Image(np.zeros(shape), rotated_affine(CORNERS, shape, margin=2.0))
    return empty.with_voxels((np.linalg.norm(empty.grid_points(), axis=-1) > radius).astype(np.uint8))


@pytest.mark.parametrize("left_handed", [True, False])
def test_sign_is_that_of_the_nearest_voxel_away_from_the_interface(left_handed):
    skull = blobs(left_handed=left_handed)
    points = np.random.default_rng(1).uniform(-75, 75, (20_000, 3))
    voxel = np.linalg.norm(skull.voxel_sizes)
    distance = signed_distance(skull)
    away = abs(np.asarray(distance.interpolate(points))) > voxel
    expected = ~in_skull(skull.voxels, skull.affine, points)
    allowed = np.asarray(is_allowed(distance.interpolator("linear"), points))
    np.testing.assert_array_equal(allowed[away], expected[away])
    assert 100 < expected[away].sum() < away.sum() - 100
    # Near the interface the two may differ, by a fraction of a voxel: so many more, the more it is curved.
    assert (allowed == expected).mean() > 0.95


def test_every_voxel_centre_has_its_own_sign():
    skull = blobs()
    points = skull.grid_points().reshape(-1, 3)
    allowed = np.asarray(is_allowed(signed_distance(skull).interpolator("linear"), points))
    np.testing.assert_array_equal(allowed, skull.voxels.ravel() == 0)


def test_distance_to_a_flat_wall_is_exact_around_it():
    skull = flat_skull(CORNERS, axis=2, wall=7.0, voxel=2.0)
    x = np.random.default_rng(2).uniform((-20, -20, 4), (20, 20, 10), (200, 3))
    np.testing.assert_allclose(signed_distance(skull).interpolate(x), 7.0 - x[:, 2], atol=1e-9)


def test_distance_to_a_sphere():
    skull = sphere(30.0)
    x = np.random.default_rng(3).normal(size=(500, 3))
    x *= np.random.default_rng(4).uniform(24, 36, (500, 1)) / np.linalg.norm(x, axis=1, keepdims=True)
    distance = np.asarray(signed_distance(skull).interpolate(x))
    expected = 30.0 - np.linalg.norm(x, axis=1)
    assert abs(distance - expected).max() < skull.voxel_sizes.max()
    assert abs((distance - expected).mean()) < 0.25 * skull.voxel_sizes.max()


def test_nothing_is_allowed_off_the_grid():
    shape = (10, 10, 10)
    skull = Image(np.zeros(shape, np.uint8), rotated_affine(CORNERS, shape, margin=0.0))
    distance = signed_distance(skull).interpolator("linear")
    indices = np.random.default_rng(5).uniform(-6, 15, (4000, 3))
    inside = ((indices > -0.5) & (indices < 9.5)).all(axis=1)
    beyond = ((indices < -0.51) | (indices > 9.51)).any(axis=1)
    allowed = np.asarray(is_allowed(distance, skull.voxel_to_world(indices)))
    assert not allowed[beyond].any()
    # Edges and corners of the allowed box are rounded off a little, as the interface lies between centres.
    assert allowed[inside].mean() > 0.9
    assert allowed[((indices >= 0) & (indices <= 9)).all(axis=1)].all()


def test_a_slanted_wall_has_no_steps():
    # A staircase of one voxel in five: the distance's gradient, along the wall half a voxel inside, hardly turns.
    normal = np.array([1.0, 0.0, 5.0]) / np.sqrt(26)
    empty = Image(np.zeros((60, 20, 40), np.uint8), np.diag([1.0, 1.0, 1.0, 1.0]))
    wall = 25.3 * normal[2]
    skull = empty.with_voxels((empty.grid_points() @ normal > wall).astype(np.uint8))
    x = np.random.default_rng(6).uniform((10, 5, 0), (50, 15, 0), (300, 3))
    x[:, 2] = (wall - 0.5 - x[:, 0] * normal[0]) / normal[2]
    np.testing.assert_allclose(signed_distance(skull).interpolate(x), 0.5, atol=0.15)


def test_a_sheet_of_one_voxel_stays_closed():
    voxels = np.zeros((20, 20, 20), np.uint8)
    voxels[:, :, 10] = 1
    distance = signed_distance(Image(voxels, np.eye(4))).interpolator("linear")
    across = np.random.default_rng(7).uniform((2, 2, 10), (17, 17, 10), (500, 3))
    assert not np.asarray(is_allowed(distance, across)).any()


@pytest.mark.parametrize("left_handed", [True, False])
def test_the_distance_is_the_same_whatever_its_margin(left_handed):
    skull = blobs(left_handed=left_handed)
    near, far = signed_distance(skull, 4.0), signed_distance(skull, 25.0)
    assert np.all(np.subtract(far.shape, near.shape) > 20 / skull.voxel_sizes)
    assert np.all(near.shape > np.array(skull.shape))
    np.testing.assert_allclose(far.interpolate(near.grid_points()), near.voxels, atol=1e-9)


def test_a_body_that_has_strayed_is_led_back_as_far_as_the_margin():
    skull = flat_skull(CORNERS, axis=2, wall=7.0, voxel=2.0)
    x = np.array([[0.0, 0.0, 7.0 + d] for d in (1.0, 5.0, 10.0, 15.0)])
    np.testing.assert_allclose(signed_distance(skull, 16.0).interpolate(x), 7.0 - x[:, 2], atol=0.1)


def test_on_a_wide_grid_a_body_deep_in_the_skull_is_led_back():
    wide = Image(np.pad(np.zeros((10, 10, 10), np.uint8), 40, constant_values=1), np.eye(4))
    x = np.array([[45.0, 45.0, 49.5 + depth] for depth in (18.0, 25.0, 35.0)])
    np.testing.assert_allclose(signed_distance(wide).interpolate(x), 49.5 - x[:, 2], atol=0.2)


def soft(width=0.5):
    """A soft skull, and displacements that take some nodes into it."""
    mesh = ball_mesh(spacing=24.0)
    image = smooth_image(mesh.points, seed=1)
    wall = mesh.points[:, 2].max() + 1.0
    posterior = posterior_of(image, image, mesh, flat_skull(mesh.points, 2, wall), skull_width=width)
    u = np.zeros((len(posterior.sampled), 3))
    u[:, 2] = 3.0
    return posterior, {"u_boundary": u, "lam": np.ones(3), "mu": np.ones(3)}, wall


def test_a_soft_skull_lets_nodes_in_at_a_price():
    posterior, values, wall = soft()
    depth = np.maximum(posterior.mesh.points[posterior.sampled, 2] + 3.0 - wall, 0.0)
    assert 0 < (depth > 0).sum() < len(depth)
    assert float(posterior.energies(values)["skull"]) == pytest.approx(-0.5 * (depth**2).sum() / 0.25)
    assert posterior.target.hard_wall is None
    assert np.isfinite(posterior.evaluate(values).logdensity)
    outside = values | {"u_boundary": np.zeros_like(values["u_boundary"])}
    assert float(posterior.energies(outside)["skull"]) == 0


def test_the_curvature_of_a_soft_skull_is_that_of_its_log():
    posterior, values, _ = soft()
    term, filled = posterior.data.terms["skull"], posterior.fill(values)
    curvature = np.asarray(term.gauss_newton(posterior.evaluate(values).u, filled).matrices)

    def log(u):
        state = state_of(posterior.data.body, posterior.data.blocks, {**filled, "u_boundary": u})
        return -term.log(state)

    u = jnp.asarray(values["u_boundary"])
    slope = jax.jit(jax.grad(log))
    for row, axis in ((int(curvature[:, 2, 2].argmax()), 2), (0, 0), (0, 1)):
        step = jnp.zeros_like(u).at[row, axis].set(1e-3)
        expected = (slope(u + step) - slope(u - step)) / 2e-3
        np.testing.assert_allclose(curvature[row, axis], expected[row], atol=1e-6)
