"""Boundary nodes pulled clear of the skull."""

import numpy as np
import pytest

from bayesreg.distance import signed_distance
from bayesreg.io.domain import MeshError
from bayesreg.io.fitting import pull_inside
from bayesreg.io.quality import mean_ratio
from tests.phantoms import ball_mesh, flat_skull


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

    def test_leaves_a_mesh_that_is_clear_alone(self):
        mesh = ball_mesh()
        distance = signed_distance(flat_skull(mesh.points, axis=0, wall=mesh.points[:, 0].max() + 2))
        assert pull_inside(mesh, distance, 0.5) is mesh

    def test_refuses_the_impossible(self):
        mesh = ball_mesh()
        distance = signed_distance(flat_skull(mesh.points, axis=0, wall=mesh.points[:, 0].min() + 8))
        with pytest.raises(MeshError, match=r"boundary nodes cannot be moved to 0\.5 mm inside the intracranial mask"):
            pull_inside(mesh, distance, 0.5)

    def test_refuses_a_mask_that_is_too_thin(self):
        mesh = ball_mesh()
        wall = flat_skull(mesh.points, axis=0, wall=0.0)
        thin = wall.with_voxels((np.arange(wall.shape[0]) != 30)[:, None, None] | (wall.voxels > 1))
        with pytest.raises(MeshError, match="nowhere thick enough"):
            pull_inside(mesh, signed_distance(thin.with_voxels(thin.voxels.astype(np.uint8))), 3.0)
