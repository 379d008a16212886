"""Surfaces of the tissues and the wanted edge length, on every kind of grid."""

import numpy as np
import pytest

from bayesreg.io.surfaces import depth_sizing, tissue_surfaces
from bayesreg.mesh import TetMesh
from tests.io.balls import CENTRE, RADII, balls, grid, volume_of

GRIDS = {
    "upright": {},
    "left-handed": {"flip": True},
    "oblique, anisotropic": {"sizes": (1.5, 2.5, 3.0), "angles": (20.0, -35.0, 50.0)},
}


class TestSurfaces:
    @pytest.mark.parametrize("kwargs", GRIDS.values(), ids=GRIDS.keys())
    def test_lie_at_their_radii_with_normals_outwards(self, kwargs):
        tissue, _ = balls(grid(**kwargs))
        outer, white, fluid = tissue_surfaces(tissue, 8.0)
        for surface, name in ((outer, "gm"), (white, "wm"), (fluid, "csf")):
            radius = np.linalg.norm(surface.points - CENTRE, axis=1)
            np.testing.assert_allclose(radius.mean(), RADII[name], atol=1.2)
            a, b, c = np.moveaxis(surface.points[surface.faces], 1, 0)
            outwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - CENTRE)
            assert (outwards > 0).mean() > 0.99

    def test_enclose_about_the_volume_of_their_labels(self, labels):
        outer, *_ = tissue_surfaces(labels, 6.0)
        assert outer.volume == pytest.approx(
            volume_of(labels, 1) + volume_of(labels, 2) + volume_of(labels, 3), rel=0.03
        )

    def test_are_closed_where_the_labels_touch_the_edge_of_the_grid(self):
        cut, _ = balls(grid(extent=56.0))
        for surface in tissue_surfaces(cut, 8.0):
            edges = np.sort(surface.faces[:, [(0, 1), (1, 2), (2, 0)]].reshape(-1, 2), axis=1)
            assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()

    def test_leave_out_what_is_too_small(self, labels):
        spotted = labels.voxels.copy()
        spotted[20:22, 20:22, 4:6] = 3
        with_spot = tissue_surfaces(labels.with_voxels(spotted), 8.0)
        assert [len(s.faces) for s in with_spot] == [len(s.faces) for s in tissue_surfaces(labels, 8.0)]


class TestSizing:
    def test_grows_with_depth_between_its_bounds(self, labels):
        sizing = depth_sizing(labels, 8.0, 20.0)
        radius = np.linalg.norm(sizing.points - CENTRE, axis=1)
        np.testing.assert_allclose(sizing.values[radius > 38], 8.0)
        np.testing.assert_allclose(sizing.values[radius < 10], 20.0)
        between = (radius > 22) & (radius < 32)
        np.testing.assert_allclose(sizing.values[between], 8.0 + 0.7 * (36 - radius[between]), atol=3.0)

    def test_background_mesh_fills_its_box(self, labels):
        sizing = depth_sizing(labels, 8.0, 20.0)
        box = np.ptp(sizing.points, axis=0)
        volumes = TetMesh.from_arrays(sizing.points, sizing.cells, np.zeros(len(sizing.cells), int)).volumes
        assert volumes.sum() == pytest.approx(box.prod())
        assert (sizing.points.min(axis=0) < CENTRE - 36).all()
        assert (sizing.points.max(axis=0) > CENTRE + 36).all()
