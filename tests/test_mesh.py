"""The mesh container: validation, boundary, volumes, identity."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayesreg.mesh import FACES, TetMesh, signed_volumes
from tests.phantoms import ball_mesh, box_mesh, refined

POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
CELLS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])


def two_tets() -> TetMesh:
    return TetMesh.from_arrays(POINTS, CELLS, np.array([0, 2]))


def test_neighbours_share_a_face():
    np.testing.assert_array_equal(np.sort(two_tets().neighbours, axis=1), [[0, 1]])
    mesh = ball_mesh(spacing=24)
    pairs = {frozenset(pair) for pair in mesh.neighbours.tolist()}
    shared = (mesh.cells[:, None, :, None] == mesh.cells[None, :, None, :]).sum(axis=(2, 3))
    assert pairs == {frozenset(pair) for pair in np.argwhere(shared == 3).tolist()}
    assert len(pairs) == len(mesh.neighbours)


class TestFromArrays:
    def test_keeps_what_it_is_given(self):
        mesh = two_tets()
        np.testing.assert_array_equal(mesh.points, POINTS)
        np.testing.assert_array_equal(mesh.cells, CELLS)
        np.testing.assert_array_equal(mesh.tissue, [0, 2])
        assert mesh.names == ("csf", "gm", "wm")

    def test_copies_its_input(self):
        points = POINTS.copy()
        mesh = TetMesh.from_arrays(points, CELLS, np.array([0, 0]))
        points += 1
        np.testing.assert_array_equal(mesh.points, POINTS)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"points": POINTS[:, :2]}, r"points must have shape \(n, 3\), got \(5, 2\)"),
            ({"cells": CELLS[:, :3]}, r"cells must have shape \(m, 4\)"),
            ({"cells": np.zeros((0, 4), int), "tissue": np.zeros(0, int)}, "m > 0"),
            ({"tissue": np.array([0])}, r"tissue must have shape \(2,\)"),
            ({"cells": CELLS.astype(float)}, "must be integers"),
            ({"tissue": np.array([0.0, 1.0])}, "must be integers"),
            ({"cells": CELLS + 1}, "cells name nodes 1 to 5, but there are 5 points"),
            ({"cells": CELLS - 1}, "cells name nodes -1 to 3"),
            ({"tissue": np.array([0, 3])}, "tissue holds 0 to 3, but names has 3 entries"),
            ({"tissue": np.array([-1, 0])}, "tissue holds -1 to 0"),
            ({"points": np.where(np.arange(15).reshape(5, 3) == 7, np.nan, POINTS)}, "node 2 has a coordinate"),
            ({"cells": CELLS[:, (1, 0, 2, 3)]}, "2 tetrahedra have no positive volume, the first is cell 0"),
            ({"points": POINTS * (1, 1, 0)}, "2 tetrahedra have no positive volume"),
            ({"cells": CELLS[:1], "tissue": np.array([0])}, "1 nodes belong to no tetrahedron, the first is node 4"),
        ],
    )
    def test_says_what_is_wrong(self, changes, message):
        arrays = {"points": POINTS, "cells": CELLS, "tissue": np.array([0, 2])}
        with pytest.raises(ValueError, match=message):
            TetMesh.from_arrays(**(arrays | changes))


def test_volumes_by_hand():
    np.testing.assert_allclose(two_tets().volumes, [1 / 6, 1 / 3])


def test_faces_point_outwards():
    normals = [np.cross(POINTS[b] - POINTS[a], POINTS[c] - POINTS[a]) for a, b, c in FACES]
    outwards = [POINTS[list(face)].mean(axis=0) - POINTS[:4].mean(axis=0) for face in FACES]
    assert all(normal @ outward > 0 for normal, outward in zip(normals, outwards, strict=True))


def test_boundary_leaves_the_shared_face_out():
    faces = {tuple(sorted(face)) for face in two_tets().boundary_faces.tolist()}
    assert len(faces) == 6
    assert (1, 2, 3) not in faces


@pytest.mark.parametrize("mesh", [ball_mesh(), box_mesh(3)], ids=["ball", "box"])
class TestSurface:
    def test_encloses_the_volume_of_the_cells(self, mesh):
        a, b, c = np.moveaxis(mesh.points[mesh.boundary_faces], 1, 0)
        assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(mesh.volumes.sum(), rel=1e-12)

    def test_nodes_are_split_into_boundary_and_interior(self, mesh):
        np.testing.assert_array_equal(np.union1d(mesh.boundary, mesh.interior), np.arange(len(mesh.points)))
        assert len(mesh.boundary) + len(mesh.interior) == len(mesh.points)

    def test_boundary_nodes_lie_outermost(self, mesh):
        distance = np.abs(mesh.points - mesh.points.mean(axis=0)).max(axis=1)
        assert distance[mesh.boundary].max() > distance[mesh.interior].max()


def test_box_has_its_boundary_on_its_faces():
    mesh = box_mesh(3)
    on_face = (np.isclose(mesh.points, 0) | np.isclose(mesh.points, 20)).any(axis=1)
    np.testing.assert_array_equal(mesh.boundary, np.flatnonzero(on_face))
    assert mesh.volumes.sum() == pytest.approx(20**3)


def test_refinement_keeps_the_volume_of_each_tissue():
    coarse = ball_mesh()
    fine = refined(coarse)
    for tissue in range(3):
        assert fine.volumes[fine.tissue == tissue].sum() == pytest.approx(coarse.volumes[coarse.tissue == tissue].sum())


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_volume_scales_with_the_determinant(seed):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(3, 3))
    volumes = signed_volumes(POINTS @ matrix.T + rng.normal(size=3), CELLS)
    np.testing.assert_allclose(volumes, np.linalg.det(matrix) * two_tets().volumes, rtol=1e-9, atol=1e-12)


class TestDigest:
    def test_is_the_same_for_the_same_content(self):
        assert two_tets().digest == TetMesh.from_arrays(POINTS.copy(), CELLS.astype(np.int32), np.array([0, 2])).digest

    @pytest.mark.parametrize(
        "changes",
        [
            {"points": POINTS + 1e-12 * (np.arange(15).reshape(5, 3) == 14)},
            {"cells": CELLS[:, (1, 2, 0, 3)]},
            {"tissue": np.array([0, 1])},
            {"names": ("a", "b", "c")},
            {"names": ("csf", "gm", "wm", "other")},
        ],
    )
    def test_changes_with_any_part(self, changes):
        arrays = {"points": POINTS, "cells": CELLS, "tissue": np.array([0, 2])}
        assert TetMesh.from_arrays(**(arrays | changes)).digest != two_tets().digest


class TestMoved:
    def test_moves_the_points_only(self):
        u = np.random.default_rng(0).normal(size=(5, 3)) * 0.05
        moved = two_tets().moved(u)
        np.testing.assert_allclose(moved.points, POINTS + u)
        np.testing.assert_array_equal(moved.cells, CELLS)

    def test_refuses_to_invert(self):
        u = np.zeros((5, 3))
        u[4] = -3.0
        with pytest.raises(ValueError, match="1 tetrahedra have no positive volume, the first is cell 1"):
            two_tets().moved(u)
