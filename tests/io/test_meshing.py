"""Labels to mesh: the region, the surfaces, fTetWild, the tissue of cells, the gap to the skull, the files."""

import logging
from dataclasses import replace

import meshio
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayesreg.distance import signed_distance
from bayesreg.image import Image
from bayesreg.io import meshing, tetwild
from bayesreg.io.datasets import brainweb, mni152
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
from tests.io.test_datasets import needs_brainweb
from tests.phantoms import ball_mesh, box_mesh, flat_skull

CENTRE = np.array([5.0, -3.0, 8.0])
RADII = {"csf": 12.0, "wm": 26.0, "gm": 36.0, "skull": 38.0}
OPTIONS = MeshOptions(edge_length=16.0, envelope=4.0)


def grid(sizes=(2.0, 2.0, 2.0), angles=(0.0, 0.0, 0.0), flip=False, extent=84.0):
    """Empty image about CENTRE."""
    shape = np.ceil(extent / np.array(sizes)).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix() * sizes
    affine[:3, 0] *= -1 if flip else 1
    affine[:3, 3] = CENTRE - affine[:3, :3] @ ((shape - 1) / 2)
    return Image(np.zeros(shape, np.int8), affine)


def offset_from_centre(image):
    return np.moveaxis(image.grid_points() - CENTRE, -1, 0)


def balls(image):
    """A ball of CSF in a ball of WM in a ball of GM, inside a skull."""
    distance = np.linalg.norm(offset_from_centre(image), axis=0)
    tissue = np.select([distance < RADII[name] for name in ("csf", "wm", "gm")], [1, 3, 2], 0)
    return image.with_voxels(tissue.astype(np.int8)), image.with_voxels((distance < RADII["skull"]).astype(np.uint8))


def litres(image, value):
    return np.count_nonzero(image.voxels == value) * image.voxel_volume


@pytest.fixture(scope="module")
def phantom():
    return balls(grid())


@pytest.fixture(scope="module")
def labels(phantom):
    return domain_labels(phantom[0], mesh_domain(*phantom))


@pytest.fixture(scope="module")
def mesh(phantom):
    return build_mesh(*phantom, OPTIONS)


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
        assert "2 specks of the intracranial mask left out, 9 voxels together" in caplog.text

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
            build_mesh(solid)

    def test_refuses_a_mask_elsewhere(self, phantom):
        tissue, inside = phantom
        elsewhere = inside.with_voxels(inside.voxels * (offset_from_centre(tissue)[0] > 10))
        with pytest.raises(MeshError, match="more than half of the GM and WM lies outside the intracranial mask"):
            mesh_domain(tissue, elsewhere)

    def test_refuses_another_grid(self, phantom):
        with pytest.raises(ValueError, match="the tissue and the intracranial image must share one grid"):
            mesh_domain(phantom[0], balls(grid((3.0, 3.0, 3.0)))[1])

    def test_counts_what_is_neither_gm_nor_wm_as_csf(self, phantom):
        tissue, inside = phantom
        hollow = tissue.with_voxels(np.where(tissue.voxels == 1, 0, tissue.voxels))
        np.testing.assert_array_equal(domain_labels(hollow, mesh_domain(hollow, inside)).voxels, tissue.voxels)


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
        assert outer.volume == pytest.approx(litres(labels, 1) + litres(labels, 2) + litres(labels, 3), rel=0.03)

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


class TestBuildMesh:
    def test_every_tissue_has_its_place(self, mesh):
        radius = np.linalg.norm(mesh.points[mesh.cells].mean(axis=1) - CENTRE, axis=1)
        csf, gm, wm = (np.average(radius[mesh.tissue == t], weights=mesh.volumes[mesh.tissue == t]) for t in range(3))
        assert csf < 12 < wm < 26 < gm < 36

    def test_follows_the_outer_surface(self, mesh):
        radius = np.linalg.norm(mesh.points[mesh.boundary] - CENTRE, axis=1)
        np.testing.assert_allclose(radius, 36, atol=OPTIONS.envelope + 0.5)

    def test_passes_its_checks(self, mesh, labels):
        quality = check_mesh(mesh, labels)
        assert quality.genus == 0
        assert quality.nodes == len(mesh.points) > quality.boundary_nodes > 40
        assert min(quality.tissue_cells.values()) >= 10
        assert 10 < quality.edge_length < 18

    def test_boundary_nodes_keep_clear_of_the_skull(self, mesh, phantom):
        distance = signed_distance(phantom[1].with_voxels(1 - phantom[1].voxels))
        assert np.asarray(distance.interpolate(mesh.points[mesh.boundary])).min() >= OPTIONS.skull_gap

    def test_works_on_a_left_handed_oblique_anisotropic_grid(self):
        tissue, inside = balls(grid((1.5, 2.5, 3.0), (20.0, -35.0, 50.0), flip=True))
        mesh = build_mesh(tissue, inside, OPTIONS)
        assert (mesh.volumes > 0).all()
        centre = np.average(mesh.points[mesh.cells].mean(axis=1), weights=mesh.volumes, axis=0)
        np.testing.assert_allclose(centre, CENTRE, atol=1.0)
        assert mesh.volumes.sum() == pytest.approx(4 / 3 * np.pi * 36**3, rel=0.2)

    def test_works_where_the_labels_touch_the_edge_of_the_grid(self):
        tissue, _ = balls(grid(extent=60.0))
        mesh = build_mesh(tissue, None, OPTIONS)
        assert mesh.volumes.sum() == pytest.approx(np.count_nonzero(tissue.voxels) * tissue.voxel_volume, rel=0.2)
        assert tissue.contains(mesh.points).mean() > 0.5

    def test_leaves_neither_files_nor_words_behind(self, phantom, tmp_path, monkeypatch, capfd):
        monkeypatch.chdir(tmp_path)
        surfaces = tissue_surfaces(phantom[0], 20.0)
        tetwild.tetrahedralize(surfaces, depth_sizing(phantom[0], 20.0, 30.0), envelope=5.0, threads=1)
        assert not list(tmp_path.iterdir())
        assert capfd.readouterr() == ("", "")

    def test_tries_again_where_a_mesh_is_not_sound(self, phantom, mesh, monkeypatch, caplog):
        results = iter([MeshError("no luck"), (mesh.points, mesh.cells)])

        def sometimes(*args, **kwargs):
            result = next(results)
            if isinstance(result, MeshError):
                raise result
            return result

        monkeypatch.setattr(meshing, "tetrahedralize", sometimes)
        again = build_mesh(*phantom, OPTIONS)
        np.testing.assert_array_equal(again.points, mesh.points)
        assert "mesh 1 of at most 3 is not sound: no luck" in caplog.text

    def test_gives_up_after_the_last_attempt(self, phantom, monkeypatch):
        monkeypatch.setattr(tetwild, "_PROGRAM", "import sys; sys.exit('out of luck')")
        with pytest.raises(MeshError, match=r"none of 2 meshes is sound.*fTetWild failed \(exit 1: out of luck\)"):
            build_mesh(*phantom, replace(OPTIONS, attempts=2))

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"edge_length": 0.0}, "edge_length must be positive, got 0"),
            ({"envelope": -1.0}, "envelope must be positive, got -1"),
            ({"skull_gap": -0.5}, "skull_gap must not be negative"),
            ({"attempts": 0}, "attempts must be positive"),
            ({"edge_length": float("nan")}, "edge_length must be positive, got nan"),
            ({"edge_length": 20.0, "inner_edge_length": 10.0}, r"at least edge_length \(20 mm\), got 10"),
        ],
    )
    def test_refuses_senseless_options(self, options, message):
        with pytest.raises(ValueError, match=message):
            MeshOptions(**options)


class TestMissingCells:
    def test_puts_back_single_cells(self):
        whole = ball_mesh()
        outer = {frozenset(face) for face in whole.boundary_faces.tolist()}
        buried = [not any(face <= set(cell) for face in outer) for cell in whole.cells.tolist()]
        inner = np.isin(whole.cells, whole.boundary).sum(axis=1) == 0
        # One deep inside, and one that touches the surface.
        gone = np.isin(np.arange(len(whole.cells)), (inner.argmax(), (buried & ~inner).argmax()))
        assert gone.sum() == 2
        completed = tetwild._completed(whole.points, whole.cells[~gone])
        mesh = TetMesh.from_arrays(whole.points, completed, np.zeros(len(completed), int))
        assert {frozenset(cell) for cell in mesh.cells.tolist()} == {frozenset(cell) for cell in whole.cells.tolist()}
        assert mesh.volumes.sum() == pytest.approx(whole.volumes.sum())

    def test_adds_nothing_to_a_whole_mesh(self):
        mesh = ball_mesh()
        np.testing.assert_array_equal(tetwild._completed(mesh.points, mesh.cells), mesh.cells)


class TestTissueOfCells:
    def test_is_the_majority(self):
        mesh = box_mesh(3, size=20.0)
        voxels = np.ones((20, 20, 20), np.int8)
        voxels[7:] = 3
        affine = np.eye(4)
        affine[:3, 3] = 0.5
        tissue = tissue_of_cells(mesh.points, mesh.cells, Image(voxels, affine))
        points = np.random.default_rng(0).dirichlet(np.ones(4), 4000) @ mesh.points[mesh.cells]
        share = (points[..., 0] > 7).mean(axis=1)
        clear = np.abs(share - 0.5) > 0.05
        assert 0 < (share > 0.5)[clear].mean() < 1
        np.testing.assert_array_equal(tissue[clear], np.where(share[clear] > 0.5, 2, 0))

    def test_counts_all_beyond_the_labels_as_csf(self):
        mesh = box_mesh(2)
        image = Image(np.full((3, 3, 3), 2, np.int8), np.diag([-1.0, -1.0, -1.0, 1.0]))
        np.testing.assert_array_equal(tissue_of_cells(mesh.points, mesh.cells, image), 0)


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
            assert quality.label_volumes[name] == litres(labels, index + 1)

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
            ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1]], "1 edges of the boundary"),
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


class TestFiles:
    def test_round_trip(self, tmp_path):
        mesh = TetMesh.from_arrays(
            *(getattr(ball_mesh(), name) for name in ("points", "cells", "tissue")), ("a", "gm", "µ")
        )
        save_mesh(mesh, tmp_path / "mesh.vtu")
        loaded = load_mesh(tmp_path / "mesh.vtu")
        assert loaded.digest == mesh.digest
        assert loaded.names == ("a", "gm", "µ")

    def test_carries_further_data_of_the_nodes(self, tmp_path):
        mesh = ball_mesh()
        u = np.random.default_rng(0).normal(size=mesh.points.shape)
        save_mesh(mesh, tmp_path / "mesh.vtu", point_data={"u_mean": u, "count": np.arange(len(u))})
        data = meshio.read(tmp_path / "mesh.vtu").point_data
        np.testing.assert_array_equal(data["u_mean"], u)
        np.testing.assert_array_equal(data["count"], np.arange(len(u)))
        assert load_mesh(tmp_path / "mesh.vtu").digest == mesh.digest

    def test_reads_files_without_names(self, tmp_path):
        mesh = ball_mesh()
        meshio.Mesh(mesh.points, [("tetra", mesh.cells)], cell_data={"tissue": [mesh.tissue]}).write(tmp_path / "a.vtu")
        assert load_mesh(tmp_path / "a.vtu").digest == mesh.digest

    def test_a_failing_write_leaves_the_old_file(self, tmp_path, monkeypatch):
        save_mesh(ball_mesh(), tmp_path / "mesh.vtu")

        def fail(path, names):
            raise OSError("disk full")

        monkeypatch.setattr(meshing, "_insert_names", fail)
        with pytest.raises(OSError, match="disk full"):
            save_mesh(box_mesh(), tmp_path / "mesh.vtu")
        assert load_mesh(tmp_path / "mesh.vtu").digest == ball_mesh().digest
        assert [path.name for path in tmp_path.iterdir()] == ["mesh.vtu"]

    def test_refuses_other_names(self, tmp_path):
        with pytest.raises(ValueError, match=r"must end in \.vtu"):
            save_mesh(ball_mesh(), tmp_path / "mesh.stl")

    def test_refuses_a_folder_that_is_not_there(self, tmp_path):
        with pytest.raises(ValueError, match="there is no folder"):
            save_mesh(ball_mesh(), tmp_path / "missing" / "mesh.vtu")

    def test_refuses_data_of_another_length(self, tmp_path):
        with pytest.raises(ValueError, match=r"u must have 122 rows, one per node; got shape \(5, 3\)"):
            save_mesh(ball_mesh(), tmp_path / "mesh.vtu", point_data={"u": np.zeros((5, 3))})

    def test_refuses_a_missing_file(self, tmp_path):
        with pytest.raises(ValueError, match=r"missing\.vtu: there is no such file"):
            load_mesh(tmp_path / "missing.vtu")

    @pytest.mark.parametrize("content", ["not a mesh", "<VTKFile", "<VTKFile type='UnstructuredGrid' version='0.1'/>"])
    def test_refuses_what_is_no_mesh(self, tmp_path, content):
        (tmp_path / "mesh.vtu").write_text(content)
        with pytest.raises(ValueError, match=r"mesh\.vtu cannot be read"):
            load_mesh(tmp_path / "mesh.vtu")

    def test_refuses_triangles(self, tmp_path):
        meshio.Mesh(np.eye(3), [("triangle", [[0, 1, 2]])]).write(tmp_path / "a.vtu")
        with pytest.raises(ValueError, match="must consist of tetrahedra, got triangle"):
            load_mesh(tmp_path / "a.vtu")

    def test_refuses_cells_without_tissue(self, tmp_path):
        mesh = ball_mesh()
        meshio.Mesh(mesh.points, [("tetra", mesh.cells)]).write(tmp_path / "a.vtu")
        with pytest.raises(ValueError, match="no cell data 'tissue'; it holds none"):
            load_mesh(tmp_path / "a.vtu")

    def test_refuses_an_inverted_mesh(self, tmp_path):
        mesh = ball_mesh()
        cells = mesh.cells[:, (1, 0, 2, 3)]
        meshio.Mesh(mesh.points, [("tetra", cells)], cell_data={"tissue": [mesh.tissue]}).write(tmp_path / "a.vtu")
        with pytest.raises(ValueError, match=r"a\.vtu: \d+ tetrahedra have no positive volume"):
            load_mesh(tmp_path / "a.vtu")


@pytest.mark.slow
@pytest.mark.parametrize("load", [mni152, pytest.param(brainweb, marks=needs_brainweb)], ids=["mni152", "brainweb"])
def test_a_brain_gets_about_the_paper_s_mesh(load):
    anatomy = load()
    mesh = build_mesh(anatomy.tissue, anatomy.intracranial)
    assert 650 <= len(mesh.points) <= 1000
    assert 270 <= len(mesh.boundary) <= 450
    assert np.bincount(mesh.tissue, minlength=3).min() >= 50
    distance = signed_distance(anatomy.intracranial.with_voxels(1 - anatomy.intracranial.voxels))
    assert np.asarray(distance.interpolate(mesh.points[mesh.boundary])).min() >= 0.5
