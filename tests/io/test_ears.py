"""Tetrahedra that alone hold a node."""

import numpy as np

from bayesreg.io import meshing
from bayesreg.io.ears import without_ears
from bayesreg.io.surfaces import depth_sizing
from bayesreg.mesh import TetMesh
from tests.io.balls import balls, grid
from tests.phantoms import ball_mesh

BALL = ball_mesh(spacing=18.0)


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


def test_ears_on_ears_are_cut_off():
    points, cells = without_ears(*with_ears(BALL.points, BALL.cells))
    np.testing.assert_array_equal(points, BALL.points)
    np.testing.assert_array_equal(cells, BALL.cells)


def test_a_mesh_without_ears_is_left_as_it_is():
    assert (np.bincount(BALL.cells.ravel()) > 2).all()
    points, cells = without_ears(BALL.points, BALL.cells)
    assert points is BALL.points
    assert cells is BALL.cells


def test_a_lone_tetrahedron_is_a_mesh():
    points, cells = np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 1, 2, 3]])
    assert len(without_ears(points, cells)[1]) == 1


def test_no_mesh_of_a_brain_has_any(monkeypatch):
    """Whatever the mesher returns."""
    monkeypatch.setattr(meshing, "tetrahedralize", lambda *_, **__: with_ears(BALL.points, BALL.cells))
    monkeypatch.setattr(meshing, "tissue_of_cells", lambda points, cells, labels: np.zeros(len(cells), int))
    labels, _ = balls(grid())
    mesh = meshing._attempt(labels, [], depth_sizing(labels, 15.0, 30.0), None, meshing.MeshOptions())
    assert mesh.digest != BALL.digest
    np.testing.assert_array_equal(mesh.points, BALL.points)
