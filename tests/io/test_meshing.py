"""Labels to mesh, the tissue of cells, and meshes in files."""

from dataclasses import replace

import numpy as np
import pytest
import pyvista

from bayesreg.distance import signed_distance
from bayesreg.image import Image
from bayesreg.io import meshing, tetwild
from bayesreg.io.datasets import brainweb, mni152
from bayesreg.io.domain import labels_everywhere
from bayesreg.io.meshing import (
    MeshError,
    MeshOptions,
    build_mesh,
    check_mesh,
    load_mesh,
    mesh_domain,
    save_mesh,
    tissue_of_cells,
)
from bayesreg.mesh import TetMesh
from tests.io.balls import CENTRE, balls, grid
from tests.io.test_datasets import needs_brainweb
from tests.phantoms import ball_mesh, box_mesh, save_grid

OPTIONS = MeshOptions(edge_length=16.0, envelope=4.0)


@pytest.fixture(scope="module")
def mesh(phantom):
    return build_mesh(*phantom, OPTIONS)


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
        assert mesh.volumes.sum() == pytest.approx(4 / 3 * np.pi * 36**3, rel=0.03)

    def test_works_where_the_labels_touch_the_edge_of_the_grid(self):
        tissue, _ = balls(grid(extent=60.0))
        mesh = build_mesh(tissue, None, OPTIONS)
        assert mesh.volumes.sum() == pytest.approx(np.count_nonzero(tissue.voxels) * tissue.voxel_volume, rel=0.05)
        assert tissue.contains(mesh.points).mean() > 0.5

    def test_tries_again_where_a_mesh_is_not_sound(self, phantom, mesh, monkeypatch, caplog):
        results = iter([MeshError("no luck"), (mesh.points, mesh.cells)])

        def sometimes(*args, **kwargs):
            result = next(results)
            if isinstance(result, MeshError):
                raise result
            return result

        monkeypatch.setattr(meshing, "tetrahedralize", sometimes)
        again = build_mesh(*phantom, OPTIONS)
        np.testing.assert_array_equal(again.cells, mesh.cells)
        assert "mesh 1 of at most 3 failed its check: no luck" in caplog.text

    def test_takes_a_region_made_already(self, phantom, mesh, monkeypatch):
        domain = mesh_domain(*phantom)
        monkeypatch.setattr(meshing, "tetrahedralize", lambda *args, **kwargs: (mesh.points, mesh.cells))
        expected = build_mesh(*phantom, OPTIONS)
        monkeypatch.setattr(meshing, "mesh_domain", None)
        assert build_mesh(*phantom, OPTIONS, domain).digest == expected.digest

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

    @pytest.mark.parametrize(("names", "expected"), [(("csf", "gm"), 0), (("liver", "vessels"), 1)])
    def test_counts_all_beyond_the_labels_as_fluid_or_as_the_nearest_tissue(self, names, expected):
        mesh = box_mesh(2)
        labels = np.zeros((4, 3, 3), np.int8)
        labels[2:] = 2
        image = labels_everywhere(Image(labels, np.diag([-1.0, -1.0, -1.0, 1.0])), names)
        np.testing.assert_array_equal(tissue_of_cells(mesh.points, mesh.cells, image), expected)


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
        data = pyvista.read(tmp_path / "mesh.vtu").point_data
        np.testing.assert_array_equal(data["u_mean"], u)
        np.testing.assert_array_equal(data["count"], np.arange(len(u)))
        assert load_mesh(tmp_path / "mesh.vtu").digest == mesh.digest

    def test_reads_files_without_names(self, tmp_path):
        mesh = ball_mesh()
        save_grid(tmp_path / "a.vtu", mesh.points, mesh.cells, mesh.tissue)
        assert load_mesh(tmp_path / "a.vtu").digest == mesh.digest

    def test_a_failing_write_leaves_the_old_file(self, tmp_path, monkeypatch):
        save_mesh(ball_mesh(), tmp_path / "mesh.vtu")

        def fail(dataset, path):
            raise OSError("disk full")

        monkeypatch.setattr(meshing, "save_dataset", fail)
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
        pyvista.PolyData(np.eye(3), [3, 0, 1, 2]).cast_to_unstructured_grid().save(tmp_path / "a.vtu")
        with pytest.raises(ValueError, match="must consist of tetrahedra, got triangle"):
            load_mesh(tmp_path / "a.vtu")

    def test_refuses_cells_without_tissue(self, tmp_path):
        mesh = ball_mesh()
        save_grid(tmp_path / "a.vtu", mesh.points, mesh.cells)
        with pytest.raises(ValueError, match="no cell data 'tissue'; it holds none"):
            load_mesh(tmp_path / "a.vtu")

    def test_refuses_an_inverted_mesh(self, tmp_path):
        mesh = ball_mesh()
        cells = mesh.cells[:, (1, 0, 2, 3)]
        save_grid(tmp_path / "a.vtu", mesh.points, cells, mesh.tissue)
        with pytest.raises(ValueError, match=r"a\.vtu: \d+ tetrahedra have no positive volume"):
            load_mesh(tmp_path / "a.vtu")


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("load", [mni152, pytest.param(brainweb, marks=needs_brainweb)], ids=["mni152", "brainweb"])
def test_a_brain_gets_about_the_paper_s_mesh(load):
    anatomy = load()
    mesh = build_mesh(anatomy.tissue, anatomy.intracranial)
    assert 650 <= len(mesh.points) <= 1000
    assert 270 <= len(mesh.boundary) <= 450
    assert np.bincount(mesh.tissue, minlength=3).min() >= 50
    distance = signed_distance(anatomy.intracranial.with_voxels(1 - anatomy.intracranial.voxels))
    assert np.asarray(distance.interpolate(mesh.points[mesh.boundary])).min() >= 0.5
