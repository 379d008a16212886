"""Small meshes and images for the tests."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pyvista
from scipy import ndimage
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from bayesreg.fem.location import locate
from bayesreg.image import Image
from bayesreg.mesh import TetMesh, signed_volumes

# Small, three-material phantoms: gentle parameters, and the contrast of the paper's experiment.
LAM = np.array([2.0, 5.0, 8.0])
MU = np.array([0.5, 1.0, 1.5])
PAPER_LAM = np.array([1e-6, 10.0, 30.0])
PAPER_MU = np.array([1e-6, 1.0, 1.0])


def ball_mesh(radius: float = 40.0, spacing: float = 18.0, jitter: float = 0.12, seed: int = 0) -> TetMesh:
    """Unstructured ball about (5, -3, 8): jittered body-centred lattice inside a shell of scattered nodes.

    Spacing 30 gives 31 nodes (29 on the boundary), 24: 57 (46), 18: 122 (82), 13: 302 (158).
    """
    rng = np.random.default_rng(seed)
    lattice = _body_centred(2 * radius + spacing, spacing) - radius
    lattice = lattice[np.linalg.norm(lattice, axis=1) < radius - 0.55 * spacing]
    lattice += jitter * spacing * rng.uniform(-1, 1, lattice.shape)
    shell = _fibonacci_sphere(int(4 * np.pi * radius**2 / spacing**2 / 0.75)) * radius
    return _delaunay_mesh(np.vstack([lattice, shell]) + np.array([5.0, -3.0, 8.0]))


def box_mesh(
    cells_per_side: int = 2, size: float = 20.0, jitter: float = 0.15, seed: int = 0, origin: float = 0.0
) -> TetMesh:
    """Unstructured mesh of an exact cube, [origin, origin + size]³, of a jittered body-centred grid.

    Corners stay, nodes of edges and faces move within these. With 2 cells per side there are 35 nodes,
    26 of them on the boundary.
    """
    rng = np.random.default_rng(seed)
    grid = _body_centred(1.0, 1 / cells_per_side)
    grid = grid[(grid < 1 + 1e-9).all(axis=1)].clip(0, 1)
    inner = (grid > 1e-9) & (grid < 1 - 1e-9)
    grid = grid + inner * rng.uniform(-1, 1, grid.shape) * jitter / cells_per_side
    return _delaunay_mesh(grid * size + origin, flat=1e-9)


def of_one_tissue(mesh: TetMesh) -> TetMesh:
    """Return a mesh whose cells all are of the tissue "organ"."""
    return TetMesh.from_arrays(mesh.points, mesh.cells, np.zeros(len(mesh.cells), int), ("organ",))


def save_grid(path: Path, points: np.ndarray, cells: np.ndarray, tissue: np.ndarray | None = None) -> None:
    """Write tetrahedra as they are, sound or not, by PyVista alone."""
    grid = pyvista.UnstructuredGrid({pyvista.CellType.TETRA: cells}, points)
    if tissue is not None:
        grid.cell_data["tissue"] = tissue
    grid.save(path)


def refined(mesh: TetMesh) -> TetMesh:
    """Every tetrahedron split into eight through its edge midpoints, along its shortest inner diagonal."""
    edges = np.array(list(combinations(range(4), 2)))
    pairs = np.sort(mesh.cells[:, edges].reshape(-1, 2), axis=1)
    unique, index = np.unique(pairs, axis=0, return_inverse=True)
    points = np.vstack([mesh.points, mesh.points[unique].mean(axis=1)])
    middle = index.reshape(-1, 6) + len(mesh.points)
    cells, tissue = [], []
    for corner, m, label in zip(mesh.cells, middle, mesh.tissue, strict=True):
        children = _eight_children(points, corner, dict(zip(map(tuple, edges), m, strict=True)))
        cells += children
        tissue += [label] * 8
    return TetMesh.from_arrays(points, _oriented(points, np.array(cells)), np.array(tissue), mesh.names)


def rotated_affine(
    points: np.ndarray,
    shape: tuple[int, int, int],
    margin: float = 12.0,
    angles: tuple[float, float, float] = (20.0, -15.0, 35.0),
    left_handed: bool = True,
) -> np.ndarray:
    """Affine of a rotated, anisotropic (and by default left-handed) grid that covers points by a margin, mm."""
    axes = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    if left_handed:
        axes[:, 1] *= -1
    along = points @ axes
    low, high = along.min(axis=0) - margin, along.max(axis=0) + margin
    affine = np.eye(4)
    affine[:3, :3] = axes * (high - low) / (np.array(shape) - 1)
    affine[:3, 3] = axes @ low
    return affine


def smooth_image(
    points: np.ndarray, shape: tuple[int, int, int] = (14, 11, 16), seed: int = 0, blur: float = 1.5, **kwargs: Any
) -> Image:
    """Smooth random image in [0, 1] on a rotated grid that covers points; further arguments: `rotated_affine`."""
    noise = np.random.default_rng(seed).normal(size=shape)
    values = ndimage.gaussian_filter(noise, blur)
    values = (values - values.min()) / np.ptp(values)
    return Image(values, rotated_affine(points, shape, **kwargs))


def pair_from_model(
    mesh: TetMesh, u: np.ndarray, noise_sd: float, voxel: float = 3.0, blur: float = 4.0, seed: int = 0
) -> tuple[Image, Image, float]:
    """A pair drawn from the model with quadrature "voxels": f(x_q) = m(x_q + u(x_q)) + N(0, sd²), m textured.

    Cubic interpolation of m. Outside the mesh f goes on with the displacement of the nearest voxel inside. Also the
    T_s = 2 w_q sd² of that noise.
    """
    rng = np.random.default_rng(seed)
    low, high = mesh.points.min(axis=0) - 12, mesh.points.max(axis=0) + 12
    affine = np.diag([voxel, voxel, voxel, 1.0])
    affine[:3, 3] = low
    texture = ndimage.gaussian_filter(rng.normal(size=np.ceil((high - low) / voxel).astype(int)), blur / voxel)
    moving = Image((texture - texture.min()) / np.ptp(texture), affine)
    cells, barycentric = locate(mesh.points, mesh.cells, moving.grid_points().reshape(-1, 3))
    inside = cells >= 0
    displacement = np.zeros((len(cells), 3))
    displacement[inside] = np.einsum("qa,qai->qi", barycentric[inside], np.asarray(u)[mesh.cells[cells[inside]]])
    away = ~inside.reshape(moving.shape)
    nearest = ndimage.distance_transform_edt(away, return_distances=False, return_indices=True)
    displacement = displacement.reshape(*moving.shape, 3)[tuple(nearest)]
    values = np.array(moving.interpolate(moving.grid_points() + displacement, "cubic"))
    values[~away] += noise_sd * rng.normal(size=inside.sum())
    values[away] += noise_sd * rng.normal(size=away.sum())
    return moving.with_voxels(values), moving, 2 * voxel**3 * noise_sd**2


def linear_image(
    points: np.ndarray, gradient: np.ndarray, offset: float = 0.0, margin: float = 30.0, size: int = 6
) -> Image:
    """Image of value offset + gradient · x (world mm), exact under linear interpolation within the margin."""
    grid = Image(np.zeros((size, size + 1, size)), rotated_affine(points, (size, size + 1, size), margin))
    return grid.with_voxels(offset + grid.grid_points() @ np.asarray(gradient, float))


def flat_skull(points: np.ndarray, axis: int, wall: float, voxel: float = 1.0, margin: float = 30.0) -> Image:
    """Skull (1 = forbidden) at and beyond the plane x[axis] = wall, on an upright grid, the wall on voxel faces."""
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    low = wall + np.floor((low - wall) / voxel) * voxel + voxel / 2
    shape = np.ceil((high - low) / voxel).astype(int)
    affine = np.diag([voxel, voxel, voxel, 1.0])
    affine[:3, 3] = low
    empty = Image(np.zeros(shape, np.uint8), affine)
    return empty.with_voxels((empty.grid_points()[..., axis] > wall).astype(np.uint8))


def _delaunay_mesh(points: np.ndarray, flat: float = 2e-2) -> TetMesh:
    cells = Delaunay(points).simplices
    volume = np.abs(signed_volumes(points, cells))
    # Flat tetrahedra appear between the coplanar or cospherical nodes of the surface only.
    cells = _oriented(points, cells[volume > flat * np.median(volume)])
    used, cells = np.unique(cells, return_inverse=True)
    points, cells = points[used], cells.reshape(-1, 4)
    return TetMesh.from_arrays(points, cells, _three_tissues(points, cells))


def _three_tissues(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Nested and off-centre by rank: a fifth CSF (0) within WM (2), within GM (1)."""
    centre = points[cells].mean(axis=1)
    size = np.ptp(points, axis=0)
    distance = np.linalg.norm((centre - points.mean(axis=0)) / size - (0.1, 0.05, -0.05), axis=1)
    rank = distance.argsort(kind="stable").argsort() / len(cells)
    return np.where(rank < 0.2, 0, np.where(rank < 0.6, 2, 1))


def _oriented(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    cells = cells.copy()
    inverted = signed_volumes(points, cells) < 0
    cells[inverted] = cells[inverted][:, (0, 2, 1, 3)]
    return cells


def _eight_children(points: np.ndarray, corner: np.ndarray, m: dict[tuple[int, int], int]) -> list[list[int]]:
    children = [[corner[i]] + [m[min(i, j), max(i, j)] for j in range(4) if j != i] for i in range(4)]
    diagonals = [((0, 1), (2, 3)), ((0, 2), (1, 3)), ((0, 3), (1, 2))]
    length = [np.linalg.norm(points[m[a]] - points[m[b]]) for a, b in diagonals]
    a, b = diagonals[int(np.argmin(length))]
    # The four midpoints off the diagonal, in order around it: opposite edges are opposite corners.
    first, second = (pair for pair in diagonals if pair != (a, b))
    ring = [first[0], second[0], first[1], second[1]]
    return children + [[m[a], m[b], m[ring[i]], m[ring[(i + 1) % 4]]] for i in range(4)]


def _body_centred(extent: float, spacing: float) -> np.ndarray:
    axis = np.arange(0.0, extent + spacing / 2, spacing)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.vstack([grid, grid + spacing / 2])


def _fibonacci_sphere(count: int) -> np.ndarray:
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    angle = np.pi * (1 + 5**0.5) * i
    radius = np.sqrt(1 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
