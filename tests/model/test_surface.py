"""Points on a surface without partners, against a plane that moves along its normal, and brute force."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import bayesreg as br
from bayesreg.model.observations.surface import Surface
from tests.phantoms import ball_mesh, box_mesh

MESH = box_mesh(4)
TOP = MESH.points[:, 2].max()


def points_above(height, count=200, seed=0):
    """Points over the middle of the top of the box."""
    low, high = MESH.points.min(axis=0)[:2], MESH.points.max(axis=0)[:2]
    middle = np.random.default_rng(seed).uniform(low + 0.3 * (high - low), high - 0.3 * (high - low), (count, 2))
    return np.c_[middle, np.full(count, TOP + height)]


def lifted(height):
    return np.tile([0.0, 0.0, height], (len(MESH.points), 1))


def test_a_plane_that_moves_along_its_normal_has_a_gaussian_density():
    """Far from the edges of the top, log p(y | u) is log((1 − π)/A) and the log density of N(h, sd²)."""
    term = Surface(points_above(1.3), sd=0.4, outliers=1e-12).on(MESH).term
    area = sum(np.linalg.norm(np.cross(b - a, c - a)) / 2 for a, b, c in MESH.points[MESH.boundary_faces])
    # Within sd of a node, the shares of its triangles add up to more than one.
    from_nodes = np.linalg.norm(MESH.points[None, :, :2] - term.points[:, None, :2], axis=2).min(axis=1)
    for height in (0.0, 0.5, 1.3):
        expected = stats.norm(height, 0.4).logpdf(1.3) - np.log(area)
        density = np.asarray(term._log_densities(lifted(height), {})[1])
        np.testing.assert_allclose(density[from_nodes > 1.2], expected, atol=0.02)
        np.testing.assert_allclose(density, expected, atol=np.log(1.5))


def test_the_density_is_the_integral_over_a_bent_surface():
    """Brute force: the mean over many places of the surface of a ball."""
    ball = ball_mesh(radius=20.0, spacing=9.0)
    rng = np.random.default_rng(0)
    corners = ball.points[ball.boundary_faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    face = rng.choice(len(areas), 400_000, p=areas / areas.sum())
    places = np.einsum("ka,kai->ki", rng.dirichlet(np.ones(3), len(face)), corners[face])
    points = places[:20] + rng.normal(0, 1.5, (20, 3))
    density = [
        np.exp(-((point - places) ** 2).sum(axis=1) / (2 * 1.5**2)).mean() / (2 * np.pi * 1.5**2) ** 1.5
        for point in points
    ]
    term = Surface(points, sd=1.5, outliers=1e-12).on(ball).term
    np.testing.assert_allclose(term._log_densities(jnp.zeros(ball.points.shape), {})[1], np.log(density), atol=0.25)


def test_a_wrong_point_costs_no_more_than_its_share():
    far = np.vstack([points_above(0.0), [[5.0, 5.0, TOP + 80.0]]])
    term = Surface(far, sd=0.4).on(MESH).term
    slope = jax.grad(lambda u: term._log_densities(u, {})[1][-1])(jnp.zeros(MESH.points.shape))
    np.testing.assert_allclose(slope, 0.0, atol=1e-12)
    np.testing.assert_allclose(term._log_densities(lifted(0.0), {})[1][-1], term.log_outside, atol=1e-9)


def test_the_gradient_is_that_of_differences():
    ball = ball_mesh(radius=20.0, spacing=9.0)
    rng = np.random.default_rng(1)
    points = ball.points[ball.boundary][:25] * 1.05 + rng.normal(0, 0.5, (25, 3))
    term = Surface(points, sd=0.8).on(ball).term
    u, direction = rng.normal(0, 0.3, (2, *ball.points.shape))

    def density(u):
        return term._log_densities(u, {})[1].sum()

    difference = (density(u + 1e-5 * direction) - density(u - 1e-5 * direction)) / 2e-5
    np.testing.assert_allclose((jax.grad(density)(jnp.asarray(u)) * direction).sum(), difference, rtol=1e-5)


def test_the_curvature_is_that_of_a_plane_along_its_normal():
    term = Surface(points_above(0.2), sd=0.4, outliers=1e-9).on(MESH).term
    part = term.gauss_newton(np.zeros(MESH.points.shape), {})
    total = np.asarray(part.matrices).sum(axis=0)
    np.testing.assert_allclose(total, np.diag([0, 0, 200 / 0.4**2]), rtol=0.02, atol=0.02 * 200 / 0.4**2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": np.zeros((0, 3))}, "shape"),
        ({"points": [[1.0, 2.0, np.inf]]}, "finite"),
        ({"points": [[1.0, 2.0, 3.0]], "sd": -1.0}, "sd must be positive"),
        ({"points": [[1.0, 2.0, 3.0]], "outliers": 1.0}, "share between 0 and 1"),
    ],
)
def test_wrong_surfaces_are_told(arguments, message):
    with pytest.raises(br.InputError, match=message):
        Surface(**arguments)


def test_an_unknown_tissue_is_told():
    with pytest.raises(br.InputError, match="of: spleen is no tissue of the mesh; expected boundary or some of"):
        Surface(points_above(0.0), of="spleen").on(MESH)
