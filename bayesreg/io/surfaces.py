"""Triangulated surfaces of Ω and of its tissues, and the target edge length at each point."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from typing import NamedTuple

import edt
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from skimage import measure

from bayesreg.image import Image
from bayesreg.io.domain import main_part
from bayesreg.mesh import signed_volumes
from bayesreg.tissues import BRAIN, is_fluid

# All three are in units of the edge length. Smoothing (standard deviation) removes detail that the mesh cannot show;
# the triangles of the remaining surface need not be finer than the stride.
SMOOTHING = 0.22
FLUID_SMOOTHING = 0.12
STRIDE = 0.25
# Millimetres of edge length per millimetre of depth, so that neighbouring tetrahedra have similar sizes.
GROWTH = 0.7


class Surface(NamedTuple):
    """A closed triangulated surface.

    Attributes
    ----------
    points : (n, 3) array
        Vertices in world RAS, mm.
    faces : (m, 3) array
        Indices into points, with outward normals.
    """

    points: Float[np.ndarray, "points 3"]
    faces: Int[np.ndarray, "faces 3"]

    @property
    def volume(self) -> float:
        """The enclosed volume, mm³; negative if the normals point inwards."""
        a, b, c = np.moveaxis(self.points[self.faces], 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


class Sizing(NamedTuple):
    """The target edge length on a background mesh.

    Attributes
    ----------
    points : (n, 3) array
        Nodes in world RAS, mm.
    cells : (m, 4) array
        Positively oriented tetrahedra.
    values : (n,) array
        Target edge length at each point, mm.
    """

    points: Float[np.ndarray, "nodes 3"]
    cells: Int[np.ndarray, "cells 4"]
    values: Float[np.ndarray, "nodes"]


def tissue_surfaces(labels: Image, edge_length: float, names: Sequence[str] = BRAIN) -> list[Surface]:
    """Extract nested surfaces of Ω and of its tissues, at the detail that a mesh can show.

    The tissues are ordered: first the solid tissue with the largest part of the surface of Ω, then the other solid
    tissues from the largest to the smallest, then the fluids. The first surface encloses Ω, and so no surface belongs
    to the first tissue. Every further surface encloses one tissue and all tissues after it in this order; otherwise the
    interface between two tissues would exist twice, slightly apart. In a brain these are the surface of white matter
    with the fluid deep inside it, and the surface of this fluid.

    Fluid nearer to the outer surface than half an edge length (sulci, the film under the skull) gets no surface of its
    own. Parts and holes of a tissue that are smaller than a cube of half an edge length are removed.

    Parameters
    ----------
    labels : Image
        The labels of `domain_labels`.
    edge_length : float
        Target edge length of the mesh, mm.
    names : sequence of str
        Names of the tissues.

    Returns
    -------
    list of Surface
        The surfaces, the outer one first. All normals point outwards.

    Raises
    ------
    MeshError
        If Ω vanishes or splits into large parts at this resolution.
    """
    grid = _CoarseGrid.around(labels, STRIDE * edge_length, margin=edge_length)
    smallest = (edge_length / 2) ** 3 / grid.voxel_volume
    outer = grid.smoothed(labels.voxels != 0, SMOOTHING * edge_length)
    name = f"region to mesh, smoothed for an edge length of {edge_length:.3g} mm,"
    inside = main_part(grid.image(outer > 0.5), name)
    deep = edt.edt(inside, anisotropy=tuple(grid.spacing)) > edge_length / 2
    outer[(outer > 0.5) & ~inside] = 0
    solids, fluids = _from_outside_in(np.asarray(labels.voxels), names)
    inner: list[np.ndarray] = []
    enclosed = deep * grid.smoothed(np.isin(labels.voxels, fluids), SMOOTHING * edge_length)
    for solid in reversed(solids[1:]):
        enclosed = enclosed + grid.smoothed(labels.voxels == solid, SMOOTHING * edge_length)
        inner.insert(0, enclosed)
    if fluids:
        inner.append(deep * grid.smoothed(np.isin(labels.voxels, fluids), FLUID_SMOOTHING * edge_length))
    fields = [outer, *(_without_specks(field, smallest) for field in inner)]
    return [_surface(field, grid) for field in fields if field.max() > 0.5]


def smoothed_region(labels: Image, edge_length: float) -> Image:
    """Smooth the region Ω, where labels are not zero; the first of its `tissue_surfaces` lies where it is 0.5."""
    grid = _CoarseGrid.around(labels, STRIDE * edge_length, margin=edge_length)
    return grid.image(grid.smoothed(labels.voxels != 0, SMOOTHING * edge_length))


def _from_outside_in(labels: Int[np.ndarray, "X Y Z"], names: Sequence[str]) -> tuple[list[int], list[int]]:
    """List the labels of the solid tissues, in the order of `tissue_surfaces`, and those of the fluids."""
    fluids = [index for index, name in enumerate(names, start=1) if is_fluid(name)]
    solids = [index for index in range(1, len(names) + 1) if index not in fluids]
    solid = np.isin(labels, solids)
    # A fluid may surround all solid tissues, so that their surface is used instead of that of Ω.
    rim = labels[solid & ~ndimage.binary_erosion(ndimage.binary_fill_holes(solid))]
    counts = np.bincount(rim.ravel(), minlength=len(names) + 1)
    sizes = np.bincount(labels.ravel(), minlength=len(names) + 1)
    first = max(solids, key=lambda index: counts[index])
    return [first, *sorted(set(solids) - {first}, key=lambda index: -sizes[index])], fluids


def depth_sizing(labels: Image, edge_length: float, inner_edge_length: float) -> Sizing:
    """Compute a target edge length that grows with the depth below the surface of Ω.

    Parameters
    ----------
    labels : Image
        Nonzero inside Ω.
    edge_length, inner_edge_length : float
        The edge length at the surface and outside Ω, and the largest edge length, mm.
    """
    grid = _CoarseGrid.around(labels, 0.6 * edge_length, margin=2 * edge_length)
    inside = grid.smoothed(labels.voxels != 0, SMOOTHING * edge_length) > 0.5
    # The distance is to the centre of the next voxel outside; the surface lies half a voxel before it.
    depth = np.maximum(edt.edt(inside, anisotropy=tuple(grid.spacing)) - grid.spacing.mean() / 2, 0)
    indices = np.stack(np.meshgrid(*map(np.arange, depth.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    points = grid.to_world(indices)
    values = np.minimum(edge_length + GROWTH * depth, inner_edge_length)
    return Sizing(points, _kuhn_cells(depth.shape, points), values.ravel())


class _CoarseGrid(NamedTuple):
    """The grid of every n-th voxel (n the stride of each axis) of an image's padded grid."""

    stride: tuple[int, int, int]
    padding: tuple[int, int, int]
    affine: Float[np.ndarray, "4 4"]
    voxel_sizes: Float[np.ndarray, "3"]

    @classmethod
    def around(cls, image: Image, spacing: float, margin: float) -> _CoarseGrid:
        stride = np.maximum(1, np.rint(spacing / image.voxel_sizes)).astype(int)
        padding = np.ceil(margin / image.voxel_sizes).astype(int) + stride
        return cls(tuple(stride.tolist()), tuple(padding.tolist()), image.affine, image.voxel_sizes)

    @property
    def spacing(self) -> Float[np.ndarray, "3"]:
        return self.voxel_sizes * self.stride

    @property
    def voxel_volume(self) -> float:
        return float(abs(np.linalg.det(self.affine[:3, :3])) * np.prod(self.stride))

    def smoothed(self, mask: Bool[np.ndarray, "X Y Z"], sigma: float) -> Float[np.ndarray, "A B C"]:
        """Smooth a mask (0 beyond its grid) by a Gaussian of standard deviation sigma, mm; sample it on this grid."""
        padded = np.pad(mask.astype(np.float32), [(n, n) for n in self.padding])
        smooth = ndimage.gaussian_filter(padded, sigma / self.voxel_sizes, mode="constant")
        coarse = smooth[tuple(slice(None, None, step) for step in self.stride)]
        # The stride may skip the last plane, and marching cubes closes a surface only inside its grid.
        return np.pad(coarse, [(0, 1)] * 3)

    def image(self, values: np.ndarray) -> Image:
        affine = self.affine.copy()
        affine[:3, :3] *= self.stride
        affine[:3, 3] = self.to_world(np.zeros(3))
        return Image(values, affine)

    def to_world(self, indices: np.ndarray) -> Float[np.ndarray, "*n 3"]:
        voxels = indices * np.array(self.stride) - self.padding
        return voxels @ self.affine[:3, :3].T + self.affine[:3, 3]


def _without_specks(field: Float[np.ndarray, "A B C"], smallest: float) -> Float[np.ndarray, "A B C"]:
    """Remove parts of a field above 0.5, and holes in them, that have fewer voxels than `smallest`."""
    for inside, level in ((field > 0.5, 0.0), (field <= 0.5, 1.0)):
        components, _ = ndimage.label(inside)
        small = np.bincount(components.ravel()) < smallest
        small[0] = False
        field = np.where(small[components], np.float32(level), field)
    return field


def _surface(field: Float[np.ndarray, "A B C"], grid: _CoarseGrid) -> Surface:
    vertices, faces, _, _ = measure.marching_cubes(field, 0.5)
    surface = Surface(grid.to_world(vertices.astype(float)), faces.astype(np.int64))
    return surface if surface.volume > 0 else surface._replace(faces=surface.faces[:, ::-1])


def _kuhn_cells(shape: tuple[int, ...], points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "m 4"]:
    """Divide each cube of a grid into six positively oriented tetrahedra that share one diagonal."""
    node = np.arange(np.prod(shape)).reshape(shape)
    cells = []
    for axes in permutations(range(3)):
        corner = np.zeros((4, 3), int)
        for step, axis in enumerate(axes, start=1):
            corner[step:, axis] = 1
        cells.append(np.stack([_shift_nodes(node, offset) for offset in corner], axis=-1).reshape(-1, 4))
    stacked = np.concatenate(cells)
    inverted = signed_volumes(points, stacked) < 0
    stacked[inverted] = stacked[inverted][:, (0, 2, 1, 3)]
    return stacked


def _shift_nodes(node: Int[np.ndarray, "A B C"], offset: Int[np.ndarray, "3"]) -> Int[np.ndarray, "a b c"]:
    """Select the nodes at an offset (0 or 1 per axis) from the first corner of every cube."""
    return node[tuple(slice(o, n - 1 + o) for o, n in zip(offset, node.shape, strict=True))]
