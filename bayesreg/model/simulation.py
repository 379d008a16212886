"""Synthetic pairs with a known truth, after section 4.1 of the paper."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.sparse.csgraph import dijkstra

from bayesreg.fem.elasticity import stiffness
from bayesreg.image import Image
from bayesreg.mesh import TetMesh, signed_volumes
from bayesreg.model.contact import ContactProblem, EnergyMinimum
from bayesreg.model.inversion import deformed_image, residuals
from bayesreg.model.obstacle import SmoothObstacle
from bayesreg.types import InputError

Direction = tuple[float, float, float]

_ROUNDS_OF_FLOORS = 20


class Deformation(NamedTuple):
    """A patch of the boundary pushed in, and the least elastic energy of the rest.

    Attributes
    ----------
    u : (n, 3) array
        Displacement of every node, mm.
    patch : (k,) int array
        The nodes that were pushed.
    contact : (c,) int array
        Nodes that press against the skull.
    minimum : EnergyMinimum
        Contact forces and how well the minimum converged.
    volume_ratio : (m,) array
        det F of every tetrahedron, all positive.
    """

    u: Float[np.ndarray, "nodes 3"]
    patch: Int[np.ndarray, "patch"]
    contact: Int[np.ndarray, "contact"]
    minimum: EnergyMinimum
    volume_ratio: Float[np.ndarray, "cells"]


class SyntheticPair(NamedTuple):
    """Two images, and the deformation between them that made the second.

    Attributes
    ----------
    fixed, moving : Image
        f and m on one grid, noise included; m(x + u(x)) = f(x) but for noise and interpolation.
    mesh : TetMesh
        The mesh that made the pair. Where the registration uses another one, its truth is
        `transfer(pair.u, pair.mesh, other.points)`.
    u : (n, 3) array
        True displacement of every node of `mesh`, mm.
    lam, mu : (T,) array
        True Lamé parameters.
    deformation : Deformation
    residual_sd : float
        Standard deviation of f(x) − m(x + u(x)) at the four-point quadrature points, linear interpolation:
        noise and interpolation together.
    interpolation_sd : float
        The same without the noise.
    smoothing_mm, noise_sd : float
        As given.
    """

    fixed: Image
    moving: Image
    mesh: TetMesh
    u: Float[np.ndarray, "nodes 3"]
    lam: Float[np.ndarray, "tissues"]
    mu: Float[np.ndarray, "tissues"]
    deformation: Deformation
    residual_sd: float
    interpolation_sd: float
    smoothing_mm: float
    noise_sd: float


def make_pair(
    fixed: Image,
    tissue: Image,
    skull: Image,
    mesh: TetMesh,
    *,
    lam: Float[np.ndarray, "tissues"],
    mu: Float[np.ndarray, "tissues"],
    displacement: float = 15.0,
    patch_nodes: int = 20,
    direction: Direction = (0.6, 0.3, 0.75),
    margin: float = 0.1,
    smoothing_mm: float = 1.0,
    noise_sd: float = 0.003,
    seed: int = 0,
) -> SyntheticPair:
    """A pair of images with a known deformation and stiffness.

    The *paper pair*: the defaults, and the same mesh for making and for registering, as the paper did (an
    inverse crime). The *calibrated pair*: `noise_sd` 0.01, and a finer mesh here than in the registration.

    Parameters
    ----------
    fixed : Image
        Intensities of about [0, 1]: the noise is added as it stands.
    tissue : Image
        0 = outside, then 1 + index into `mesh.names`; on the grid of `fixed`.
    skull : Image
        Nonzero = forbidden; on the same grid.
    mesh : TetMesh
        One of its tissues is named "csf".
    lam, mu : (T,) array
        Lamé parameters by tissue.
    displacement, patch_nodes, direction, margin
        See `push_patch`.
    smoothing_mm : float, default 1.0
        Standard deviation of the Gaussian that f is smoothed by beforehand, so that interpolation leaves
        less than the noise does. 0 leaves f as it is.
    noise_sd : float, default 0.003
        Standard deviation of the independent Normal noise on each image.
    seed : int, default 0
        Of the noise.

    Raises
    ------
    InputError
        If the images are on different grids or do not cover the mesh, no tissue is called CSF or the image
        has none of it, or as `push_patch` says.
    """
    _require_one_grid(fixed, tissue, skull, mesh)
    if smoothing_mm < 0 or noise_sd < 0:
        raise InputError(f"smoothing_mm and noise_sd must not be negative, got {smoothing_mm} and {noise_sd}")
    fixed = _smoothed(fixed, smoothing_mm)
    csf = _csf_intensity(fixed, tissue, mesh)
    truth = push_patch(
        mesh,
        skull,
        lam=lam,
        mu=mu,
        displacement=displacement,
        patch_nodes=patch_nodes,
        direction=direction,
        margin=margin,
    )
    moving = deformed_image(fixed, tissue, skull, mesh, truth.u, csf)
    noisy = [_noisy(image, noise_sd, stream) for image, stream in zip((fixed, moving), _streams(seed), strict=True)]
    return SyntheticPair(
        fixed=noisy[0],
        moving=noisy[1],
        mesh=mesh,
        u=truth.u,
        lam=np.asarray(lam, float),
        mu=np.asarray(mu, float),
        deformation=truth,
        residual_sd=float(residuals(noisy[0], noisy[1], mesh, truth.u).std()),
        interpolation_sd=float(residuals(fixed, moving, mesh, truth.u).std()),
        smoothing_mm=smoothing_mm,
        noise_sd=noise_sd,
    )


def push_patch(
    mesh: TetMesh,
    skull: Image,
    *,
    lam: Float[np.ndarray, "entries"],
    mu: Float[np.ndarray, "entries"],
    displacement: float = 15.0,
    patch_nodes: int = 20,
    direction: Direction = (0.6, 0.3, 0.75),
    margin: float = 0.1,
    skull_smoothing_mm: float = 2.0,
) -> Deformation:
    """Push a patch of the boundary towards the centre of gravity, and let the rest find its least energy.

    Every other node on the boundary keeps at least `margin` from the skull, which it may slide along: along
    a smoothed skull, that is, drawn in at each node as far as the margin from the exact one asks for.

    Parameters
    ----------
    mesh : TetMesh
    skull : Image
        Nonzero = forbidden.
    lam, mu : (T,), (m,) or (1,) array
        Lamé parameters, mu positive.
    displacement : float, default 15.0
        Of each node of the patch, mm.
    patch_nodes : int, default 20
        The boundary node farthest out along `direction`, and those nearest to it over the surface.
    direction : (x, y, z), default (0.6, 0.3, 0.75)
        From the centre of gravity towards the patch, RAS; any length.
    margin : float, default 0.1
        Least distance of a boundary node from the skull after the deformation, mm.
    skull_smoothing_mm : float, default 2.0
        See `SmoothObstacle`.

    Raises
    ------
    InputError
        If an argument is out of range, nodes lie in the skull before or patch nodes after the push, a
        tetrahedron inverts, or the minimum is not found.
    """
    if not (np.asarray(mu) > 0).all() or not (np.asarray(lam) >= 0).all():
        raise InputError(f"the truth needs mu > 0 and lam >= 0 everywhere, got mu = {mu}, lam = {lam}")
    obstacle = SmoothObstacle(skull, skull_smoothing_mm)
    centre = centre_of_gravity(mesh)
    patch = surface_patch(mesh, patch_nodes, np.asarray(direction, float))
    towards = centre - mesh.points[patch]
    pushed = displacement * towards / np.linalg.norm(towards, axis=1, keepdims=True)
    _require_outside_skull(obstacle, mesh, patch, pushed, margin)
    problem = ContactProblem(mesh, stiffness(mesh, lam, mu), patch, pushed, obstacle)
    minimum = _settle(problem, obstacle, margin)
    ratio = signed_volumes(mesh.points + minimum.u, mesh.cells) / mesh.volumes
    _require_no_inversion(mesh, ratio, displacement)
    return Deformation(minimum.u, patch, np.flatnonzero(minimum.force), minimum, ratio)


def centre_of_gravity(mesh: TetMesh) -> Float[np.ndarray, "3"]:
    """Centre of the meshed volume, mm."""
    return mesh.volumes @ mesh.points[mesh.cells].mean(axis=1) / mesh.volumes.sum()


def surface_patch(mesh: TetMesh, count: int, direction: Float[np.ndarray, "3"]) -> Int[np.ndarray, "patch"]:
    """A connected patch of the boundary: a node, and those nearest to it along the edges of the surface.

    Parameters
    ----------
    mesh : TetMesh
    count : int
        Number of nodes, at least three.
    direction : (3,) array
        The first node is the one whose bearing from the centre of gravity is closest to it.

    Returns
    -------
    (count,) int array
        Nearest first.

    Raises
    ------
    InputError
        If the direction is zero, or the surface has too few connected nodes.
    """
    if not np.linalg.norm(direction) > 0:
        raise InputError(f"the direction of the patch must not be zero, got {direction.tolist()}")
    bearing = mesh.points[mesh.boundary] - centre_of_gravity(mesh)
    cosine = bearing @ direction / np.linalg.norm(bearing, axis=1)
    distance = dijkstra(_surface_edges(mesh), directed=False, indices=mesh.boundary[cosine.argmax()])
    reachable = int(np.isfinite(distance).sum())
    if not 3 <= count < reachable:
        raise InputError(f"a patch has at least 3 nodes and fewer than the surface ({reachable}), got {count}")
    return np.argsort(distance, kind="stable")[:count]


def _surface_edges(mesh: TetMesh) -> scipy.sparse.csr_matrix:
    """Lengths of the edges of the boundary."""
    faces = mesh.boundary_faces
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    length = np.linalg.norm(mesh.points[edges[:, 0]] - mesh.points[edges[:, 1]], axis=1)
    return scipy.sparse.csr_matrix((length, tuple(edges.T)), shape=(len(mesh.points),) * 2)


def _settle(problem: ContactProblem, obstacle: SmoothObstacle, margin: float) -> EnergyMinimum:
    """The minimum with floors on the smoothed distance that keep the exact distance above the margin."""
    floor = np.full(len(problem.points), margin)
    minimum = problem.solve(floor, tolerance=1e-3)
    for _ in range(_ROUNDS_OF_FLOORS):
        place = (problem.points + minimum.u)[problem.nodes]
        missing = margin - obstacle.distance(place)
        if missing.max() <= 1e-3:
            break
        raised = np.where(missing > 1e-3, obstacle(place)[0] + missing, -np.inf)
        floor[problem.nodes] = np.maximum(floor[problem.nodes], raised)
        minimum = problem.solve(floor, start=minimum, tolerance=1e-3)
    minimum = problem.solve(floor, start=minimum)
    deepest = obstacle.distance((problem.points + minimum.u)[problem.nodes]).min()
    if not minimum.converged or not deepest > 0:
        raise InputError(
            f"no least energy found under the skull constraint: after {minimum.iterations} steps the nodes are "
            f"{minimum.stationarity:.1e} mm out of balance and {deepest:.2g} mm from the skull at the least; try "
            "another direction, a smaller displacement or a wider skull"
        )
    return minimum


def _smoothed(image: Image, sd_mm: float) -> Image:
    values = np.asarray(image.voxels, float)
    return image.with_voxels(ndimage.gaussian_filter(values, sd_mm / image.voxel_sizes, mode="nearest"))


def _csf_intensity(fixed: Image, tissue: Image, mesh: TetMesh) -> float:
    if "csf" not in mesh.names:
        raise InputError(f"space that the brain leaves is filled as CSF, but no tissue of {mesh.names} is named csf")
    values = np.asarray(fixed.voxels)[np.asarray(tissue.voxels) == mesh.names.index("csf") + 1]
    if values.size == 0:
        raise InputError("the tissue image has no CSF voxel to take the intensity of CSF from")
    return float(np.median(values))


def _streams(seed: int) -> list[np.random.Generator]:
    return np.random.default_rng(seed).spawn(2)


def _noisy(image: Image, sd: float, stream: np.random.Generator) -> Image:
    return image.with_voxels(image.voxels + sd * stream.normal(size=image.shape))


def _require_one_grid(fixed: Image, tissue: Image, skull: Image, mesh: TetMesh) -> None:
    for name, image in (("tissue", tissue), ("skull", skull)):
        if image.shape != fixed.shape or not np.allclose(image.affine, fixed.affine, atol=1e-4):
            raise InputError(
                f"the {name} image must lie on the grid of the fixed image: shapes {image.shape} and {fixed.shape}, "
                f"affines {image.affine.tolist()} and {fixed.affine.tolist()}"
            )
    outside = int((~fixed.contains(mesh.points)).sum())
    if outside:
        raise InputError(f"{outside} of the {len(mesh.points)} nodes of the mesh lie off the grid of the fixed image")


def _require_outside_skull(
    obstacle: SmoothObstacle, mesh: TetMesh, patch: np.ndarray, pushed: np.ndarray, margin: float
) -> None:
    inside = int((obstacle.distance(mesh.points[mesh.boundary]) < 0).sum())
    if inside:
        raise InputError(f"{inside} boundary nodes lie in the skull before any deformation; repair the mesh first")
    inside = int((obstacle.distance(mesh.points[patch] + pushed) < margin).sum())
    if inside:
        raise InputError(
            f"{inside} of the {len(patch)} patch nodes would be pushed to within {margin} mm of the skull; choose "
            "another direction or a smaller displacement"
        )


def _require_no_inversion(mesh: TetMesh, ratio: np.ndarray, displacement: float) -> None:
    inverted = mesh.tissue[ratio <= 0]
    if len(inverted):
        counts = ", ".join(f"{(inverted == t).sum()} {name}" for t, name in enumerate(mesh.names))
        raise InputError(
            f"the push of {displacement} mm inverts {len(inverted)} of {len(ratio)} tetrahedra ({counts}), so that the "
            "deformation has no inverse; choose another direction, a smaller displacement or more patch nodes"
        )
