"""Push a patch of the boundary inwards, as in section 4.1 of the paper: the true deformation of a synthetic pair."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.sparse.csgraph import dijkstra

from bayesreg.fem.elasticity import stiffness
from bayesreg.image import Image
from bayesreg.mesh import TetMesh, signed_volumes
from bayesreg.synthetic.contact import ContactProblem, EnergyMinimum
from bayesreg.synthetic.obstacle import SmoothObstacle
from bayesreg.types import InputError

Direction = tuple[float, float, float]

# Frontal (right, left, right and lower), lateral (right, left) and parietal directions, in which the hull of a brain is
# free to move.
DIRECTIONS: tuple[Direction, ...] = (
    (0.6, 0.3, 0.75),
    (-0.6, 0.3, 0.75),
    (0.5, 0.7, 0.4),
    (0.8, 0.1, 0.5),
    (-0.8, 0.3, 0.4),
    (0.0, -0.6, 0.8),
    (-0.5, 0.7, 0.4),
    (-0.8, 0.1, 0.5),
    (0.8, 0.3, 0.4),
)

_log = logging.getLogger(__name__)

# The largest number of rounds that raise the floors of nodes nearer to the skull than the margin, and the share of the
# margin by which a node may be nearer.
_ROUNDS_OF_FLOORS = 20
_SLIP = 0.01


class Deformation(NamedTuple):
    """The deformation by a patch of the boundary that is pushed inwards; the other nodes minimise the elastic energy.

    Attributes
    ----------
    u : (n, 3) array
        Displacement of every node, mm.
    patch : (k,) int array
        The nodes that were pushed.
    contact : (c,) int array
        Nodes that press against the skull.
    minimum : EnergyMinimum
        The contact forces and the convergence of the minimum.
    volume_ratio : (m,) array
        det F of every tetrahedron, all positive.
    """

    u: Float[np.ndarray, "nodes 3"]
    patch: Int[np.ndarray, "patch"]
    contact: Int[np.ndarray, "contact"]
    minimum: EnergyMinimum
    volume_ratio: Float[np.ndarray, "cells"]


def push_patch(
    mesh: TetMesh,
    skull: Image,
    *,
    lam: Float[np.ndarray, "entries"],
    mu: Float[np.ndarray, "entries"],
    displacement: float = 15.0,
    patch_nodes: int = 20,
    direction: Direction | None = None,
    margin: float = 0.1,
    skull_smoothing_mm: float = 2.0,
) -> Deformation:
    """Push a patch of the boundary towards the centre of gravity; the other nodes minimise the elastic energy.

    Every other boundary node keeps at least the distance `margin` from the skull and may slide along it. It slides
    along a smoothed skull, which is moved inwards at each node until the exact skull is at least the margin away.

    Parameters
    ----------
    mesh : TetMesh
    skull : Image
        Nonzero = forbidden.
    lam, mu : (T,), (m,) or (1,) array
        Lamé parameters, mu positive.
    displacement : float, default 15.0
        The displacement of each node of the patch, mm.
    patch_nodes : int, default 20
        The number of nodes of the patch: the boundary node whose bearing is closest to `direction`, and the nodes
        nearest to it along the surface.
    direction : (x, y, z), optional
        Direction from the centre of gravity to the patch, RAS; any length. The default is the first of `DIRECTIONS`
        along which no tetrahedron inverts.
    margin : float, default 0.1
        Least distance of a boundary node from the skull after the deformation, mm.
    skull_smoothing_mm : float, default 2.0
        See `SmoothObstacle`.

    Raises
    ------
    InputError
        If an argument is out of range, a boundary node lies in the skull before the push, a patch node lies in it
        after the push, a tetrahedron inverts, or the minimum is not found.
    """
    if not (np.asarray(mu) > 0).all() or not (np.asarray(lam) >= 0).all():
        raise InputError(f"the truth needs mu > 0 and lam >= 0 everywhere, got mu = {mu}, lam = {lam}")
    if not margin > 0:
        raise InputError(f"the margin must be positive, mm, or nodes end on the skull itself; got {margin}")
    obstacle = SmoothObstacle(skull, skull_smoothing_mm)
    stiff = stiffness(mesh, lam, mu)
    for chosen in DIRECTIONS if direction is None else (direction,):
        patch = surface_patch(mesh, patch_nodes, np.asarray(chosen, float))
        deformation = _push(mesh, stiff, obstacle, patch, displacement, margin)
        if deformation.volume_ratio.min() > 0:
            return deformation
        _log.info("a push along %s inverts %d tetrahedra", chosen, (deformation.volume_ratio <= 0).sum())
    raise InputError(_inversion(mesh, deformation.volume_ratio, displacement))


def _push(
    mesh: TetMesh,
    stiff: scipy.sparse.csr_matrix,
    obstacle: SmoothObstacle,
    patch: np.ndarray,
    displacement: float,
    margin: float,
) -> Deformation:
    towards = centre_of_gravity(mesh) - mesh.points[patch]
    pushed = displacement * towards / np.linalg.norm(towards, axis=1, keepdims=True)
    _require_outside_skull(obstacle, mesh, patch, pushed, margin)
    minimum = _settle(ContactProblem(mesh, stiff, patch, pushed, obstacle), obstacle, margin)
    ratio = signed_volumes(mesh.points + minimum.u, mesh.cells) / mesh.volumes
    return Deformation(minimum.u, patch, np.flatnonzero(minimum.force), minimum, ratio)


def centre_of_gravity(mesh: TetMesh) -> Float[np.ndarray, "3"]:
    """Compute the centre of the meshed volume, mm."""
    return mesh.volumes @ mesh.points[mesh.cells].mean(axis=1) / mesh.volumes.sum()


def surface_patch(mesh: TetMesh, count: int, direction: Float[np.ndarray, "3"]) -> Int[np.ndarray, "patch"]:
    """Choose a connected patch of the boundary: a node, and the nodes nearest to it along the edges of the surface.

    Parameters
    ----------
    mesh : TetMesh
    count : int
        Number of nodes, at least three.
    direction : (3,) array
        The first node has the bearing from the centre of gravity that is closest to this direction.

    Returns
    -------
    (count,) int array
        The nodes, sorted by their distance from the first node.

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
    """Compute the lengths of the boundary's edges, as a sparse matrix of nodes by nodes."""
    faces = mesh.boundary_faces
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    length = np.linalg.norm(mesh.points[edges[:, 0]] - mesh.points[edges[:, 1]], axis=1)
    return scipy.sparse.csr_matrix((length, tuple(edges.T)), shape=(len(mesh.points),) * 2)


def _settle(problem: ContactProblem, obstacle: SmoothObstacle, margin: float) -> EnergyMinimum:
    """Find the minimum with floors of the smoothed distance that keep the exact distance above the margin."""
    floor = np.full(len(problem.points), margin)
    minimum = problem.solve(floor, tolerance=1e-3)
    for _ in range(_ROUNDS_OF_FLOORS):
        positions = (problem.points + minimum.u)[problem.nodes]
        missing = margin - obstacle.distance(positions)
        if missing.max() <= _SLIP * margin or not minimum.converged:
            break
        raised = np.where(missing > _SLIP * margin, obstacle(positions)[0] + missing, -np.inf)
        floor[problem.nodes] = np.maximum(floor[problem.nodes], raised)
        minimum = problem.solve(floor, start=minimum, tolerance=1e-3)
    if minimum.converged:
        minimum = problem.solve(floor, start=minimum)
    deepest = obstacle.distance((problem.points + minimum.u)[problem.nodes]).min()
    if not minimum.converged or not deepest > 0:
        raise InputError(
            f"no least energy found under the skull constraint: after {minimum.iterations} steps the nodes are "
            f"{minimum.stationarity:.1e} mm out of balance and {deepest:.2g} mm from the skull at the least; try "
            "another direction, a smaller displacement or a wider skull"
        )
    return minimum


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


def _inversion(mesh: TetMesh, ratio: np.ndarray, displacement: float) -> str:
    inverted = mesh.tissue[ratio <= 0]
    counts = ", ".join(f"{(inverted == t).sum()} {name}" for t, name in enumerate(mesh.names))
    return (
        f"the push of {displacement} mm inverts {len(inverted)} of {len(ratio)} tetrahedra ({counts}), so that the "
        "deformation has no inverse; choose another direction, a smaller displacement or fewer patch nodes"
    )
