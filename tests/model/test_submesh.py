"""What a mesh cannot follow, against the error of interpolation of fields that are known."""

from __future__ import annotations

import numpy as np

from bayesreg.fem.elements import gauss_quadrature
from bayesreg.model.submesh import discretisation_variance
from tests.phantoms import ball_mesh, refined

MESH = refined(refined(ball_mesh(spacing=30.0)))
LENGTH = 40.0


def smooth(x):
    """A displacement whose three components bend in different directions."""
    return np.stack([np.sin(x[:, 0] / LENGTH), np.cos(x[:, 1] / LENGTH), np.sin((x[:, 0] + x[:, 2]) / LENGTH)], axis=1)


def squared_error(mesh):
    """Of interpolation, its mean over each cell."""
    quadrature = gauss_quadrature(mesh, "gauss32")
    x = quadrature.positions(mesh)
    error = (smooth(x) - np.asarray(quadrature.interpolation(smooth(mesh.points)))) ** 2
    counts = np.bincount(quadrature.cells)
    return np.stack([np.bincount(quadrature.cells, component) for component in error.T], axis=1) / counts[:, None]


def test_a_linear_field_is_followed():
    u = MESH.points @ np.random.default_rng(0).normal(size=(3, 3)) + 1.0
    np.testing.assert_allclose(discretisation_variance(MESH, u), 0.0, atol=1e-20)


def test_it_is_the_error_of_interpolation_inside():
    inside = ~np.isin(MESH.cells, MESH.boundary).any(axis=1)
    variance = discretisation_variance(MESH, smooth(MESH.points))[inside].mean(axis=0)
    expected = squared_error(MESH)[inside].mean(axis=0)
    np.testing.assert_allclose(variance, expected, rtol=0.25)
