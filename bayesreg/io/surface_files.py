"""Surfaces and lines in files, as electrodes, tracts and outlines of tumours come; world RAS, mm.

PyVista takes seconds to import, which nothing else need wait for: hence inside the functions.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from skimage import measure

from bayesreg.io.atomic import replacing
from bayesreg.io.spaces import TO_RAS, Space
from bayesreg.types import AnyArray, InputError

TRIAL = "import sys, pyvista; pyvista.read(sys.argv[1])"
SUFFIXES = (".vtk", ".vtp", ".vtu", ".stl", ".ply", ".obj")


class SurfaceFile(NamedTuple):
    """What a file holds.

    Attributes
    ----------
    content : pyvista.PolyData or pyvista.UnstructuredGrid
        As in the file.
    points : (k, 3) array
        World RAS, mm.
    space : str
        That of the file, "RAS" or "LPS".
    is_said : bool
        Whether the file, or who gave it, says so.
    """

    content: Any
    points: Float[np.ndarray, "k 3"]
    space: Space
    is_said: bool

    def part(self, chosen: Bool[np.ndarray, "k"]) -> SurfaceFile:
        """The chosen points, with the cells that have no other, and what is left of lines."""
        import pyvista

        number = np.cumsum(chosen) - 1
        if isinstance(self.content, pyvista.UnstructuredGrid):
            cells = _split(self.content.cells)
            kept = np.array([chosen[ids].all() for ids in cells], bool)
            rows = [(len(ids), *number[ids]) for ids, keep in zip(cells, kept, strict=True) if keep]
            connectivity = np.concatenate([[], *rows]).astype(int)
            content = pyvista.UnstructuredGrid(connectivity, self.content.celltypes[kept], self.content.points[chosen])
        else:
            runs = [run for line in _split(self.content.lines) for run in _runs(chosen, line) if len(run) > 1]
            faces = [ids for ids in _split(self.content.faces) if chosen[ids].all()]
            lines, triangles = (
                np.concatenate([[], *((len(ids), *number[ids]) for ids in kind)]).astype(int) for kind in (runs, faces)
            )
            content = pyvista.PolyData(self.content.points[chosen], faces=triangles, lines=lines)
        for name, values in self.content.point_data.items():
            content.point_data[name] = np.asarray(values)[chosen]
        return self._replace(content=content, points=self.points[chosen])


def _split(connectivity: np.ndarray) -> list[np.ndarray]:
    """The points of each cell, where VTK has them in a row, each time after their number."""
    found, start = [], 0
    while start < len(connectivity):
        end = start + 1 + connectivity[start]
        found.append(np.asarray(connectivity[start + 1 : end]))
        start = end
    return found


def _runs(chosen: Bool[np.ndarray, "k"], line: np.ndarray) -> list[np.ndarray]:
    """What is left of a line where some of its points are left out."""
    borders = np.flatnonzero(np.diff(chosen[line].astype(int))) + 1
    return [part for part in np.split(line, borders) if chosen[part].all()]


def read_surface(path: str | Path, space: Space | None = None) -> SurfaceFile:
    """Read points with what connects them.

    Parameters
    ----------
    path : path
        .vtk, .vtp, .vtu, .stl, .ply or .obj.
    space : "RAS" or "LPS", optional
        Of its coordinates, where the file does not say it as 3D Slicer does (SPACE=LPS); the default is RAS.

    Raises
    ------
    InputError
        If there is no such file, it is of another kind or damaged, or holds no points; if it says another space.
    """
    import pyvista

    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: unknown kind of file with a surface; known are {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise InputError(f"{path}: no such file with a surface")
    _require_harmless(path)
    try:
        with pyvista.VtkErrorCatcher(raise_errors=True, send_to_logging=False):
            surface = pyvista.read(path)
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{path} cannot be read as a surface: it is damaged, or no {path.suffix} file") from error
    if not isinstance(surface, pyvista.PolyData | pyvista.UnstructuredGrid) or not surface.n_points:
        raise InputError(f"{path} cannot be read as a surface: it holds no points")
    points = np.asarray(surface.points, float)
    if not np.isfinite(points).all():
        raise InputError(f"{path} holds points that are not finite")
    told = _named_space(path, surface)
    if told and space and told != space:
        raise InputError(f"{path} says that its coordinates are {told}, and {space} is given: leave the space out")
    chosen: Space = told or space or "RAS"
    return SurfaceFile(surface, points * TO_RAS[chosen], chosen, (space or told) is not None)


def _require_harmless(path: Path) -> None:
    """Let another process read a file first, and raise InputError where that fails.

    VTK's readers believe what a file says of its own size, and the process dies where that is wrong.
    """
    trial = subprocess.run([sys.executable, "-c", TRIAL, str(path.absolute())], capture_output=True, check=False)
    if trial.returncode:
        raise InputError(f"{path} cannot be read as a surface: it is damaged, or no {path.suffix} file")


def write_surface(
    path: str | Path, surface: SurfaceFile, points: Float[np.ndarray, "k 3"], values: Mapping[str, AnyArray]
) -> None:
    """Write a surface with its points elsewhere and values at the points, all of it or nothing.

    Parameters
    ----------
    path : path
        Ends as the file that the surface was read from; .stl, .ply and .obj keep no values.
    surface : SurfaceFile
        Its space is kept, and the file says which it is. Normals are left out: they turn, and programs find them anew.
    points : (k, 3) array
        World RAS, mm.
    values : mapping
        Arrays (k, …) by name.
    """
    moved, path = surface.content.copy(), Path(path)
    moved.points = points * TO_RAS[surface.space]
    for arrays in (moved.point_data, moved.cell_data):
        if "Normals" in arrays:
            del arrays["Normals"]
    for name, value in values.items():
        moved.point_data[name] = np.asarray(value)
    moved.field_data["SPACE"] = [surface.space]
    with replacing(path) as temporary:
        moved.save(temporary)
        _say_space(temporary, surface.space)


def save_outline(
    path: str | Path, values: Float[np.ndarray, "X Y Z"], affine: Float[np.ndarray, "4 4"], level: float
) -> None:
    """Write the surface about all voxels above a level as a .vtk file, world RAS mm.

    Raises
    ------
    InputError
        If no voxel is above the level.
    """
    if not (values > level).any():
        raise InputError(f"{path}: no voxel is above {level:g}, so that there is no surface")
    # A rim of zeros closes the surface where it meets the end of the grid.
    points, faces, _, _ = measure.marching_cubes(np.pad(values, 1), level)
    save_surface(path, (points - 1) @ affine[:3, :3].T + affine[:3, 3], faces)


def save_ellipsoids(
    path: str | Path,
    centres: Float[np.ndarray, "k 3"],
    half_axes: Float[np.ndarray, "k 3"],
    directions: Float[np.ndarray, "k 3 3"],
) -> None:
    """Write ellipsoids, world RAS mm, each direction a row, as one surface in a .vtk file."""
    import pyvista

    ball = pyvista.Icosphere(radius=1.0, nsub=2)
    points, faces = np.asarray(ball.points, float), np.asarray(ball.regular_faces).astype(np.int64)
    every = centres[:, None] + np.einsum("pa,ka,kai->kpi", points, half_axes, directions)
    number = np.repeat(np.arange(len(centres)), len(points))
    shift = len(points) * np.arange(len(centres))[:, None, None]
    save_surface(path, every.reshape(-1, 3), (faces + shift).reshape(-1, 3), {"number": number})


def save_surface(
    path: str | Path,
    points: Float[np.ndarray, "k 3"],
    faces: Int[np.ndarray, "t 3"],
    values: Mapping[str, AnyArray] = MappingProxyType({}),
) -> None:
    """Write triangles, world RAS mm, with values at the points as a .vtk file, all of it or nothing."""
    import pyvista

    surface = pyvista.PolyData(points, np.insert(faces, 0, 3, axis=1).ravel())
    for name, value in values.items():
        surface.point_data[name] = np.asarray(value)
    with replacing(path) as temporary:
        surface.save(temporary)
        _say_space(temporary, "RAS")


def _named_space(path: Path, surface: Any) -> Space | None:
    """The space that the head of a file names, or a field of it."""
    with path.open("rb") as file:
        found = re.search(rb"SPACE\s*=\s*(RAS|LPS)", file.read(512))
    named = str(surface.field_data["SPACE"][0]) if "SPACE" in surface.field_data else found and found[1].decode()
    return "LPS" if named == "LPS" else "RAS" if named == "RAS" else None


def _say_space(path: Path, space: Space) -> None:
    """In the head of a file, as 3D Slicer does; those in XML have it as a field."""
    content, said = path.read_bytes(), f"bayesreg SPACE={space}".encode()
    suffix = path.suffix.lower()
    if suffix == ".vtk":
        # The second line is a title.
        first, _, rest = content.split(b"\n", 2)
        content = b"\n".join([first, said, rest])
    elif suffix == ".stl":
        # VTK writes it in binary form, of which 80 bytes are free.
        content = said.ljust(80) + content[80:]
    elif suffix == ".ply":
        first, kind, rest = content.split(b"\n", 2)
        content = b"\n".join([first, kind, b"comment " + said, rest])
    elif suffix == ".obj":
        content = b"# " + said + b"\n" + content
    path.write_bytes(content)
