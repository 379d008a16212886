"""World-aligned slices of images and meshes, in millimetres, whatever the voxel grid's orientation.

Axial and coronal slices are shown in the neurological convention: the left of the patient is on the left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Real
from scipy import ndimage

from bayesreg.fem.location import locate
from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray

NAMES = ("sagittal", "coronal", "axial")
COORDINATES = ("x", "y", "z")
IN_PLANE = ((1, 2), (0, 2), (0, 1))
DIRECTIONS = (("L", "R"), ("P", "A"), ("I", "S"))

MARGIN = 8.0
PIXELS = 260
LEAST_SECTION = 0.6
POSITIONS_TRIED = 41


class Plane(NamedTuple):
    """A rectangle of a plane normal to a world axis.

    Attributes
    ----------
    axis : int
        World axis of the normal: 0 sagittal, 1 coronal, 2 axial.
    position : float
        Coordinate along that axis, mm.
    horizontal, vertical : tuple of float
        Range of the two in-plane coordinates (x before y before z), mm.
    spacing : float
        Size of a pixel, mm.
    """

    axis: int
    position: float
    horizontal: tuple[float, float]
    vertical: tuple[float, float]
    spacing: float

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top, mm."""
        return (*self.horizontal, *self.vertical)

    @property
    def title(self) -> str:
        """Name and position, as "axial, z = 12 mm"."""
        # Adding zero turns −0 into 0.
        position = round(self.position) + 0
        return f"{NAMES[self.axis]}, {COORDINATES[self.axis]} = {position:d} mm".replace("-", "−")

    def points(self) -> Float[np.ndarray, "rows columns 3"]:
        """World position of every pixel's centre, the first row at the bottom."""
        across, up = IN_PLANE[self.axis]
        points = np.empty((_count(self.vertical, self.spacing), _count(self.horizontal, self.spacing), 3))
        points[..., self.axis] = self.position
        points[..., across] = _centres(self.horizontal, points.shape[1])
        points[..., up] = _centres(self.vertical, points.shape[0])[:, None]
        return points


@dataclass(frozen=True, eq=False)
class MeshSlice:
    """A mesh seen on the pixels of a plane."""

    mesh: TetMesh
    plane: Plane

    @cached_property
    def _location(self) -> tuple[np.ndarray, np.ndarray]:
        cell, barycentric = locate(self.mesh.points, self.mesh.cells, self.plane.points().reshape(-1, 3))
        return np.asarray(cell), np.asarray(barycentric)

    @cached_property
    def inside(self) -> Bool[np.ndarray, "rows columns"]:
        """Pixels inside the mesh."""
        return (self._location[0] >= 0).reshape(self.plane.points().shape[:2])

    def nodal(self, values: Float[AnyArray, "nodes components"]) -> Float[np.ndarray, "rows columns components"]:
        """A piecewise linear field; NaN outside the mesh."""
        cell, barycentric = self._location
        corner = np.asarray(values)[self.mesh.cells[cell]]
        return self._picture(np.einsum("ki,kic->kc", barycentric, corner))

    def cellwise(self, values: Real[AnyArray, "cells"]) -> Float[np.ndarray, "rows columns"]:
        """A field that is constant in every tetrahedron; NaN outside the mesh."""
        return self._picture(np.asarray(values, float)[self._location[0], None])[..., 0]

    def _picture(self, values: np.ndarray) -> np.ndarray:
        values = values.reshape(*self.inside.shape, -1)
        return np.where(self.inside[..., None], values, np.nan)


class Section(NamedTuple):
    """Intersection of a mesh with a plane.

    Attributes
    ----------
    polygons : (k, 4, 2) array
        In-plane coordinates, mm, of the triangles and quadrilaterals; a triangle repeats its last corner.
    cell : (k,) array
        The tetrahedron that each was cut from.
    """

    polygons: Float[np.ndarray, "polygons 4 2"]
    cell: Int[np.ndarray, "polygons"]

    @property
    def areas(self) -> Float[np.ndarray, "polygons"]:
        """Area of every polygon, mm²."""
        x, y = np.moveaxis(self.polygons, -1, 0)
        return 0.5 * np.abs((x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1))


def cut(mesh: TetMesh, axis: int, position: float) -> Section:
    """Exact intersection polygons of every tetrahedron with the plane x[axis] = position (mm)."""
    height = mesh.points[:, axis] - position
    # Nodes on the plane count as above it, so that a face in the plane is drawn once.
    above = (height >= 0)[mesh.cells]
    number = above.sum(axis=1)
    parts = [_cut_corner(mesh, height, above if n == 1 else ~above, number == n) for n in (1, 3)]
    parts.append(_cut_middle(mesh, height, above, number == 2))
    polygons = np.concatenate([polygon for polygon, _ in parts])[..., list(IN_PLANE[axis])]
    return Section(polygons, np.concatenate([cell for _, cell in parts]))


def _cut_corner(
    mesh: TetMesh, height: np.ndarray, alone: np.ndarray, chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of the tetrahedra with one corner on its own side."""
    cell = np.flatnonzero(chosen)
    order = np.argsort(~alone[cell], axis=1, kind="stable")
    corner = np.take_along_axis(mesh.cells[cell], order, axis=1)
    points = [_crossing(mesh.points, height, corner[:, 0], corner[:, k]) for k in (1, 2, 3, 3)]
    return np.stack(points, axis=1), cell


def _cut_middle(
    mesh: TetMesh, height: np.ndarray, above: np.ndarray, chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Quadrilaterals of the tetrahedra with two corners on each side."""
    cell = np.flatnonzero(chosen)
    order = np.argsort(~above[cell], axis=1, kind="stable")
    a, b, c, d = np.take_along_axis(mesh.cells[cell], order, axis=1).T
    points = [_crossing(mesh.points, height, i, j) for i, j in ((a, c), (a, d), (b, d), (b, c))]
    return np.stack(points, axis=1), cell


def _crossing(points: np.ndarray, height: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    share = (height[i] / (height[i] - height[j]))[:, None]
    return (1 - share) * points[i] + share * points[j]


def sample(image: Image, points: Float[np.ndarray, "*shape 3"], order: int = 1, outside: float = np.nan) -> np.ndarray:
    """Values of an image at world points (mm), linear or (order 0) of the nearest voxel; `outside` off the grid."""
    indices = np.asarray(image.world_to_voxel(points))
    on_grid = ((indices >= -0.5) & (indices <= np.array(image.shape) - 0.5)).all(axis=-1)
    voxels = np.asarray(image.voxels, float)
    values = ndimage.map_coordinates(voxels, np.moveaxis(indices, -1, 0), order=order, mode="nearest")
    return np.where(on_grid, values, outside)


def planes_through(mesh: TetMesh, point: Float[np.ndarray, "3"]) -> tuple[Plane, Plane, Plane]:
    """Sagittal, coronal and axial plane through a point.

    A plane that would only graze the mesh (less than 60 % of the largest parallel section) is moved inwards
    until it does not.
    """
    found = []
    for axis in range(3):
        position = _position(mesh, axis, float(point[axis]))
        corners = cut(mesh, axis, position).polygons.reshape(-1, 2)
        (left, bottom), (right, top) = corners.min(axis=0) - MARGIN, corners.max(axis=0) + MARGIN
        sides = (float(left), float(right)), (float(bottom), float(top))
        found.append(Plane(axis, position, *sides, float(max(right - left, top - bottom)) / PIXELS))
    return found[0], found[1], found[2]


def main_plane(mesh: TetMesh, planes: Sequence[Plane], u: Float[AnyArray, "nodes 3"]) -> Plane:
    """The plane that sees most of a displacement (the integral of |u|² over its section)."""

    def seen(plane: Plane) -> float:
        section = cut(mesh, plane.axis, plane.position)
        middle = np.asarray(u)[mesh.cells].mean(axis=1)[section.cell]
        return float(section.areas @ (middle**2).sum(axis=1))

    return max(planes, key=seen)


def _position(mesh: TetMesh, axis: int, wanted: float) -> float:
    low, high = mesh.points[:, axis].min(), mesh.points[:, axis].max()
    tried = np.concatenate([[wanted], np.linspace(low, high, POSITIONS_TRIED + 2)[1:-1]])
    areas = np.array([cut(mesh, axis, position).areas.sum() for position in tried])
    enough = tried[areas >= LEAST_SECTION * areas.max()]
    return float(enough[np.abs(enough - wanted).argmin()])


def _count(side: tuple[float, float], spacing: float) -> int:
    return max(1, round((side[1] - side[0]) / spacing))


def _centres(side: tuple[float, float], count: int) -> np.ndarray:
    return side[0] + (np.arange(count) + 0.5) * (side[1] - side[0]) / count
