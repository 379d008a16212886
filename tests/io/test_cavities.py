"""Cavities inside a mesh, filled."""

import numpy as np
import pytest

from bayesreg.io.cavities import without_cavities
from bayesreg.io.surfaces import _kuhn_cells
from bayesreg.mesh import TetMesh
from tests.phantoms import ball_mesh


@pytest.fixture(scope="module")
def whole():
    return ball_mesh(spacing=13.0)


def as_mesh(points, cells):
    return TetMesh.from_arrays(points, cells, np.zeros(len(cells), int))


def deep_cells(mesh):
    return np.flatnonzero(~np.isin(mesh.cells, mesh.boundary).any(axis=1))


def neighbour(mesh, cell):
    """The deep cell with which a cell shares a face."""
    shared = [len(set(mesh.cells[cell]) & set(mesh.cells[candidate])) for candidate in deep_cells(mesh)]
    return deep_cells(mesh)[shared.index(3)]


def without(mesh, gone):
    return mesh.points, np.delete(mesh.cells, gone, axis=0)


def same_cells(a, b):
    return {frozenset(cell) for cell in a.tolist()} == {frozenset(cell) for cell in b.tolist()}


def test_a_whole_mesh_stays_as_it_is(whole):
    points, cells = without_cavities(whole.points, whole.cells)
    np.testing.assert_array_equal(points, whole.points)
    np.testing.assert_array_equal(cells, whole.cells)


def test_single_cells_are_put_back(whole):
    deep = deep_cells(whole)
    points, cells = without_cavities(*without(whole, deep[[0, -1]]))
    assert same_cells(cells, whole.cells)
    assert as_mesh(points, cells).volumes.sum() == pytest.approx(whole.volumes.sum())


@pytest.mark.parametrize("shared", [1, 2])
def test_a_cell_that_touches_the_surface_is_put_back(whole, shared):
    """Its walls meet the outer surface at a node or along an edge."""
    outer = {frozenset(face) for face in whole.boundary_faces.tolist()}
    buried = np.array([not any(face <= set(cell) for face in outer) for cell in whole.cells.tolist()])
    touching = np.isin(whole.cells, whole.boundary).sum(axis=1) == shared
    _, cells = without_cavities(*without(whole, np.flatnonzero(buried & touching)[0]))
    assert same_cells(cells, whole.cells)


def test_two_neighbours_are_replaced(whole):
    cell = deep_cells(whole)[0]
    points, cells = without_cavities(*without(whole, [cell, neighbour(whole, cell)]))
    mesh = as_mesh(points, cells)
    assert len(mesh.points) == len(whole.points) + 1
    assert len(mesh.cells) == len(whole.cells) + 4
    np.testing.assert_array_equal(mesh.boundary, whole.boundary)
    assert mesh.volumes.sum() == pytest.approx(whole.volumes.sum())


def test_two_cavities_that_share_an_edge_are_both_filled(whole):
    deep = deep_cells(whole)
    edge_mates = [(i, j) for i in deep for j in deep if i < j and len(set(whole.cells[i]) & set(whole.cells[j])) == 2]
    _, cells = without_cavities(*without(whole, edge_mates[0]))
    assert same_cells(cells, whole.cells)


def test_what_has_no_middle_stays_open():
    """A hole in the shape of a U."""
    points = np.stack(np.meshgrid(*[np.arange(6.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = _kuhn_cells((6, 6, 6), points)
    cube = np.floor(points[cells].mean(axis=1)).astype(int).tolist()
    bent = [[1, 1, 2], [1, 2, 2], [1, 3, 2], [2, 1, 2], [3, 1, 2], [3, 2, 2], [3, 3, 2]]
    rest = cells[[c not in bent for c in cube]]
    assert len(rest) == len(cells) - 6 * len(bent)
    np.testing.assert_array_equal(without_cavities(points, rest)[1], rest)
