"""Surfaces and lines in files, as electrodes, tracts and outlines of tumours come; world RAS, mm.

PyVista takes seconds to import, which nothing else need wait for: hence inside the functions.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from skimage import measure

from bayesreg.io.atomic import replacing
from bayesreg.io.spaces import TO_RAS
from bayesreg.types import AnyArray, InputError

Space = Literal["RAS", "LPS"]
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


def read_surface(path: str | Path, space: Space | None = None) -> SurfaceFile:
    """Read points with what connects them.

    Parameters
    ----------
    path : path
        .vtk, .vtp, .vtu, .stl, .ply or .obj.
    space : "RAS" or "LPS", optional
        Of its coordinates; the default is what the file says, as 3D Slicer writes it (SPACE=LPS), else RAS.

    Raises
    ------
    InputError
        If there is no such file, it is of another kind or damaged, or holds no points.
    """
    import pyvista

    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: unknown kind of file with a surface; known are {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise InputError(f"{path}: no such file with a surface")
    try:
        with pyvista.VtkErrorCatcher(raise_errors=True):
            surface = pyvista.read(path)
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{path} cannot be read as a surface: {str(error).partition(chr(10))[0]}") from error
    if not isinstance(surface, pyvista.PolyData | pyvista.UnstructuredGrid) or not surface.n_points:
        raise InputError(f"{path} cannot be read as a surface: it holds no points")
    points = np.asarray(surface.points, float)
    if not np.isfinite(points).all():
        raise InputError(f"{path} holds points that are not finite")
    told = _named_space(path)
    chosen: Space = space or told or "RAS"
    return SurfaceFile(surface, points * TO_RAS[chosen], chosen, (space or told) is not None)


def write_surface(
    path: str | Path, surface: SurfaceFile, points: Float[np.ndarray, "k 3"], values: Mapping[str, AnyArray]
) -> None:
    """Write a surface with its points elsewhere and values at the points, all of it or nothing.

    Parameters
    ----------
    path : path
        Ends as the file that the surface was read from; .stl, .ply and .obj keep no values.
    surface : SurfaceFile
        Its space is kept; a .vtk file says which it is.
    points : (k, 3) array
        World RAS, mm.
    values : mapping
        Arrays (k, …) by name.
    """
    moved, path = surface.content.copy(), Path(path)
    moved.points = points * TO_RAS[surface.space]
    for name, value in values.items():
        moved.point_data[name] = np.asarray(value)
    with replacing(path) as temporary:
        moved.save(temporary)
        if path.suffix.lower() == ".vtk":
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


def _named_space(path: Path) -> Space | None:
    """The space that the head of a file names."""
    with path.open("rb") as file:
        found = re.search(rb"SPACE\s*=\s*(RAS|LPS)", file.read(512))
    return None if found is None else ("LPS" if found[1] == b"LPS" else "RAS")


def _say_space(path: Path, space: Space) -> None:
    """The second line of a .vtk file is a title."""
    first, _, rest = path.read_bytes().split(b"\n", 2)
    path.write_bytes(b"\n".join([first, f"bayesreg SPACE={space}".encode(), rest]))
