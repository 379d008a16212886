"""How the log density changes where one sampled node moves and the free nodes near by follow linearly.

The free nodes are those of a fixed (λ, μ), and only the quadrature points that follow most are looked at: an
approximation of the density of eq. (9) in one node, for moves that are tested with the density itself.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayesreg.fem.conjugate_gradients import ElasticSystem
from bayesreg.fem.elasticity import stiffness, unknowns_of
from bayesreg.fem.elements import Quadrature
from bayesreg.fem.equilibrium import linear_response
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray

# Quadrature points that are looked at: as many as so many average cells have, those that follow a node the furthest.
CELLS = 128
# The number of nodes near them is a multiple of this, so that what is compiled for some nodes serves others, too.
ROUND = 128
# Numbers that are worked out at a time: there may be millions of quadrature points.
AT_A_TIME = 2**22


class Neighbourhoods(NamedTuple):
    """The surroundings of k sampled nodes (a pytree).

    Attributes
    ----------
    rows : (k,) int array
        The nodes' rows of "u_boundary".
    at : (k, 3) array
        Their displacements about which the neighbours' follow, mm.
    response : (n, 3, prescribed, 3) array
        Displacement of the nodes near any of them, and of as many others as make a round number, for one of a
        prescribed node.
    points : (k, p) int array
        Quadrature points that follow each.
    corners : (k, p, 4) int array
        The corners of the cells of these points, as rows of `response`.
    follows : (k, p, 3, 3) array
        Displacement of these points for one of the node.
    force : (k, 3, prescribed, 3) array
        Force on the node, the gradient of E_r, for a displacement of a prescribed node.
    """

    rows: Int[AnyArray, "k"]
    at: Float[AnyArray, "k 3"]
    response: Float[AnyArray, "near 3 prescribed 3"]
    points: Int[AnyArray, "k points"]
    corners: Int[AnyArray, "k points 4"]
    follows: Float[AnyArray, "k points 3 3"]
    force: Float[AnyArray, "k 3 prescribed 3"]


def neighbourhoods(
    mesh: TetMesh,
    system: ElasticSystem,
    quadrature: Quadrature,
    lam: Float[np.ndarray, "cells"],
    mu: Float[np.ndarray, "cells"],
    slots: Int[np.ndarray, "k"],
    rows: Int[np.ndarray, "k"],
    at: Float[np.ndarray, "k 3"],
) -> Neighbourhoods | None:
    """The neighbourhoods of some prescribed nodes; None if there are none.

    Parameters
    ----------
    mesh : TetMesh
    system : ElasticSystem
        Preconditioned at λ and μ, or without free nodes.
    quadrature : Quadrature
    lam, mu : (m,) array
        By cell.
    slots : (k,) int array
        Where the nodes stand among `system.prescribed`.
    rows, at
        See `Neighbourhoods`.
    """
    prescribed = np.asarray(system.prescribed)
    if not len(rows):
        return None
    nodes = prescribed[slots]
    cell_of, barycentric = np.asarray(quadrature.cells), np.asarray(quadrature.barycentric)
    count = min(len(cell_of), round(CELLS * len(cell_of) / len(mesh.cells)))
    matrix = stiffness(mesh, lam, mu).tocsr()
    own = linear_response(system, matrix, np.arange(len(mesh.points)), nodes).reshape(-1, 3, len(nodes), 3)

    def following(points: np.ndarray, which: int) -> np.ndarray:
        return np.einsum("pa,paij->pij", barycentric[points], own[mesh.cells[cell_of[points]], :, which])

    points = _furthest(quadrature, own, count)
    follows = np.stack([following(points[which], which) for which in range(len(nodes))])
    touching = np.isin(mesh.cells, nodes).any(axis=1)
    near = np.unique(np.concatenate([mesh.cells[cell_of[points]].ravel(), mesh.cells[touching].ravel()]))
    others = np.setdiff1d(np.arange(len(mesh.points)), near)
    near = np.sort(np.concatenate([near, others[: -len(near) % ROUND]]))
    response = linear_response(system, matrix, near, prescribed)
    corners = np.searchsorted(near, mesh.cells[cell_of[points]])
    force = matrix[unknowns_of(nodes)][:, unknowns_of(near)] @ response
    return Neighbourhoods(
        jnp.asarray(rows),
        jnp.asarray(at),
        jnp.asarray(response.reshape(len(near), 3, len(prescribed), 3)),
        jnp.asarray(points),
        jnp.asarray(corners),
        jnp.asarray(follows),
        jnp.asarray(force.reshape(len(rows), 3, len(prescribed), 3)),
    )


def _furthest(quadrature: Quadrature, own: Float[np.ndarray, "nodes 3 k 3"], count: int) -> Int[np.ndarray, "k count"]:
    """The quadrature points, sorted, that follow each of k nodes the furthest, squared and by weight."""
    weights, found = np.asarray(quadrature.weights), []
    width = max(1, AT_A_TIME // (9 * len(weights)))
    for first in range(0, own.shape[2], width):
        columns = own[:, :, first : first + width].transpose(0, 2, 1, 3)
        follows = np.asarray(quadrature.interpolation(jnp.asarray(columns.reshape(len(own), -1))))
        reach = weights[:, None] * (follows**2).reshape(len(weights), -1, 9).sum(axis=2)
        found.append(np.sort(np.argpartition(-reach, count - 1, axis=0)[:count], axis=0).T)
    return np.concatenate(found)
