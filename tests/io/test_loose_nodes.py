"""Boundary nodes that few tetrahedra hold."""

import numpy as np
import pytest
from scipy.spatial import Delaunay

from bayesreg.io import meshing
from bayesreg.io.domain import MeshError
from bayesreg.io.fitting import depth_of_region
from bayesreg.io.loose_nodes import FEWEST, may_be_contracted, without_loose_nodes
from bayesreg.io.quality import EDGES, check_topology
from bayesreg.io.surfaces import depth_sizing
from bayesreg.mesh import FACES, TetMesh
from bayesreg.tissues import BRAIN
from tests.io.balls import balls, grid
from tests.phantoms import ball_mesh

BALL = ball_mesh(spacing=15.0)
POINTS, CELLS = BALL.points, BALL.cells


def with_ears(points, cells):
    """A tetrahedron on the first face of the boundary, another one on a face of that, and two on two other faces.

    These two share a node of their own.
    """
    mesh = TetMesh.from_arrays(points, cells, np.zeros(len(cells), int), ("all",))
    faces, middle = mesh.boundary_faces, points.mean(axis=0)
    first, second, third = len(points) + np.arange(3)
    away = next(face for face in faces[::-1] if not np.isin(face, faces[0]).any())
    beside = next(face for face in faces if np.isin(face, away).sum() == 2)

    def above(face, length):
        return points[face].mean(axis=0) + length * (points[face].mean(axis=0) - middle)

    added = [above(faces[0], 0.2), above(faces[0], 0.4), (above(away, 0.3) + above(beside, 0.3)) / 2]
    ears = [[*faces[0], first], [*faces[0][:2], first, second], [*away, third], [*beside, third]]
    points = np.vstack([points, added])
    return points, oriented(points, np.vstack([cells, ears]))


def oriented(points, cells):
    a, b, c, d = np.moveaxis(points[cells], 1, 0)
    inside_out = (np.cross(b - a, c - a) * (d - a)).sum(axis=1) < 0
    cells[inside_out] = cells[inside_out][:, [0, 2, 1, 3]]
    return cells


def mesh_of(points, cells):
    used, renumbered = np.unique(cells, return_inverse=True)
    return TetMesh.from_arrays(points[used], renumbered.reshape(-1, 4), np.zeros(len(cells), int), ("all",))


def held_by(mesh):
    return np.bincount(mesh.cells.ravel())[mesh.boundary]


def rows(array):
    return {tuple(row) for row in array.tolist()}


def test_ears_on_ears_are_cut_off():
    points, cells = without_loose_nodes(*with_ears(POINTS, CELLS))
    np.testing.assert_array_equal(points, POINTS)
    assert rows(np.sort(cells)) == rows(np.sort(CELLS))


def test_all_nodes_of_the_boundary_are_held_by_enough():
    cloud = np.random.default_rng(0).normal(size=(400, 3))
    cloud *= (10 * np.minimum(1, 1.5 / np.linalg.norm(cloud, axis=1)))[:, None]
    before = mesh_of(cloud, oriented(cloud, Delaunay(cloud).simplices.astype(int)))
    after = mesh_of(*without_loose_nodes(before.points, before.cells))
    assert (held_by(before) < FEWEST).sum() > 3
    assert (held_by(after) >= FEWEST).all()
    assert rows(after.points) < rows(before.points)
    assert check_topology(after) == check_topology(before) == 0
    assert 0.95 < after.volumes.sum() / before.volumes.sum() < 1.05


def test_a_node_inside_may_be_held_by_four():
    inner = POINTS[CELLS[0]].mean(axis=0)
    corners = np.array([np.where(np.arange(4) == k, len(POINTS), CELLS[0]) for k in range(4)])
    points, cells = np.vstack([POINTS, inner]), np.vstack([CELLS[1:], corners])
    assert len(without_loose_nodes(points, cells)[0]) == len(points)


@pytest.mark.long
def test_no_edge_may_be_contracted_that_changes_the_topology():
    """By the links, and by contracting it and looking at the whole mesh."""
    mesh = mesh_of(*with_ears(POINTS, CELLS))
    edges = np.unique(np.sort(mesh.cells[:, EDGES].reshape(-1, 2)), axis=0)
    # Some go through the inside from boundary to boundary: contracted, they would pinch the mesh.
    edges = edges[np.isin(edges, mesh.boundary).all(axis=1)]
    contractible = np.array(
        [(may_be_contracted(mesh.cells, a, b), stays_a_ball(mesh.cells, a, b)) for a, b in edges.tolist()]
    )
    by_links, by_topology = contractible.T
    assert not (by_links & ~by_topology).any()
    assert (~by_topology).sum() > 10
    assert (by_links & by_topology).sum() > 0.95 * by_topology.sum()


def stays_a_ball(cells, a, b):
    """Whether contracting ab leaves one ball, wherever its nodes may lie."""
    remaining = np.where(cells == a, b, cells)[~((cells == a).any(axis=1) & (cells == b).any(axis=1))]
    used, remaining = np.unique(remaining, return_inverse=True)
    remaining = remaining.reshape(-1, 4)
    faces, count = np.unique(np.sort(remaining[:, FACES].reshape(-1, 3), axis=1), axis=0, return_counts=True)
    edges = np.unique(np.sort(remaining[:, EDGES].reshape(-1, 2), axis=1), axis=0)
    distinct = len(rows(np.sort(remaining))) == len(remaining)
    if not distinct or count.max() > 2 or len(used) - len(edges) + len(faces) - len(remaining) != 1:
        return False
    mesh = TetMesh(np.zeros((len(used), 3)), remaining, np.zeros(len(remaining), int), ("all",))
    try:
        return check_topology(mesh) == 0
    except MeshError:
        return False


def test_a_mesh_without_loose_nodes_is_left_as_it_is():
    points, cells = without_loose_nodes(POINTS, CELLS)
    assert points is POINTS
    assert cells is CELLS


def test_a_lone_tetrahedron_is_a_mesh():
    points, cells = np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 1, 2, 3]])
    assert len(without_loose_nodes(points, cells)[1]) == 1


def test_no_mesh_of_a_brain_has_any(monkeypatch):
    """Whatever the mesher returns."""
    monkeypatch.setattr(meshing, "tetrahedralize", lambda *_, **__: with_ears(BALL.points, BALL.cells))
    monkeypatch.setattr(meshing, "tissue_of_cells", lambda points, cells, labels: np.zeros(len(cells), int))
    labels, _ = balls(grid())
    sizing, depth = depth_sizing(labels, 15.0, 30.0), depth_of_region(labels, 15.0)
    mesh = meshing._attempt(labels, BRAIN, [], labels, sizing, depth, None, 4.8, meshing.MeshOptions())
    assert (held_by(mesh) >= FEWEST).all()
