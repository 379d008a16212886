"""The tetrahedra of a region."""

import numpy as np
import pytest

from bayesreg.image import Image
from bayesreg.io.cells import cells_inside
from bayesreg.io.quality import check_topology, crowded_edges, pinched_nodes
from bayesreg.io.surfaces import _kuhn_cells
from bayesreg.mesh import TetMesh, boundary_faces_of


@pytest.fixture(scope="module")
def lattice():
    """Cubes of 1 mm, each of six tetrahedra."""
    points = np.stack(np.meshgrid(*[np.arange(9.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return points, _kuhn_cells((9, 9, 9), points)


def field_of(cubes):
    """An image of the cubes that are inside, a voxel each."""
    affine = np.eye(4)
    affine[:3, 3] = 0.5
    return Image(np.asarray(cubes, float), affine)


def chosen(lattice, cubes):
    points, cells = lattice
    inside = cells[cells_inside(points, cells, field_of(cubes))]
    used, index = np.unique(inside, return_inverse=True)
    return TetMesh.from_arrays(points[used], index.reshape(-1, 4), np.zeros(len(inside), int), ("all",))


def test_a_box_is_taken_as_it_is(lattice):
    cubes = np.zeros((8, 8, 8))
    cubes[2:6, 1:7, 2:5] = 1
    mesh = chosen(lattice, cubes)
    assert check_topology(mesh) == 0
    assert mesh.volumes.sum() == pytest.approx(cubes.sum(), rel=0.05)


def test_islands_are_left_out_and_holes_filled(lattice):
    cubes = np.zeros((8, 8, 8))
    cubes[1:6, 1:6, 1:6] = cubes[7, 7, 7] = 1
    cubes[3, 3, 3] = 0
    mesh = chosen(lattice, cubes)
    assert check_topology(mesh) == 0
    assert mesh.points.max() <= 6
    assert mesh.volumes.sum() == pytest.approx(125, rel=0.02)


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("kind", ["edge", "corner", "ring"])
def test_the_boundary_touches_itself_nowhere(lattice, kind, inverted):
    """Two blocks of a body, or of the air in it, that meet at an edge or a corner."""
    touching = np.zeros((8, 8, 8), bool)
    touching[2:4, 2:4, 2:5] = True
    touching[4:6, 4:6, 5 if kind == "corner" else 2 :][..., :3] = True
    cubes = np.zeros((8, 8, 8), bool)
    if inverted:
        cubes[1:7, 1:7, 1:8] = True
        cubes &= ~touching
        cubes[2:4, 2:4, :5] = cubes[4:6, 4:6, 2:] = False
    else:
        cubes |= touching
        if kind == "ring":
            cubes[2:4, 4:6, 2:4] = True
    mesh = chosen(lattice, cubes)
    assert check_topology(mesh) >= 0
    # One of two blocks may be lost where they are all of the body, and corners are.
    assert mesh.volumes.sum() == pytest.approx(cubes.sum(), rel=0.6 if kind != "ring" and not inverted else 0.15)


def test_random_cubes_get_a_manifold(lattice):
    random = np.random.default_rng(1)
    for _ in range(5):
        cubes = np.zeros((8, 8, 8), bool)
        cubes[1:7, 1:7, 1:7] = random.random((6, 6, 6)) < 0.6
        assert check_topology(chosen(lattice, cubes)) >= 0


def test_places_where_a_surface_touches_itself():
    two = {"edge": [[0, 1, 2, 3], [0, 1, 5, 4]], "node": [[0, 1, 2, 3], [0, 4, 6, 5]]}
    assert crowded_edges(boundary_faces_of(np.array(two["edge"]))).tolist() == [[0, 1]]
    assert pinched_nodes(boundary_faces_of(np.array(two["edge"]))).tolist() == []
    assert crowded_edges(boundary_faces_of(np.array(two["node"]))).tolist() == []
    assert pinched_nodes(boundary_faces_of(np.array(two["node"]))).tolist() == [0]
