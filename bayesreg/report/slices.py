"""World-aligned slices of images and meshes, in millimetres, whatever the voxel grid's orientation.

Axial and coronal slices are shown in the neurological convention: the left of the patient is on the left.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Real
from scipy import ndimage

from bayesreg.fem.location import locate
from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray

NAMES = ("sagittal", "coronal", "axial")
COORDINATES = ("x", "y", "z")
IN_PLANE = ((1, 2), (0, 2), (0, 1))
DIRECTIONS = (("L", "R"), ("P", "A"), ("I", "S"))

MARGIN = 5.0
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
        """The left, right, bottom and top edges, mm."""
        return (*self.horizontal, *self.vertical)

    @property
    def title(self) -> str:
        """The name and position of the plane, as "axial, z = 12 mm"."""
        # Adding zero turns −0 into 0.
        position = round(self.position) + 0
        return f"{NAMES[self.axis]}, {COORDINATES[self.axis]} = {position:d} mm".replace("-", "−")

    def points(self) -> Float[np.ndarray, "rows columns 3"]:
        """Return the world coordinates of every pixel's centre, with the first row at the bottom."""
        across, up = IN_PLANE[self.axis]
        points = np.empty((_count(self.vertical, self.spacing), _count(self.horizontal, self.spacing), 3))
        points[..., self.axis] = self.position
        points[..., across] = _centres(self.horizontal, points.shape[1])
        points[..., up] = _centres(self.vertical, points.shape[0])[:, None]
        return points


@dataclass(frozen=True, eq=False)
class MeshSlice:
    """The section of a mesh on the pixels of a plane."""

    mesh: TetMesh
    plane: Plane

    @cached_property
    def _location(self) -> tuple[np.ndarray, np.ndarray]:
        cell, barycentric = locate(self.mesh.points, self.mesh.cells, self.plane.points().reshape(-1, 3))
        return np.asarray(cell), np.asarray(barycentric)

    @cached_property
    def inside(self) -> Bool[np.ndarray, "rows columns"]:
        """The pixels inside the mesh."""
        return (self._location[0] >= 0).reshape(self.plane.points().shape[:2])

    def nodal(self, values: Float[AnyArray, "nodes components"]) -> Float[np.ndarray, "rows columns components"]:
        """Evaluate a piecewise linear field; NaN outside the mesh."""
        cell, barycentric = self._location
        corner = np.asarray(values)[self.mesh.cells[cell]]
        return self._picture(np.einsum("ki,kic->kc", barycentric, corner))

    def cellwise(self, values: Real[AnyArray, "cells"]) -> Float[np.ndarray, "rows columns"]:
        """Evaluate a field that is constant in every tetrahedron; NaN outside the mesh."""
        return self._picture(np.asarray(values, float)[self._location[0], None])[..., 0]

    def _picture(self, values: np.ndarray) -> np.ndarray:
        values = values.reshape(*self.inside.shape, -1)
        return np.where(self.inside[..., None], values, np.nan)


def sample(image: Image, points: Float[np.ndarray, "*shape 3"], order: int = 1, outside: float = np.nan) -> np.ndarray:
    """Sample an image at world points (mm), linear or (order 0) nearest voxel; `outside` is the value off the grid."""
    indices = np.asarray(image.world_to_voxel(points))
    on_grid = ((indices >= -0.5) & (indices <= np.array(image.shape) - 0.5)).all(axis=-1)
    voxels = np.asarray(image.voxels, float)
    values = ndimage.map_coordinates(voxels, np.moveaxis(indices, -1, 0), order=order, mode="nearest")
    return np.where(on_grid, values, outside)


def planes_through(mesh: TetMesh, point: Float[np.ndarray, "3"]) -> tuple[Plane, Plane, Plane]:
    """Make the sagittal, coronal and axial planes through a point, each as large as the mesh.

    If the section of a plane is less than 60 % of the largest parallel section, the plane is moved inwards until it is
    not.
    """
    low, high = mesh.points.min(axis=0) - MARGIN, mesh.points.max(axis=0) + MARGIN
    sides = [(float(a), float(b)) for a, b in zip(low, high, strict=True)]
    spacing = max(b - a for a, b in sides) / PIXELS
    sagittal, coronal, axial = (
        Plane(axis, _position(mesh, axis, float(point[axis])), sides[across], sides[up], spacing)
        for axis, (across, up) in enumerate(IN_PLANE)
    )
    return sagittal, coronal, axial


def _position(mesh: TetMesh, axis: int, wanted: float) -> float:
    """Find the position nearest to `wanted` with a large section; areas by the mean section of each tetrahedron."""
    heights = mesh.points[mesh.cells, axis]
    low, high = heights.min(axis=1), heights.max(axis=1)
    tried = np.linspace(low.min(), high.max(), POSITIONS_TRIED)
    mean = mesh.volumes / (high - low)
    area = np.array([mean[(low <= position) & (position <= high)].sum() for position in tried])
    large = tried[area >= LEAST_SECTION * area.max()]
    return float(np.clip(wanted, large[0], large[-1]))


def _count(side: tuple[float, float], spacing: float) -> int:
    return max(1, round((side[1] - side[0]) / spacing))


def _centres(side: tuple[float, float], count: int) -> np.ndarray:
    return side[0] + (np.arange(count) + 0.5) * (side[1] - side[0]) / count
