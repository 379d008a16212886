"""Point location against brute force, and nearest surface points against a cube's."""

import numpy as np
import pytest

from bayesreg.fem.location import closest_in_triangles, locate, nearest_on_surface, transfer
from tests.phantoms import ball_mesh, box_mesh


def _brute_force(points, cells, query):
    corners = points[cells]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    last = np.linalg.solve(edges[None], (query[:, None] - corners[:, 0])[..., None])[..., 0]
    inside = np.minimum(last.min(axis=-1), 1 - last.sum(axis=-1)) >= -1e-9
    return np.where(inside.any(axis=1), inside.argmax(axis=1), -1)


@pytest.mark.parametrize("spacing", [30.0, 18.0, 13.0])
@pytest.mark.parametrize("count", [1, 400, 3000])
def test_cells_equal_brute_force(spacing, count):
    mesh = ball_mesh(spacing=spacing)
    low, high = mesh.points.min(axis=0) - 10, mesh.points.max(axis=0) + 10
    query = np.random.default_rng(0).uniform(low, high, (count, 3))
    cell, barycentric = locate(mesh.points, mesh.cells, query)
    assert (cell == _brute_force(mesh.points, mesh.cells, query)).all()
    inside = cell >= 0
    assert count == 1 or 0.1 < inside.mean() < 0.9
    assert np.isnan(barycentric[~inside]).all()
    interpolated = np.einsum("ka,kai->ki", barycentric[inside], mesh.points[mesh.cells[cell[inside]]])
    np.testing.assert_allclose(interpolated, query[inside], atol=1e-10)


def test_points_on_shared_faces_edges_and_nodes_are_found():
    mesh = ball_mesh()
    weights = np.array([[1, 0, 0, 0], [1, 1, 0, 0], [2, 1, 1, 0]]) / [[1], [2], [4]]
    query = np.einsum("sa,mai->smi", weights, mesh.points[mesh.cells]).reshape(-1, 3)
    assert (locate(mesh.points, mesh.cells, query).cell >= 0).all()


def test_a_lattice_aligned_with_the_faces_of_a_cube_is_inside():
    mesh = box_mesh(cells_per_side=2, jitter=0.0)
    axis = np.linspace(0, 20, 9)
    query = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    assert (locate(mesh.points, mesh.cells, query).cell >= 0).all()
    assert (locate(mesh.points, mesh.cells, query + np.array([20.0 + 1e-5, 0, 0])).cell == -1).all()


def test_no_query_gives_nothing():
    mesh = box_mesh()
    cell, barycentric = locate(mesh.points, mesh.cells, np.empty((0, 3)))
    assert cell.shape == (0,)
    assert barycentric.shape == (0, 4)


def test_closest_points_of_triangles_equal_a_fine_search():
    rng = np.random.default_rng(1)
    corners, query = rng.normal(size=(60, 3, 3)), 2 * rng.normal(size=(60, 3))
    weights = closest_in_triangles(corners, query)
    assert (weights >= -1e-12).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    distance = np.linalg.norm(np.einsum("ka,kai->ki", weights, corners) - query, axis=1)
    lattice = np.array([(i, j, 100 - i - j) for i in range(101) for j in range(101 - i)]) / 100
    searched = np.linalg.norm(np.einsum("sa,kai->ksi", lattice, corners) - query[:, None], axis=2).min(axis=1)
    assert (distance <= searched + 1e-12).all()
    np.testing.assert_allclose(distance, searched, atol=2e-2)


def test_nearest_points_of_a_cube_are_clipped_coordinates():
    mesh = box_mesh(cells_per_side=3)
    query = np.random.default_rng(2).uniform(-15, 35, (500, 3))
    query = query[((query < 0) | (query > 20)).any(axis=1)]
    face, weight = nearest_on_surface(mesh.points, mesh.boundary_faces, query)
    nearest = np.einsum("ka,kai->ki", weight, mesh.points[mesh.boundary_faces[face]])
    np.testing.assert_allclose(nearest, query.clip(0, 20), atol=1e-9)


def test_transfer_is_linear_inside_and_constant_beyond_the_surface():
    mesh = box_mesh(cells_per_side=3)
    slope, offset = np.random.default_rng(3).normal(size=(3, 3)), np.array([1.0, -2.0, 3.0])
    query = np.random.default_rng(4).uniform(-10, 30, (400, 3))
    values = transfer(mesh.points @ slope + offset, mesh, query)
    np.testing.assert_allclose(values, query.clip(0, 20) @ slope + offset, atol=1e-9)
