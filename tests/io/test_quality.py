"""Checks and figures of a mesh."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayesreg.image import Image
from bayesreg.io.domain import MeshError
from bayesreg.io.quality import check_mesh, dihedral_angles, mean_ratio
from bayesreg.mesh import TetMesh
from tests.io.balls import volume_of
from tests.phantoms import ball_mesh, box_mesh


def block_labels(mesh, voxel=1.0):
    """Labels of a mesh, voxel by voxel of its bounding box."""
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    affine = np.diag([voxel, voxel, voxel, 1.0])
    affine[:3, 3] = low + voxel / 2
    image = Image(np.zeros(np.rint((high - low) / voxel).astype(int)), affine)
    corner = mesh.points[mesh.cells]
    inverse = np.linalg.inv(corner[:, 1:] - corner[:, :1])
    points = image.grid_points().reshape(-1, 3)
    weights = np.einsum("pmi,mij->pmj", points[:, None] - corner[None, :, 0], inverse)
    inside = (weights > -1e-9).all(axis=2) & (weights.sum(axis=2) < 1 + 1e-9)
    value = np.where(inside.any(axis=1), 1 + mesh.tissue[inside.argmax(axis=1)], 0)
    return image.with_voxels(value.reshape(image.shape).astype(np.int8))


@pytest.fixture(scope="module")
def box():
    mesh = box_mesh(3)
    return mesh, block_labels(mesh)


def part_of(mesh, keep):
    used, cells = np.unique(mesh.cells[keep], return_inverse=True)
    return TetMesh.from_arrays(mesh.points[used], cells.reshape(-1, 4), mesh.tissue[keep])


class TestCheckMesh:
    def test_measures(self, box):
        mesh, labels = box
        quality = check_mesh(mesh, labels)
        assert (quality.nodes, quality.cells, quality.boundary_nodes) == (
            len(mesh.points),
            len(mesh.cells),
            len(mesh.boundary),
        )
        assert sum(quality.tissue_cells.values()) == len(mesh.cells)
        for index, name in enumerate(mesh.names):
            assert quality.tissue_volumes[name] == pytest.approx(mesh.volumes[mesh.tissue == index].sum())
            assert quality.label_volumes[name] == volume_of(labels, index + 1)

    def test_refuses_two_parts(self, box):
        mesh, labels = box
        both = TetMesh.from_arrays(
            np.vstack([mesh.points, mesh.points + 100]),
            np.vstack([mesh.cells, mesh.cells + len(mesh.points)]),
            np.tile(mesh.tissue, 2),
        )
        with pytest.raises(MeshError, match="the mesh has 2 separate parts"):
            check_mesh(both, labels)

    def test_refuses_a_cavity(self, box):
        mesh, labels = box
        inner = np.flatnonzero(~np.isin(mesh.cells, mesh.boundary).any(axis=1))
        with pytest.raises(MeshError, match="boundary has 2 separate surfaces"):
            check_mesh(part_of(mesh, np.arange(len(mesh.cells)) != inner[0]), labels)

    @pytest.mark.parametrize(
        ("points", "message"),
        [
            (
                [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]],
                "touches itself at 1 nodes",
            ),
            (
                [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1]],
                r"touches itself at 1 edges, the first at \(0, 0, 0\) mm",
            ),
        ],
        ids=["at a node", "along an edge"],
    )
    def test_refuses_pinches(self, box, points, message):
        cells = {7: [[0, 1, 2, 3], [0, 4, 6, 5]], 6: [[0, 1, 2, 3], [0, 1, 4, 5]]}[len(points)]
        mesh = TetMesh.from_arrays(np.array(points, float), np.array(cells), np.array([0, 1]))
        with pytest.raises(MeshError, match=message):
            check_mesh(mesh, box[1])

    def test_refuses_flat_cells(self, box):
        mesh, labels = box
        flat = TetMesh.from_arrays(mesh.points * (1, 1, 0.01), mesh.cells, mesh.tissue)
        with pytest.raises(MeshError, match="nearly flat: mean ratio"):
            check_mesh(flat, labels)

    def test_refuses_a_missing_tissue(self, box):
        mesh, labels = box
        without = TetMesh.from_arrays(mesh.points, mesh.cells, np.where(mesh.tissue == 0, 2, mesh.tissue))
        with pytest.raises(MeshError, match="no tetrahedron is csf"):
            check_mesh(without, labels)

    def test_refuses_other_volumes(self, box):
        mesh, labels = box
        swollen = labels.with_voxels(np.where(labels.grid_points()[..., 0] < 10, 2, labels.voxels))
        fine = TetMesh.from_arrays(mesh.points, mesh.cells, mesh.tissue)
        coarse = Image(swollen.voxels, np.diag([4.0, 4.0, 4.0, 1.0]))
        with pytest.raises(MeshError, match=r"the mesh holds 8\.0 ml of all|the mesh holds .* ml of (csf|gm|wm)"):
            check_mesh(fine, coarse)

    def test_counts_handles(self):
        mesh = box_mesh(5, jitter=0.0)
        centre = mesh.points[mesh.cells].mean(axis=1)
        ring = part_of(mesh, (np.abs(centre[:, :2] - 10) > 2).any(axis=1))
        assert check_mesh(ring, block_labels(ring)).genus == 1


class TestShape:
    def test_regular_tetrahedron(self):
        points = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
        cells = np.array([[0, 2, 1, 3]])
        assert TetMesh.from_arrays(points, cells, np.array([0])).volumes[0] > 0
        np.testing.assert_allclose(mean_ratio(points, cells), 1)
        np.testing.assert_allclose(dihedral_angles(points, cells), np.degrees(np.arccos(1 / 3)))

    def test_corner_of_a_cube(self):
        points = np.vstack([np.zeros(3), np.eye(3)])
        angles = np.sort(dihedral_angles(points, np.array([[0, 1, 2, 3]]))[0])
        np.testing.assert_allclose(angles, [np.degrees(np.arctan(2**0.5))] * 3 + [90] * 3)

    def test_does_not_depend_on_size_or_place(self):
        mesh = ball_mesh()
        turned = Rotation.from_rotvec([1.0, 2.0, 3.0]).apply(3 * mesh.points) + 50
        np.testing.assert_allclose(mean_ratio(turned, mesh.cells), mean_ratio(mesh.points, mesh.cells))

    def test_inverted_is_zero(self):
        mesh = ball_mesh()
        np.testing.assert_array_equal(mean_ratio(mesh.points, mesh.cells[:, (1, 0, 2, 3)]), 0)
