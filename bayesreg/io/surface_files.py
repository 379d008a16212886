"""Files of surfaces and lines, such as electrodes, tracts and outlines of tumours; world RAS, mm.

The functions import PyVista themselves, since its import takes seconds and other code does not need it.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from skimage import measure

from bayesreg.io.atomic import replacing
from bayesreg.io.spaces import TO_RAS, Space
from bayesreg.io.surface_formats import join_cells, read_legacy, read_obj, read_ply, split_cells
from bayesreg.types import AnyArray, InputError

SUFFIXES = (".vtk", ".vtp", ".vtu", ".stl", ".ply", ".obj")


class SurfaceFile(NamedTuple):
    """The content of a file with a surface or lines.

    Attributes
    ----------
    content : pyvista.PolyData or pyvista.UnstructuredGrid
        The dataset, with the coordinates of the file.
    points : (k, 3) array
        The points in world RAS, mm.
    space : str
        The space of the file's coordinates, "RAS" or "LPS".
    is_said : bool
        Whether the file or the user stated the space.
    """

    content: Any
    points: Float[np.ndarray, "k 3"]
    space: Space
    is_said: bool

    def selected(self, chosen: Bool[np.ndarray, "k"]) -> SurfaceFile:
        """Select points, the cells with chosen points only, and the parts of lines between chosen points."""
        import pyvista

        number = np.cumsum(chosen) - 1
        if isinstance(self.content, pyvista.UnstructuredGrid):
            cells = split_cells(self.content.cells, len(chosen))
            chosen_cells = np.array([chosen[ids].all() for ids in cells], bool)
            rows = [(len(ids), *number[ids]) for ids, keep in zip(cells, chosen_cells, strict=True) if keep]
            connectivity = np.concatenate([[], *rows]).astype(int)
            content = pyvista.UnstructuredGrid(
                connectivity, self.content.celltypes[chosen_cells], self.content.points[chosen]
            )
        else:
            runs = [
                run
                for line in split_cells(self.content.lines, len(chosen))
                for run in _runs(chosen, line)
                if len(run) > 1
            ]
            faces = [ids for ids in split_cells(self.content.faces, len(chosen)) if chosen[ids].all()]
            lines, triangles = (
                np.concatenate([[], *((len(ids), *number[ids]) for ids in kind)]).astype(int) for kind in (runs, faces)
            )
            content = pyvista.PolyData(self.content.points[chosen], faces=triangles, lines=lines)
        for name, values in self.content.point_data.items():
            content.point_data[name] = np.asarray(values)[chosen]
        return self._replace(content=content, points=self.points[chosen])


def _runs(chosen: Bool[np.ndarray, "k"], line: np.ndarray) -> list[np.ndarray]:
    """Split a line into its runs of chosen points."""
    borders = np.flatnonzero(np.diff(chosen[line].astype(int))) + 1
    return [run for run in np.split(line, borders) if chosen[run].all()]


def read_surface(path: str | Path, space: Space | None = None) -> SurfaceFile:
    """Read a surface or lines: points and the cells that connect them.

    Parameters
    ----------
    path : path
        A .vtk, .vtp, .vtu, .stl, .ply or .obj file.
    space : "RAS" or "LPS", optional
        The space of the coordinates if the file does not state it as 3D Slicer does (SPACE=LPS); the default is RAS.

    Raises
    ------
    InputError
        If the file does not exist, is of another kind, is damaged, holds no points, or states another space.
    """
    import pyvista

    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: unknown kind of file with a surface; known are {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise InputError(f"{path}: no such file with a surface")
    try:
        surface = read_dataset(path)
    except ValueError as error:
        raise InputError(f"{path} cannot be read as a surface: it is damaged, or no {path.suffix} file") from error
    if not isinstance(surface, pyvista.PolyData | pyvista.UnstructuredGrid) or not surface.n_points:
        raise InputError(f"{path} cannot be read as a surface: it holds no points")
    points = np.asarray(surface.points, float)
    if not np.isfinite(points).all():
        raise InputError(f"{path} holds points that are not finite")
    stated_space = _named_space(path, surface)
    if stated_space and space and stated_space != space:
        raise InputError(
            f"{path} says that its coordinates are {stated_space}, and {space} is given: leave the space out"
        )
    chosen: Space = stated_space or space or "RAS"
    return SurfaceFile(surface, points * TO_RAS[chosen], chosen, (space or stated_space) is not None)


READERS = {".vtk": read_legacy, ".ply": read_ply, ".obj": read_obj}
# An XML file with compressed arrays holds at most this many numbers per byte.
MOST_COMPRESSED = 1100


def read_dataset(path: Path) -> Any:
    """Read a VTK, .stl, .ply or .obj file as a PyVista dataset; raise ValueError if it is damaged."""
    content, suffix = path.read_bytes(), path.suffix.lower()
    try:
        return READERS[suffix](content) if suffix in READERS else _read_by_vtk(path, content)
    except (LookupError, OverflowError) as error:
        raise ValueError("it is damaged") from error


def _read_by_vtk(path: Path, content: bytes) -> Any:
    """Read XML or STL by VTK, and check the result.

    These readers survive a wrong size in the file, but can return invalid cells.
    """
    import pyvista
    from vtkmodules.vtkCommonCore import vtkLogger
    from vtkmodules.vtkIOGeometry import vtkSTLReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    counts = map(int, re.findall(rb'NumberOf\w+\s*=\s*"\s*(\d+)', content))
    if max(counts, default=0) > MOST_COMPRESSED * len(content):
        raise ValueError("it is cut short")
    readers: dict[str, Any] = {".vtp": vtkXMLPolyDataReader, ".vtu": vtkXMLUnstructuredGridReader, ".stl": vtkSTLReader}
    reader, errors, verbosity = readers[path.suffix.lower()](), [], vtkLogger.GetCurrentVerbosityCutoff()
    reader.SetFileName(str(path))
    reader.AddObserver("ErrorEvent", lambda *_: errors.append(path))
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    # VTK's other messages, in the terminal and in PyVista's log, do not help the user.
    with pyvista.VtkErrorCatcher(send_to_logging=False):
        reader.Update()
    vtkLogger.SetStderrVerbosity(verbosity)
    dataset = pyvista.wrap(reader.GetOutput())
    grid = isinstance(dataset, pyvista.UnstructuredGrid)
    kinds = [
        getattr(dataset, f"Get{kind}")() for kind in (("Cells",) if grid else ("Verts", "Lines", "Polys", "Strips"))
    ]
    if errors or None in kinds:
        raise ValueError(f"it is cut short, or no {path.suffix} file")
    for cells in kinds:
        offsets, points = (
            np.asarray(pyvista.convert_array(array)).astype(np.int64)
            for array in (cells.GetOffsetsArray(), cells.GetConnectivityArray())
        )
        split_cells(join_cells(offsets, points), dataset.n_points)
    return dataset


def save_dataset(dataset: Any, path: Path) -> None:
    """Write a PyVista dataset; raise OSError if that fails."""
    import pyvista
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

    xml = {".vtu": vtkXMLUnstructuredGridWriter, ".vtp": vtkXMLPolyDataWriter}.get(path.suffix.lower())
    if xml is not None:
        # VTK writes to memory, since it ends the process if the disk is full.
        writer = xml()
        writer.SetInputData(dataset)
        writer.SetDataModeToBinary()
        writer.SetWriteToOutputString(True)
        writer.Write()
        path.write_text(writer.GetOutputString(), encoding="utf-8")
        return
    try:
        with pyvista.VtkErrorCatcher(raise_errors=True, send_to_logging=False):
            dataset.save(path)
    except RuntimeError as error:
        raise OSError(errno.EIO, "cannot be written: is the disk full?", str(path)) from error


def write_surface(
    path: str | Path, surface: SurfaceFile, points: Float[np.ndarray, "k 3"], values: Mapping[str, AnyArray]
) -> None:
    """Write a surface with moved points and values at the points, in one step.

    Parameters
    ----------
    path : path
        Has the suffix of the file from which the surface was read; .stl, .ply and .obj keep no values.
    surface : SurfaceFile
        The surface before the move. The file keeps its space and states it. Normals are removed, since they are no
        longer valid and programs compute them again.
    points : (k, 3) array
        The moved points in world RAS, mm.
    values : mapping
        Arrays of shape (k, …) by name.
    """
    dataset, path = surface.content.copy(), Path(path)
    dataset.points = points * TO_RAS[surface.space]
    for arrays in (dataset.point_data, dataset.cell_data):
        if "Normals" in arrays:
            del arrays["Normals"]
    for name, value in values.items():
        dataset.point_data[name] = np.asarray(value)
    dataset.field_data["SPACE"] = [surface.space]
    with replacing(path) as temporary:
        save_dataset(dataset, temporary)
        _say_space(temporary, surface.space)


def save_outline(
    path: str | Path, values: Float[np.ndarray, "X Y Z"], affine: Float[np.ndarray, "4 4"], level: float
) -> None:
    """Write the surface around all voxels above a level as a .vtk file, world RAS, mm.

    Raises
    ------
    InputError
        If no voxel is above the level.
    """
    if not (values > level).any():
        raise InputError(f"{path}: no voxel is above {level:g}, so that there is no surface")
    # A margin of zeros closes the surface at the end of the grid.
    points, faces, _, _ = measure.marching_cubes(np.pad(values, 1), level)
    save_surface(path, (points - 1) @ affine[:3, :3].T + affine[:3, 3], faces)


def save_ellipsoids(
    path: str | Path,
    centres: Float[np.ndarray, "k 3"],
    half_axes: Float[np.ndarray, "k 3"],
    directions: Float[np.ndarray, "k 3 3"],
) -> None:
    """Write ellipsoids as one surface in a .vtk file, world RAS, mm; the rows of `directions` are unit vectors."""
    import pyvista

    ball = pyvista.Icosphere(radius=1.0, nsub=2)
    points, faces = np.asarray(ball.points, float), np.asarray(ball.regular_faces).astype(np.int64)
    vertices = centres[:, None] + np.einsum("pa,ka,kai->kpi", points, half_axes, directions)
    number = np.repeat(np.arange(len(centres)), len(points))
    shift = len(points) * np.arange(len(centres))[:, None, None]
    save_surface(path, vertices.reshape(-1, 3), (faces + shift).reshape(-1, 3), {"number": number})


def save_surface(
    path: str | Path,
    points: Float[np.ndarray, "k 3"],
    faces: Int[np.ndarray, "t 3"],
    values: Mapping[str, AnyArray] = MappingProxyType({}),
) -> None:
    """Write triangles with values at their points as a .vtk file in one step, world RAS, mm."""
    import pyvista

    surface = pyvista.PolyData(points, np.insert(faces, 0, 3, axis=1).ravel())
    for name, value in values.items():
        surface.point_data[name] = np.asarray(value)
    with replacing(path) as temporary:
        save_dataset(surface, temporary)
        _say_space(temporary, "RAS")


def _named_space(path: Path, surface: Any) -> Space | None:
    """Read the space of the coordinates from the dataset's field SPACE or the head of a file."""
    with path.open("rb") as file:
        match = re.search(rb"SPACE\s*=\s*(RAS|LPS)", file.read(512))
    named = str(surface.field_data["SPACE"][0]) if "SPACE" in surface.field_data else match and match[1].decode()
    return "LPS" if named == "LPS" else "RAS" if named == "RAS" else None


def _say_space(path: Path, space: Space) -> None:
    """Write the space into the head of a file, as 3D Slicer does; XML files already have it as a field."""
    content, statement = path.read_bytes(), f"bayesreg SPACE={space}".encode()
    suffix = path.suffix.lower()
    if suffix == ".vtk":
        # The second line is a title, whose text is free.
        first, _, rest = content.split(b"\n", 2)
        content = b"\n".join([first, statement, rest])
    elif suffix == ".stl":
        # VTK writes binary STL, whose first 80 bytes are free.
        content = statement.ljust(80) + content[80:]
    elif suffix == ".ply":
        first, kind, rest = content.split(b"\n", 2)
        content = b"\n".join([first, kind, b"comment " + statement, rest])
    elif suffix == ".obj":
        content = b"# " + statement + b"\n" + content
    path.write_bytes(content)
