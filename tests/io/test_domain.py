"""The region to mesh: closing, holes, parts, the intracranial mask."""

import logging

import numpy as np
import pytest

from bayesreg.io.domain import MeshError, domain_labels, mesh_domain, without_ridges
from tests.io.balls import balls, grid, offset_from_centre


class TestDomain:
    def test_is_the_hull_with_its_inner_csf(self, phantom):
        np.testing.assert_array_equal(mesh_domain(*phantom).voxels, phantom[0].voxels > 0)

    def test_needs_no_intracranial_mask(self, phantom):
        np.testing.assert_array_equal(mesh_domain(phantom[0]).voxels, phantom[0].voxels > 0)

    @pytest.mark.parametrize("sizes", [(2.0, 2.0, 2.0), (1.5, 3.0, 4.0)])
    @pytest.mark.parametrize(("half_width", "closed"), [(5.0, True), (12.0, False)])
    def test_closes_slits_by_their_width_in_millimetres(self, sizes, half_width, closed):
        tissue, _ = balls(grid(sizes))
        x, y, z = offset_from_centre(tissue)
        slit = (np.abs(x) < half_width) & (z > 14)
        domain = mesh_domain(tissue.with_voxels(np.where(slit, 0, tissue.voxels))).voxels
        middle = (np.abs(x) < 2) & (np.abs(y) < 4) & (np.abs(z - 24) < 4)
        assert domain[middle].all() == closed
        assert domain[middle].any() == closed

    def test_stays_inside_the_intracranial_mask(self, phantom):
        tissue, inside = phantom
        cut = inside.with_voxels(inside.voxels * (offset_from_centre(tissue)[0] < 20))
        np.testing.assert_array_equal(mesh_domain(tissue, cut).voxels, (tissue.voxels > 0) & (cut.voxels > 0))

    def test_drops_specks_and_says_so(self, phantom, caplog):
        tissue, inside = phantom
        speckled = inside.voxels.copy()
        speckled[:2, :2, :2] = speckled[0, 0, -1] = 1
        with caplog.at_level(logging.INFO):
            domain = mesh_domain(tissue, inside.with_voxels(speckled))
        np.testing.assert_array_equal(domain.voxels, tissue.voxels > 0)
        assert "2 separate parts of the intracranial mask left out, 0.072 ml together, about (-35" in caplog.text

    def test_refuses_a_mask_in_large_parts(self, phantom):
        tissue, inside = phantom
        x = offset_from_centre(tissue)[0]
        parted = inside.with_voxels(inside.voxels * ((x < 16) | (x > 20)))
        with pytest.raises(MeshError, match=r"intracranial mask has 2 separate parts \(\d+%, \d+% of its volume\)"):
            mesh_domain(tissue, parted)

    def test_refuses_an_empty_mask(self, phantom):
        with pytest.raises(MeshError, match="intracranial mask is empty"):
            mesh_domain(phantom[0], phantom[1].with_voxels(phantom[1].voxels * 0))

    @pytest.mark.parametrize(("index", "name"), [(2, "gm"), (3, "wm")])
    def test_refuses_a_missing_tissue(self, phantom, index, name):
        tissue = phantom[0].with_voxels(np.where(phantom[0].voxels == index, 1, phantom[0].voxels))
        with pytest.raises(MeshError, match=f"holds no {name} "):
            mesh_domain(tissue)

    def test_refuses_a_brain_without_csf(self, phantom):
        solid = phantom[0].with_voxels(np.where(phantom[0].voxels == 1, 3, phantom[0].voxels))
        with pytest.raises(MeshError, match="region to mesh holds no csf"):
            domain_labels(solid, mesh_domain(solid))

    def test_refuses_a_mask_elsewhere(self, phantom):
        tissue, inside = phantom
        elsewhere = inside.with_voxels(inside.voxels * (offset_from_centre(tissue)[0] > 10))
        with pytest.raises(MeshError, match="more than half of GM and WM lies outside the intracranial mask"):
            mesh_domain(tissue, elsewhere)

    def test_refuses_another_grid(self, phantom):
        with pytest.raises(ValueError, match="the tissue and the intracranial image must share one grid"):
            mesh_domain(phantom[0], balls(grid((3.0, 3.0, 3.0)))[1])

    def test_counts_what_is_neither_gm_nor_wm_as_csf(self, phantom):
        tissue, inside = phantom
        hollow = tissue.with_voxels(np.where(tissue.voxels == 1, 0, tissue.voxels))
        np.testing.assert_array_equal(domain_labels(hollow, mesh_domain(hollow, inside)).voxels, tissue.voxels)


class TestWithoutRidges:
    def test_takes_ridges_and_pits_of_a_voxel_and_leaves_the_rest(self, phantom):
        _, inside = phantom
        middle = np.array(inside.shape) // 2
        smooth = without_ridges(inside)
        top = np.flatnonzero(smooth.voxels[middle[0], middle[1]])[-1]
        rough = smooth.voxels.copy()
        rough[middle[0], :, top + 1] = 1
        rough[middle[0] + 5, middle[1], top - 4 : top + 1] = 0
        cleaned = without_ridges(smooth.with_voxels(rough)).voxels
        assert cleaned[middle[0], 1, top + 1] == 0
        assert cleaned[middle[0] + 5, middle[1], top - 1] == 1
        assert (cleaned != smooth.voxels).mean() < 1e-3

    def test_moves_a_flat_wall_nowhere(self, phantom):
        _, inside = phantom
        half = inside.with_voxels((offset_from_centre(inside)[0] < 7).astype(np.uint8))
        np.testing.assert_array_equal(without_ridges(half).voxels, half.voxels)
