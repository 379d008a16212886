"""VTK's legacy format, PLY and OBJ are read as VTK reads them, and a wrong size in them is an error and no crash."""

import numpy as np
import pytest
import pyvista
from vtkmodules.vtkIOLegacy import vtkPolyDataWriter, vtkUnstructuredGridWriter

from bayesreg.io.surface_files import read_dataset, read_surface, save_dataset
from bayesreg.types import InputError
from tests.phantoms import ball_mesh


def _surface():
    surface = pyvista.Sphere(radius=3.0, theta_resolution=6, phi_resolution=6)
    surface.point_data["depth"] = np.linspace(0, 1, surface.n_points)
    surface.cell_data["kind"] = np.arange(surface.n_cells, dtype=np.uint8)
    surface.field_data["SPACE"] = ["LPS"]
    return surface


def _lines():
    points = np.random.default_rng(0).normal(size=(12, 3))
    lines = pyvista.PolyData(points, lines=[5, 0, 1, 2, 3, 4, 4, 5, 6, 7, 8])
    lines.point_data["direction"] = points[:, ::-1]
    return lines


def _tetrahedra():
    mesh = ball_mesh(spacing=30.0)
    grid = pyvista.UnstructuredGrid({pyvista.CellType.TETRA: mesh.cells}, mesh.points)
    grid.cell_data["tissue"] = mesh.tissue
    return grid


def _write(dataset, path, version, binary):
    grid = isinstance(dataset, pyvista.UnstructuredGrid)
    writer = vtkUnstructuredGridWriter() if grid else vtkPolyDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(dataset)
    writer.SetFileVersion(version)
    writer.SetFileType(2 if binary else 1)
    writer.Write()


def _cells(dataset):
    return [dataset.cells] if isinstance(dataset, pyvista.UnstructuredGrid) else [dataset.faces, dataset.lines]


@pytest.mark.parametrize("make", [_surface, _lines, _tetrahedra])
@pytest.mark.parametrize("version", [42, 51])
@pytest.mark.parametrize("binary", [False, True])
def test_the_legacy_format_is_read_as_vtk_reads_it(make, version, binary, tmp_path):
    _write(make(), tmp_path / "a.vtk", version, binary)
    dataset, vtk_dataset = read_dataset(tmp_path / "a.vtk"), pyvista.read(tmp_path / "a.vtk")
    assert type(dataset) is type(vtk_dataset)
    np.testing.assert_array_equal(dataset.points, vtk_dataset.points)
    for cells, vtk_cells in zip(_cells(dataset), _cells(vtk_dataset), strict=True):
        np.testing.assert_array_equal(cells, vtk_cells)
    for name in ("point_data", "cell_data", "field_data"):
        arrays, vtk_arrays = getattr(dataset, name), getattr(vtk_dataset, name)
        assert set(arrays.keys()) == set(vtk_arrays.keys())
        for key in vtk_arrays:
            np.testing.assert_array_equal(arrays[key], vtk_arrays[key])


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
@pytest.mark.parametrize("binary", [False, True])
def test_points_and_faces_are_those_that_vtk_reads(suffix, binary, tmp_path):
    _surface().save(tmp_path / f"a{suffix}", **({"binary": binary} if suffix == ".ply" else {}))
    dataset, vtk_dataset = read_dataset(tmp_path / f"a{suffix}"), pyvista.read(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(dataset.points, vtk_dataset.points)
    np.testing.assert_array_equal(dataset.faces, vtk_dataset.faces)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"POINTS 26 ", b"POINTS 2600000000 "),
        (b"POINTS 26 ", b"POINTS -26 "),
        (b"POLYGONS 48 192", b"POLYGONS 48 191"),
        (b"POLYGONS 48 192", b"POLYGONS 48 99999999999"),
        (b"float", b"bloat"),
        (b"DATASET POLYDATA", b"DATASET POLYGLOT"),
    ],
)
def test_a_wrong_size_is_one_message(old, new, tmp_path):
    _write(_surface(), tmp_path / "a.vtk", 42, binary=True)
    content = (tmp_path / "a.vtk").read_bytes()
    assert old in content
    (tmp_path / "a.vtk").write_bytes(content.replace(old, new, 1))
    with pytest.raises(InputError, match=r"a\.vtk cannot be read as a surface: it is damaged, or no \.vtk file"):
        read_surface(tmp_path / "a.vtk")


def test_cells_of_points_that_are_not_there_are_refused_in_xml_too(tmp_path):
    surface = pyvista.PolyData(np.eye(3), [3, 0, 1, 2])
    surface.faces = [3, 0, 1, 99]
    save_dataset(surface, tmp_path / "a.vtp")
    with pytest.raises(InputError, match="damaged"):
        read_surface(tmp_path / "a.vtp")


def test_an_obj_counts_from_one_and_from_the_end(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1/1 2/1 3/1\nf -1 -2 -3\nl 1 4\n")
    dataset = read_dataset(tmp_path / "a.obj")
    np.testing.assert_array_equal(dataset.faces, [3, 0, 1, 2, 3, 3, 2, 1])
    np.testing.assert_array_equal(dataset.lines, [2, 0, 3])
