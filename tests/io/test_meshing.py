"""Labels to mesh: the region, the surfaces, fTetWild, the labels of cells, the gap to the skull, the files."""

import logging
from dataclasses import replace

import meshio
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayesreg.distance import signed_distance
from bayesreg.image import Image
from bayesreg.io import meshing, tetwild
from bayesreg.io.datasets import mni152
from bayesreg.io.fitting import pull_inside
from bayesreg.io.meshing import (
    MeshError,
    MeshOptions,
    build_mesh,
    check_mesh,
    domain_labels,
    load_mesh,
    mesh_domain,
    save_mesh,
    tissue_of_cells,
)
from bayesreg.io.quality import dihedral_angles, mean_ratio
from bayesreg.io.surfaces import depth_sizing, tissue_surfaces
from bayesreg.mesh import TetMesh
from tests.phantoms import ball_mesh, box_mesh

CENTRE = np.array([5.0, -3.0, 8.0])
RADII = {"csf": 12.0, "wm": 26.0, "gm": 36.0, "skull": 38.0}
OPTIONS = MeshOptions(edge_length=14.0, envelope=2.5)


def grid(sizes=(2.0, 2.0, 2.0), angles=(0.0, 0.0, 0.0), flip=False, extent=84.0):
    """Empty image about CENTRE."""
    shape = np.ceil(extent / np.array(sizes)).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix() * sizes
    affine[:3, 0] *= -1 if flip else 1
    affine[:3, 3] = CENTRE - affine[:3, :3] @ ((shape - 1) / 2)
    return Image(np.zeros(shape, np.int8), affine)


def balls(image):
    """A ball of CSF in a ball of WM in a ball of GM, inside a skull."""
    distance = np.linalg.norm(image.grid_points() - CENTRE, axis=-1)
    tissue = np.select([distance < RADII[name] for name in ("csf", "wm", "gm")], [1, 3, 2], 0)
    return image.with_voxels(tissue.astype(np.int8)), image.with_voxels((distance < RADII["skull"]).astype(np.uint8))


@pytest.fixture(scope="module")
def phantom():
    return balls(grid())


@pytest.fixture(scope="module")
def labels(phantom):
    return domain_labels(phantom[0], mesh_domain(*phantom))


@pytest.fixture(scope="module")
def mesh(phantom):
    return build_mesh(*phantom, OPTIONS)


def with_block(image, corner, size, value=1):
    voxels = image.voxels.copy()
    voxels[tuple(slice(c, c + size) for c in corner)] = value
    return image.with_voxels(voxels)


class TestDomain:
    def test_is_the_hull_with_its_inner_csf(self, phantom):
        domain = mesh_domain(*phantom).voxels
        np.testing.assert_array_equal(domain, phantom[0].voxels > 0)

    def test_closes_narrow_gaps_and_not_wide_ones(self):
        image = grid()
        tissue, _ = balls(image)
        x, _, z = np.moveaxis(image.grid_points() - CENTRE, -1, 0)
        narrow, wide = ((np.abs(x) < half) & (z > 14) for half in (5, 12))
        opened = [mesh_domain(tissue.with_voxels(np.where(gap, 0, tissue.voxels))).voxels for gap in (narrow, wide)]
        # At z = 20 the middle of the slit is 16 mm from the outer surface, which the closing cannot bridge.
        middle = np.linalg.norm(image.grid_points() - CENTRE - (0, 0, 20), axis=-1) < 2
        assert opened[0][middle].all()
        assert not opened[1][middle].any()

    @pytest.mark.parametrize("sizes", [(2.0, 2.0, 2.0), (1.5, 3.0, 4.0)])
    def test_closes_in_millimetres(self, sizes):
        image = grid(sizes)
        x = (image.grid_points() - CENTRE)[..., 0]
        distance = np.linalg.norm(image.grid_points() - CENTRE, axis=-1)
        slabs = np.where((distance < 30) & (np.abs(x) > 7), np.where(x > 0, 2, 3), 0)
        tissue = image.with_voxels(slabs.astype(np.int8))
        assert mesh_domain(tissue, closing=9.0).voxels[(distance < 4)].all()
        with pytest.raises(MeshError, match="region to mesh has 2 separate parts"):
            mesh_domain(tissue, closing=5.0)

    def test_stays_inside_the_intracranial_mask(self, phantom):
        tissue, inside = phantom
        cut = inside.with_voxels(inside.voxels * (tissue.grid_points()[..., 0] < CENTRE[0] + 20))
        domain = mesh_domain(tissue, cut).voxels
        assert domain.any()
        assert not domain[cut.voxels == 0].any()

    def test_needs_no_intracranial_mask(self, phantom):
        np.testing.assert_array_equal(mesh_domain(phantom[0]).voxels, phantom[0].voxels > 0)

    def test_drops_specks_and_says_so(self, phantom, caplog):
        tissue, inside = phantom
        speckled = with_block(with_block(inside, (0, 0, 0), 2), (40, 40, 0), 1)
        with caplog.at_level(logging.INFO):
            domain = mesh_domain(tissue, speckled)
        np.testing.assert_array_equal(domain.voxels, tissue.voxels > 0)
        assert "2 specks of the intracranial mask left out, 9 voxels together" in caplog.text

    def test_refuses_a_mask_in_large_parts(self, phantom):
        tissue, inside = phantom
        with pytest.raises(MeshError, match=r"intracranial mask has 2 separate parts \(93%, 7% of its volume\)"):
            mesh_domain(tissue, with_block(inside, (0, 0, 0), 13, 1).with_voxels(split(inside)))

    def test_refuses_an_empty_mask(self, phantom):
        with pytest.raises(MeshError, match="intracranial mask is empty"):
            mesh_domain(phantom[0], phantom[1].with_voxels(phantom[1].voxels * 0))

    @pytest.mark.parametrize(("index", "name"), [(2, "gm"), (3, "wm")])
    def test_refuses_a_missing_tissue(self, phantom, index, name):
        tissue = phantom[0].with_voxels(np.where(phantom[0].voxels == index, 1, phantom[0].voxels))
        with pytest.raises(MeshError, match=f"holds no {name} "):
            mesh_domain(tissue)

    def test_refuses_a_mask_elsewhere(self, phantom):
        tissue, inside = phantom
        elsewhere = inside.with_voxels(inside.voxels * (tissue.grid_points()[..., 0] > CENTRE[0] + 10))
        with pytest.raises(MeshError, match="more than half of the GM and WM lies outside the intracranial mask"):
            mesh_domain(tissue, elsewhere)

    def test_refuses_another_grid(self, phantom):
        with pytest.raises(ValueError, match="the tissue and the intracranial image must share one grid"):
            mesh_domain(phantom[0], balls(grid((3.0, 3.0, 3.0)))[1])
