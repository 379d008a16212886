"""Boundary nodes moved to a surface, and pulled clear of the skull."""

import numpy as np
import pytest

from bayesreg.distance import signed_distance
from bayesreg.image import Image
from bayesreg.io.domain import MeshError
from bayesreg.io.fitting import depth_of_region, fit_to_surface, pull_inside
from bayesreg.io.quality import mean_ratio
from bayesreg.mesh import TetMesh
from tests.phantoms import ball_mesh, box_mesh, flat_skull


def depth_of(radius: float, order: float, slices: float = 1.6) -> Image:
    """The depth below the surface of a ball (order 2) or a cube (order ∞), from voxels of 1.6 mm in slices."""
    axes = [np.arange(-40.0 + size / 2, 40.0, size) for size in (1.6, 1.6, slices)]
    inside = np.linalg.norm(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1), ord=order, axis=-1) < radius
    affine = np.diag([1.6, 1.6, slices, 1.0])
    affine[:3, 3] = [axis[0] for axis in axes]
    return depth_of_region(Image(inside.astype(np.uint8), affine), 12.0)


class TestFitToSurface:
    @pytest.mark.parametrize("slices", [1.6, 5.0])
    def test_a_ball_gets_its_volume(self, slices):
        mesh = ball_mesh(spacing=13.0)
        centre, radius = mesh.points.mean(axis=0), np.linalg.norm(mesh.points - mesh.points.mean(axis=0), axis=1).max()
        mesh = TetMesh.from_arrays((mesh.points - centre) * 29 / radius, mesh.cells, mesh.tissue, mesh.names)
        fitted = fit_to_surface(mesh, depth_of(30.0, 2, slices))
        ball = 4 / 3 * np.pi * 30**3
        assert mesh.volumes.sum() < 0.93 * ball
        assert fitted.volumes.sum() == pytest.approx(ball, rel=0.02)
        assert mean_ratio(fitted.points, fitted.cells).min() > 0.1

    def test_a_cube_gets_its_rim(self):
        """Edges and corners were cut off by a quarter of an edge length, as smoothing does."""
        mesh = box_mesh(5, size=60.0)
        points = mesh.points - 30.0
        points *= 1 - 0.06 * (np.abs(points) > 29).sum(axis=1, keepdims=True).clip(1) + 0.06
        cut = TetMesh.from_arrays(points, mesh.cells, mesh.tissue, mesh.names)
        fitted = fit_to_surface(cut, depth_of(30.0, np.inf))
        assert cut.volumes.sum() < 0.97 * 60**3
        assert fitted.volumes.sum() == pytest.approx(60**3, rel=0.01)


class TestPullInside:
    @pytest.mark.parametrize("depth", [1.0, 4.0, 10.0])
    def test_pulls_boundary_nodes_behind_a_wall(self, depth):
        mesh = ball_mesh(spacing=13.0)
        distance = signed_distance(flat_skull(mesh.points, axis=0, wall=mesh.points[:, 0].max() - depth))
        before = np.asarray(distance.interpolate(mesh.points))
        pulled = pull_inside(mesh, distance, 0.5)
        after = np.asarray(distance.interpolate(pulled.points[mesh.boundary]))
        assert before[mesh.boundary].min() < 0.5 <= after.min()
        assert (pulled.volumes > 0).all()
        assert mean_ratio(pulled.points, pulled.cells).min() > 0.5 * min(0.1, mean_ratio(mesh.points, mesh.cells).min())
        untouched = np.intersect1d(mesh.boundary, np.flatnonzero(before >= 0.5))
        np.testing.assert_array_equal(pulled.points[untouched], mesh.points[untouched])

    def test_a_node_drags_along_those_that_stop_it(self):
        """The top of a flat tetrahedron, whose base is inside already, would have to pass through it."""
        angle = np.radians([90, 210, 330])
        base = np.stack([12 * np.cos(angle), 12 * np.sin(angle), np.full(3, -1.0)], axis=1)
        points = np.array([[0.0, 0.0, 3.0], *base, [0.0, 0.0, -20.0]])
        mesh = TetMesh.from_arrays(points, np.array([[0, 1, 3, 2], [4, 1, 2, 3]]), np.zeros(2, int), ("gm",))
        distance = signed_distance(flat_skull(mesh.points, axis=2, wall=0.0))
        pulled = pull_inside(mesh, distance, 0.5)
        assert np.asarray(distance.interpolate(pulled.points)).min() >= 0.5
        assert (pulled.volumes > 0).all()

    def test_leaves_a_mesh_that_is_clear_alone(self):
        mesh = ball_mesh()
        distance = signed_distance(flat_skull(mesh.points, axis=0, wall=mesh.points[:, 0].max() + 2))
        assert pull_inside(mesh, distance, 0.5) is mesh

    def test_refuses_the_impossible(self):
        mesh = ball_mesh()
        distance = signed_distance(flat_skull(mesh.points, axis=0, wall=mesh.points[:, 0].min() + 8))
        with pytest.raises(MeshError, match=r"boundary nodes cannot be moved into the intracranial mask"):
            pull_inside(mesh, distance, 0.5)

    def test_refuses_a_mask_that_is_too_thin(self):
        mesh = ball_mesh()
        wall = flat_skull(mesh.points, axis=0, wall=0.0)
        thin = wall.with_voxels((np.arange(wall.shape[0]) != 30)[:, None, None] | (wall.voxels > 1))
        with pytest.raises(MeshError, match="nowhere thick enough"):
            pull_inside(mesh, signed_distance(thin.with_voxels(thin.voxels.astype(np.uint8))), 3.0)
