"""Pairs of images whose motion no model of this project made, with the truth of every voxel.

    BAYESREG_DATA=… python -m studies.external.make_pair {sag,gravity,resect} -o PAIR [--seed 1] [--bias 0.15] …

A field that is no equilibrium of linear tetrahedra moves Colin27 (T1, 1 mm):

- sag is a smooth analytic sinking under a craniotomy, with a squeeze towards the midline, without any mechanics;
- gravity is a body force on trilinear hexahedra of 5 mm in GM, WM and CSF with Poisson ratio 0.45; the base is held,
  and the brain is free to leave the skull but cannot enter it;
- resect is gravity with a cavity: a ball of tissue is removed, and its walls fall in by a quarter of its radius.

m(x + u(x)) = f(x) wherever tissue remains. Fluid fills the space that the brain leaves; skull and scalp do not move.
This module shares no code with bayesreg. The folder PAIR holds

- fixed, moving, labels and intracranial, and cavity (on the moving grid) of a resection, each .nii.gz;
- truth.npz: u, (X, Y, Z, 3) in mm, world RAS, on the fixed grid; valid, the voxels where u is right; walls, the valid
  voxels within 10 mm of the wall of a cavity;
- points.csv: 60 places in tissue, fixed x, y, z and moving x, y, z in mm, RAS, which no registration uses;
- pair.json: the options, and the properties of the pair.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import nibabel as nib
import numpy as np
from scipy import ndimage as ndi
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import LinearOperator, cg

Kind = Literal["sag", "gravity", "resect"]
KINDS = ("sag", "gravity", "resect")

T1, LABELS = "colin27_t1_1mm_unedited.nii.gz", "brainweb_crisp_1mm.nii.gz"
# The labels of BrainWeb.
CSF, GM, WM, GLIA = 1, 2, 3, 8
# Intensities of Colin27 in fluid and in white matter.
FLUID, WHITE = 40.0, 145.0
# T1 intensities and their T2 counterparts: dark and bright change places.
T1_VALUES, T2_VALUES = [0, 24, 40, 54, 109, 145, 255], [5, 160, 150, 150, 95, 70, 60]
# The relative Young's moduli of CSF, GM and WM, the sd of their logarithm between cells, and ν.
YOUNG, YOUNG_LOG_SD, POISSON = (0.15, 1.0, 1.6), 0.1, 0.45
# The edge of a hexahedron, the radius of a resection, and the depth of its centre, mm.
EDGE, RADIUS, DEPTH = 5, 14.0, 16
# The stiffness of the springs that hold the base, and of the skull where the brain presses against it.
HELD, PRESSED = 50.0, 20.0

CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


class Anatomy(NamedTuple):
    """Colin27 and its masks."""

    # (X, Y, Z)
    t1: np.ndarray
    # (X, Y, Z), the labels of BrainWeb
    labels: np.ndarray
    # (X, Y, Z): the inside of the skull, and the brain with the fluid between its folds.
    intracranial: np.ndarray
    hull: np.ndarray
    # Voxel index to world RAS, mm.
    affine: np.ndarray

    def values(self, array: np.ndarray, points: np.ndarray, order: int = 1, prefilter: bool = True) -> np.ndarray:
        """Interpolate an array on this grid at points, (..., 3) in mm, world RAS."""
        inverse = np.linalg.inv(self.affine)
        indices = (points @ inverse[:3, :3].T + inverse[:3, 3]).reshape(-1, 3).T
        return ndi.map_coordinates(array, indices, order=order, mode="nearest", prefilter=prefilter).reshape(
            points.shape[:-1]
        )

    def vectors(self, field: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Interpolate a field of vectors, (X, Y, Z, 3), at points."""
        return np.stack([self.values(field[..., i], points) for i in range(3)], axis=-1)

    def world(self, voxels: np.ndarray) -> np.ndarray:
        """Convert voxel indices, (..., 3), to mm, world RAS."""
        return voxels @ self.affine[:3, :3].T + self.affine[:3, 3]


class Site(NamedTuple):
    """The opening of the skull, mm, world RAS."""

    place: np.ndarray
    # Unit vector from the centre of the brain towards the opening.
    outwards: np.ndarray
    centre: np.ndarray


def read_anatomy(data: Path) -> Anatomy:
    """Read BrainWeb's labels and the T1 image of Colin27 from a folder."""
    t1, crisp = (nib.load(data / name) for name in (T1, LABELS))
    labels = np.asarray(crisp.dataobj).astype(np.uint8)
    inside = _largest(np.isin(labels, (CSF, GM, WM, GLIA)))
    margin, width = 12, 8
    tissue = np.pad(inside & np.isin(labels, (GM, WM, GLIA)), margin)
    hull = ndi.binary_closing(tissue, iterations=width)[margin:-margin, margin:-margin, margin:-margin]
    return Anatomy(np.asarray(t1.dataobj, float), labels, inside, ndi.binary_fill_holes(hull) & inside, t1.affine)


def site_of(anatomy: Anatomy, rng: np.random.Generator) -> Site:
    """Draw a random place on the upper surface of the brain."""
    world = anatomy.world(np.argwhere(anatomy.hull))
    centre = world.mean(0)
    d = np.array([rng.choice([-1, 1]) * rng.uniform(0.4, 0.9), rng.uniform(-0.6, 0.6), rng.uniform(0.4, 0.9)])
    d /= np.linalg.norm(d)
    along, off = (world - centre) @ d, np.linalg.norm(np.cross(world - centre, d), axis=1)
    return Site(world[(along - 2 * off).argmax()], d, centre)


def sag(X: np.ndarray, site: Site, amplitude: float, rng: np.random.Generator) -> np.ndarray:
    """Displacement at points X, (..., 3) in mm: a Gaussian sinking at the site, and a squeeze by the midline."""
    d = site.outwards
    down = -0.6 * d + np.array([rng.uniform(-0.3, 0.3), -0.5, -0.35])
    down /= np.linalg.norm(down)
    width = rng.uniform(30, 45)
    sinking = amplitude * _bell(X, site.place, width) * down
    beside = site.centre + np.array([20 * np.sign(d[0]), 0, 5])
    squeeze = _bell(X, beside, 22.0) * np.array([-np.sign(d[0]), 0.2, -0.2])
    return sinking + 0.25 * amplitude * squeeze


def gravity(
    anatomy: Anatomy, site: Site, amplitude: float, rng: np.random.Generator, removed: np.ndarray | None = None
) -> np.ndarray:
    """Displacement of every voxel of a brain under its weight, (X, Y, Z, 3), at most about `amplitude`, mm.

    Parameters
    ----------
    anatomy, site, amplitude, rng
    removed : (X, Y, Z) array of booleans, optional
        The removed tissue, which has no weight and almost no stiffness.
    """
    shape = np.array(anatomy.t1.shape) // EDGE + 1
    filled = _largest(_voxels_of_cells(anatomy.hull, shape) > EDGE**3 / 2)
    tissues = [anatomy.hull & np.isin(anatomy.labels, values) for values in ((CSF,), (GM, GLIA), (WM,))]
    kinds = np.stack([_voxels_of_cells(tissue, shape) for tissue in tissues]).argmax(0)
    young = np.array(YOUNG)[kinds] * np.exp(rng.normal(0, YOUNG_LOG_SD, kinds.shape))
    gone = np.zeros(shape, bool) if removed is None else _voxels_of_cells(removed, shape) > EDGE**3 / 2
    young = np.where(gone, 1e-3, young)
    down = -0.5 * site.outwards + np.array([rng.uniform(-0.4, 0.4), -0.6, -0.4])
    down /= np.linalg.norm(down)

    cells = np.argwhere(filled)
    corners = np.ravel_multi_index((cells[:, None] + CORNERS).reshape(-1, 3).T, shape + 1)
    used, inverse = np.unique(corners, return_inverse=True)
    nodes_of_cells = inverse.reshape(-1, 8)
    nodes = np.stack(np.unravel_index(used, shape + 1), axis=1)
    world = anatomy.world(nodes * EDGE - 0.5)

    weight = np.zeros((len(world), 3))
    shares = np.repeat((~gone)[tuple(cells.T)] * EDGE**3 / 8, 8)
    np.add.at(weight, nodes_of_cells.ravel(), shares[:, None] * down)
    # Buoyancy carries the full weight 60 mm below the opening, and none of it at its height and above.
    weight *= np.clip(1 + ((world - site.place) @ -down) / 60, 0, 1)[:, None]
    outer = np.bincount(nodes_of_cells.ravel(), minlength=len(world)) < 8
    K = _stiffness(nodes_of_cells, young[tuple(cells.T)])
    return _between_nodes(_equilibrium(K, weight, outer, world, anatomy, amplitude), nodes, shape, anatomy.t1.shape)


def hexahedron(lam: float, mu: float, edge: float) -> np.ndarray:
    """Stiffness of a trilinear hexahedron, (24, 24), by quadrature at 2 × 2 × 2 points."""
    signs = CORNERS * 2 - 1
    C = np.zeros((6, 6))
    C[:3, :3] = lam
    C[np.arange(6), np.arange(6)] += [2 * mu] * 3 + [mu] * 3
    K = np.zeros((24, 24))
    for q in signs / np.sqrt(3):
        factors = 1 + signs * q
        slopes = [np.prod(np.where(np.arange(3) == a, signs, factors).T, 0) / 8 * 2 / edge for a in range(3)]
        B = np.zeros((6, 24))
        for a in range(3):
            B[a, a::3] = slopes[a]
        for row, (a, b) in enumerate([(0, 1), (0, 2), (1, 2)], 3):
            B[row, a::3], B[row, b::3] = slopes[b], slopes[a]
        K += B.T @ C @ B * (edge / 2) ** 3
    return K


def _stiffness(nodes_of_cells: np.ndarray, young: np.ndarray) -> csr_matrix:
    unit_stiffness = hexahedron(POISSON / (1 + POISSON) / (1 - 2 * POISSON), 0.5 / (1 + POISSON), EDGE)
    unknowns = (3 * nodes_of_cells[:, :, None] + np.arange(3)).reshape(len(nodes_of_cells), 24)
    rows, columns = np.repeat(unknowns, 24, 1).ravel(), np.tile(unknowns, (1, 24)).ravel()
    return coo_matrix(((young[:, None, None] * unit_stiffness).ravel(), (rows, columns))).tocsr()


def _equilibrium(
    K: csr_matrix, weight: np.ndarray, outer: np.ndarray, world: np.ndarray, anatomy: Anatomy, amplitude: float
) -> np.ndarray:
    """Displacement of the nodes, mm, with the weight scaled to move them by `amplitude`, in contact with the skull."""
    n = len(world)
    height = world[:, 2]
    base = np.where(height < np.percentile(height, 6), HELD, 0.0)
    room = ndi.distance_transform_edt(anatomy.intracranial) - ndi.distance_transform_edt(~anatomy.intracranial)
    inwards = anatomy.vectors(np.stack(np.gradient(ndi.gaussian_filter(room, 2)), -1), world)
    inwards /= np.linalg.norm(inwards, axis=1, keepdims=True) + 1e-9
    gap = np.maximum(anatomy.values(room, world) - 0.5, 0)
    index = 3 * np.arange(n)[:, None, None] + np.zeros((3, 3), int)
    rows, columns = (index + np.arange(3)[:, None]).ravel(), (index + np.arange(3)).ravel()
    force, u, pressed = 1.0, np.zeros((n, 3)), np.zeros(n, bool)
    for _ in range(14):
        wall = np.where(pressed & outer, PRESSED, 0.0)
        springs = (wall[:, None, None] * inwards[:, :, None] * inwards[:, None, :]) + base[:, None, None] * np.eye(3)
        A = K + coo_matrix((springs.ravel(), (rows, columns))).tocsr() + 1e-6 * diags(np.ones(3 * n))
        load = (force * weight - (wall * gap)[:, None] * inwards).ravel()
        inverse_diagonal = 1 / A.diagonal()
        jacobi = LinearOperator(A.shape, lambda v, inverse_diagonal=inverse_diagonal: inverse_diagonal * v)
        x, _ = cg(A, load, x0=u.ravel(), rtol=1e-6, maxiter=4000, M=jacobi)
        u = x.reshape(-1, 3)
        force *= (amplitude / max(np.linalg.norm(u, axis=1).max(), 1e-9)) ** 0.7
        pressed = outer & ((u * inwards).sum(1) < -gap)
    return u


def _between_nodes(u: np.ndarray, nodes: np.ndarray, shape: np.ndarray, grid: tuple[int, ...]) -> np.ndarray:
    """Interpolate from the nodes to the voxels, and smooth the kinks between cells."""
    coarse, has_value = np.zeros((*(shape + 1), 3)), np.zeros(shape + 1)
    coarse[tuple(nodes.T)] = u
    has_value[tuple(nodes.T)] = 1
    coarse = coarse[tuple(ndi.distance_transform_edt(has_value == 0, return_distances=False, return_indices=True))]
    indices = np.stack(np.meshgrid(*[(np.arange(size) + 0.5) / EDGE for size in grid], indexing="ij")).reshape(3, -1)
    fine = [ndi.map_coordinates(coarse[..., i], indices, order=3, mode="nearest").reshape(grid) for i in range(3)]
    return np.stack([ndi.gaussian_filter(component, 1.5) for component in fine], -1)


def falling_in(away: np.ndarray) -> np.ndarray:
    """Displacement, mm, at places relative to the centre of a cavity; its walls fall in by a quarter of its radius."""
    r = np.linalg.norm(away, axis=-1, keepdims=True)
    return -0.25 * RADIUS * np.exp(-np.maximum(r - RADIUS, 0) / 10) * away / np.maximum(r, RADIUS / 2)


def moved(
    anatomy: Anatomy, X: np.ndarray, u: np.ndarray, removed: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The T1 image of the moved brain, without noise.

    Returns
    -------
    (X, Y, Z) arrays
        The image; the mask of the cavity; and the error of the inverse of x + u(x) at each voxel, mm.
    """
    # x + u(x) = X
    x = X - u
    for _ in range(40):
        x = X - anatomy.vectors(u, x)
    off = np.abs(x + anatomy.vectors(u, x) - X).max(-1)
    here = anatomy.values(anatomy.hull.astype(float), x) > 0.5
    tissue = here & anatomy.intracranial
    m = np.where(anatomy.intracranial & ~here & anatomy.hull, FLUID, anatomy.t1)
    m[tissue] = anatomy.values(ndi.spline_filter(anatomy.t1, 3), x, order=3, prefilter=False)[tissue]
    cavity = np.zeros(m.shape, bool)
    if removed is not None:
        cavity = (anatomy.values(removed.astype(float), x) > 0.5) & tissue
        m[cavity] = FLUID * 0.6
    return m, cavity, off


def shaded(image: np.ndarray, X: np.ndarray, centre: np.ndarray, strength: float) -> np.ndarray:
    """Multiply the image by a smooth shading, which changes its sides and ends by about half of `strength`."""
    c = (X - centre) / 90
    return image * (1 + strength * (0.6 * c[..., 0] - 0.5 * c[..., 1] + 0.4 * c[..., 2] * c[..., 0]))


class Slices(NamedTuple):
    """An oblique, left-handed grid of thick slices."""

    # Voxel index to world RAS, mm.
    affine: np.ndarray
    size: np.ndarray
    thickness: float

    def centres(self, off: float = 0.0) -> np.ndarray:
        """Centres of the voxels, mm, world RAS, moved along the normal of the slices by `off` thicknesses."""
        return (_indices(self.size) + np.array([0, 0, off])) @ self.affine[:3, :3].T + self.affine[:3, 3]

    def of(self, image: np.ndarray, anatomy: Anatomy) -> np.ndarray:
        """Resample an image from the grid of the anatomy, averaged over the thickness."""
        edges = np.linspace(-0.5, 0.5, max(int(self.thickness * 2), 1) + 1)
        return np.mean([anatomy.values(image, self.centres(off)) for off in (edges[1:] + edges[:-1]) / 2], 0)


def slices_about(X: np.ndarray, thickness: float) -> Slices:
    """Make slices that cover the whole head."""
    t = np.deg2rad(12)
    turned = np.array([[np.cos(t), 0, np.sin(t)], [0, 1, 0], [-np.sin(t), 0, np.cos(t)]]) @ np.diag([-1, 1, 1])
    size = np.array([190, 220, int(200 / thickness)])
    affine = np.eye(4)
    affine[:3, :3] = turned * np.array([1.0, 1.0, thickness])
    affine[:3, 3] = X.reshape(-1, 3).mean(0) - affine[:3, :3] @ (size - 1) / 2
    return Slices(affine, size, thickness)


def misalignment(centre: np.ndarray, magnitude: float, rng: np.random.Generator) -> np.ndarray:
    """A random rigid motion, (4, 4), about the centre by `magnitude` degrees and `magnitude` mm."""
    T = np.eye(4)
    if magnitude:
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        k, t = np.cross(np.eye(3), axis), np.deg2rad(magnitude)
        T[:3, :3] = np.eye(3) + np.sin(t) * k + (1 - np.cos(t)) * k @ k
        shift = rng.normal(size=3)
        T[:3, 3] = centre - T[:3, :3] @ centre + magnitude * shift / np.linalg.norm(shift)
    return T


def make_pair(
    kind: Kind,
    data: Path,
    out: Path,
    *,
    seed: int = 1,
    amplitude: float = 10.0,
    noise: float = 0.03,
    bias: float = 0.0,
    contrast: Literal["t1", "t2"] = "t1",
    thick: float = 0.0,
    rigid: float = 0.0,
) -> dict[str, Any]:
    """Write a pair and return the content of its pair.json.

    Parameters
    ----------
    kind : {"sag", "gravity", "resect"}
    data : path
        Folder of BrainWeb's labels and Colin27's T1.
    out : path
        Folder of the pair, which is created if it does not exist.
    seed : int
    amplitude : float
        Greatest displacement, mm.
    noise : float
        sd on each image, relative to white matter.
    bias : float
        Strength of a smooth shading of the moving image.
    contrast : {"t1", "t2"}
        With "t2" dark and bright change places in the moving image.
    thick : float
        Thickness of the slices of an oblique, left-handed moving grid, mm; 0 is the fixed grid.
    rigid : float
        Misalignment in the header of the moving image, in mm and in degrees.
    """
    rng = np.random.default_rng(seed)
    anatomy = read_anatomy(data)
    X = anatomy.world(_indices(anatomy.t1.shape))
    site = site_of(anatomy, rng)
    away = X - (site.place - DEPTH * site.outwards)
    removed = (away**2).sum(-1) < RADIUS**2 if kind == "resect" else None
    u = sag(X, site, amplitude, rng) if kind == "sag" else gravity(anatomy, site, amplitude, rng, removed)
    if removed is not None:
        u = u + falling_in(away)
    m, cavity, off = moved(anatomy, X, u, removed)
    if contrast == "t2":
        m = np.interp(m, T1_VALUES, T2_VALUES)
    if bias:
        m = shaded(m, X, site.centre, bias)
    moving, moving_affine = m, anatomy.affine
    if thick:
        slices = slices_about(X, thick)
        moving, moving_affine = slices.of(m, anatomy), slices.affine
        cavity = anatomy.values(cavity.astype(float), slices.centres()) > 0.5
    fixed = anatomy.t1 + rng.normal(size=anatomy.t1.shape) * noise * WHITE
    moving = moving + rng.normal(size=moving.shape) * noise * WHITE
    T = misalignment(site.centre, rigid, rng)
    total = (X + u) @ T[:3, :3].T + T[:3, 3] - X

    # The truth is not valid where x + u(x) cannot be inverted or lies outside the skull.
    held = anatomy.values(anatomy.intracranial.astype(float), X + u) > 0.5
    valid = anatomy.hull & (anatomy.values(off, X + u) < 0.05) & held
    walls = np.zeros(valid.shape, bool)
    if removed is not None:
        valid &= ~removed
        walls = valid & (np.abs(np.linalg.norm(away, axis=-1) - RADIUS) < 10)

    out.mkdir(parents=True, exist_ok=True)
    _save(fixed, anatomy.affine, out / "fixed.nii.gz", np.float32)
    _save(moving, T @ moving_affine, out / "moving.nii.gz", np.float32)
    tissues = np.where(anatomy.labels == GLIA, GM, anatomy.labels) * anatomy.intracranial
    _save(tissues, anatomy.affine, out / "labels.nii.gz", np.uint8)
    _save(anatomy.intracranial, anatomy.affine, out / "intracranial.nii.gz", np.uint8)
    if removed is not None:
        _save(cavity, T @ moving_affine, out / "cavity.nii.gz", np.uint8)
    np.savez_compressed(out / "truth.npz", u=total.astype(np.float32), valid=valid, walls=walls)
    pool = np.argwhere(ndi.binary_erosion(valid, iterations=2) & np.isin(anatomy.labels, (GM, WM)))
    chosen = tuple(pool[rng.choice(len(pool), 60, replace=False)].T)
    rows = np.concatenate([X[chosen], (X + total)[chosen]], 1)
    names = ",".join(f"{image}_{axis}" for image in ("fixed", "moving") for axis in "xyz")
    np.savetxt(out / "points.csv", rows, "%.3f", ",", header=names, comments="")

    size = np.linalg.norm(u, axis=-1)
    J = np.linalg.det(np.stack(np.gradient(u, axis=(0, 1, 2)), -1) + np.eye(3))[valid]
    residual = (anatomy.values(m, X + u) - anatomy.t1)[valid & (size > 1)]
    facts = {
        "kind": kind,
        "seed": seed,
        "amplitude": amplitude,
        "noise": noise,
        "bias": bias,
        "contrast": contrast,
        "thick": thick,
        "rigid": rigid,
        "mean": size[valid].mean(),
        "p95": np.percentile(size[valid], 95),
        "max": size[valid].max(),
        "valid_share": valid.sum() / anatomy.hull.sum(),
        "det_min": J.min(),
        "det_p1": np.percentile(J, 1),
        "residual_sd_at_truth": np.std(residual) / WHITE if contrast == "t1" else None,
    }
    if kind != "sag":
        facts |= {"young_csf_gm_wm": list(YOUNG), "young_log_sd_of_cells": YOUNG_LOG_SD, "poisson": POISSON}
    facts = {name: round(float(value), 4) if isinstance(value, float) else value for name, value in facts.items()}
    (out / "pair.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    return facts


def _indices(shape: Iterable[int]) -> np.ndarray:
    """Indices of all voxels of a grid, (X, Y, Z, 3)."""
    return np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), -1)


def _bell(X: np.ndarray, centre: np.ndarray, width: float) -> np.ndarray:
    return np.exp(-((X - centre) ** 2).sum(-1) / (2 * width**2))[..., None]


def _largest(mask: np.ndarray) -> np.ndarray:
    """The largest connected part of a mask."""
    components, _ = ndi.label(mask)
    return components == np.bincount(components.ravel())[1:].argmax() + 1


def _voxels_of_cells(mask: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """The number of voxels of the mask in each cell of the coarse grid."""
    cells = np.ravel_multi_index((np.argwhere(mask) // EDGE).T, shape)
    return np.bincount(cells, minlength=np.prod(shape)).reshape(shape)


def _save(array: np.ndarray, affine: np.ndarray, path: Path, kind: type) -> None:
    nib.save(nib.Nifti1Image(array.astype(kind), affine), path)


def data_folder() -> Path:
    """The folder that BAYESREG_DATA names; the program ends if it does not hold both files."""
    folder = Path(os.environ.get("BAYESREG_DATA") or ".")
    missing = [name for name in (T1, LABELS) if not (folder / name).is_file()]
    if missing:
        raise SystemExit(
            f"no {' and no '.join(missing)}; set BAYESREG_DATA to the folder that holds both (see README.md)"
        )
    return folder


def main() -> None:
    """Make a pair and print its properties."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--data", type=Path, help="folder of the two images; default: BAYESREG_DATA")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--amplitude", type=float, default=10.0, help="greatest displacement, mm")
    parser.add_argument("--noise", type=float, default=0.03, help="sd on each image, relative to white matter")
    parser.add_argument("--bias", type=float, default=0.0, help="strength of a smooth shading of the moving image")
    parser.add_argument("--contrast", choices=("t1", "t2"), default="t1", help="t2: dark and bright change places")
    parser.add_argument("--thick", type=float, default=0.0, help="slice thickness of an oblique moving grid, mm")
    parser.add_argument("--rigid", type=float, default=0.0, help="misalignment in the moving header, mm and degrees")
    options = vars(parser.parse_args())
    data = options.pop("data") or data_folder()
    print(json.dumps(make_pair(options.pop("kind"), data, options.pop("out"), **options)))


if __name__ == "__main__":
    main()
