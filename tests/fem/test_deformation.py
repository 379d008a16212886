"""Deformations of a mesh there and back, against closed forms and against one another."""

import numpy as np
import pytest

from bayesreg.fem.deformation import Deformer
from tests.phantoms import ball_mesh, box_mesh


def _smooth(points, size):
    """A displacement of a few mm without folds."""
    x, y, z = points.T / 30
    return size * np.stack([np.sin(x + y), np.cos(y - 2 * z), np.sin(z) * np.cos(x)], axis=1)


def _around(mesh, count, margin, seed=0):
    low, high = mesh.points.min(axis=0) - margin, mesh.points.max(axis=0) + margin
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def test_an_affine_displacement_and_its_inverse_are_exact_inside():
    mesh = box_mesh(3)
    slope, offset = np.array([[0.1, 0.02, 0], [-0.05, 0.2, 0.1], [0.0, 0.1, -0.1]]), np.array([3.0, -2.0, 1.0])
    u, inner = mesh.points @ slope.T + offset, np.random.default_rng(0).uniform(0, 20, (500, 3))
    deformer = Deformer(mesh)
    weights = deformer.weights(inner)
    assert weights.inside.all()
    np.testing.assert_allclose(weights(u), inner @ slope.T + offset, atol=1e-12)
    points, _ = deformer.moved(u).sources(inner + inner @ slope.T + offset)
    np.testing.assert_allclose(points, inner, atol=1e-12)


@pytest.mark.parametrize("size", [0.5, 4.0])
def test_places_come_from_where_they_were(size):
    mesh = ball_mesh(spacing=13.0)
    points, deformer = _around(mesh, 3000, 15.0), Deformer(mesh)
    u = _smooth(mesh.points, size)
    weights, moved = deformer.weights(points), deformer.moved(u)
    assert moved.folded == 0
    assert 0.1 < weights.inside.mean() < 0.9
    back, of_back = moved.sources(points + weights(u))
    np.testing.assert_allclose(back, points, atol=1e-6)
    near_the_surface = np.abs(weights.beyond) < 1e-6
    assert (of_back.inside == weights.inside)[~near_the_surface].mean() > 0.999


def test_steps_from_near_by_lead_where_a_search_leads():
    mesh, rng = ball_mesh(spacing=13.0), np.random.default_rng(1)
    places, deformer = _around(mesh, 3000, 10.0), Deformer(mesh)
    mean = _smooth(mesh.points, 3.0)
    _, near = deformer.moved(mean).sources(places)
    other = deformer.moved(mean + 0.3 * rng.standard_normal(mean.shape))
    searched, at_search = other.sources(places)
    stepped, at_steps = other.sources(places, near)
    np.testing.assert_allclose(stepped, searched, atol=1e-6)
    assert (at_search.inside == at_steps.inside).all()
    rough, _ = other.sources(places, near, iterations=0)
    np.testing.assert_array_equal(rough[at_steps.inside], stepped[at_steps.inside])
    error = np.linalg.norm(rough - searched, axis=1)[~at_steps.inside]
    assert 0 < np.median(error) < 0.1


def test_beyond_the_mesh_the_displacement_is_that_of_the_nearest_point_of_the_surface():
    mesh = box_mesh(2)
    u = _smooth(mesh.points, 2.0)
    outside = np.array([[10.0, 7.0, 26.0], [-3.0, 4.0, 9.0], [25.0, 24.0, 22.0]])
    nearest = np.clip(outside, 0, 20)
    deformer = Deformer(mesh)
    weights = deformer.weights(outside)
    np.testing.assert_allclose(weights(u), deformer.weights(nearest)(u), atol=1e-9)
    np.testing.assert_allclose(weights.beyond, np.linalg.norm(outside - nearest, axis=1))
    assert (mesh.boundary_cells[:, None] == weights.cell).any(axis=0).all()


def test_values_keep_their_shape():
    mesh = box_mesh(2)
    weights = Deformer(mesh).weights(np.array([[4.0, 5.0, 6.0]]))
    draws = np.random.default_rng(0).standard_normal((len(mesh.points), 3, 7))
    np.testing.assert_allclose(weights(draws)[..., 2], weights(draws[..., 2]))


def test_a_fold_is_counted_and_places_in_it_come_from_an_upright_tetrahedron():
    mesh = box_mesh(3)
    node = mesh.interior[0]
    u = np.zeros_like(mesh.points)
    about = np.unique(mesh.cells[(mesh.cells == node).any(axis=1)])
    far = about[np.linalg.norm(mesh.points[about] - mesh.points[node], axis=1).argmax()]
    u[node] = 1.3 * (mesh.points[far] - mesh.points[node])
    deformer = Deformer(mesh)
    moved = deformer.moved(u)
    assert moved.folded > 0
    places = np.random.default_rng(0).uniform(0.5, 19.5, (2000, 3))
    points, weights = moved.sources(places)
    assert weights.inside.all()
    np.testing.assert_allclose(points + weights(u), places, atol=1e-9)
    _, near = deformer.moved(0 * u).sources(places)
    stepped, weights = moved.sources(places, near)
    np.testing.assert_allclose(stepped + weights(u), places, atol=1e-9)


def test_what_lies_across_a_face():
    mesh = box_mesh(2)
    for cell, row in enumerate(mesh.across):
        for corner, other in enumerate(row):
            face = set(mesh.cells[cell]) - {mesh.cells[cell, corner]}
            holders = [k for k in range(len(mesh.cells)) if face <= set(mesh.cells[k]) and k != cell]
            assert holders == ([] if other < 0 else [other])
    for face, cell in zip(mesh.boundary_faces, mesh.boundary_cells, strict=True):
        assert set(face) <= set(mesh.cells[cell])
