"""What a mesh cannot follow: how far a smooth displacement lies from one that is linear in every tetrahedron.

Between two nodes a and b a smooth u departs from the straight line, in the middle by (G_a − G_b)(x_b − x_a) / 8, with G
the gradient at the nodes, up to terms of third order. The departure in a tetrahedron, quadratic in the barycentric
coordinates b, is the sum of 4 b_a b_b times these over its edges. G is recovered as the mean of the gradients of the
tetrahedra about a node, by volume (Zienkiewicz and Zhu 1987, "A simple error estimator and adaptive procedure for
practical engineering analysis").
"""

from __future__ import annotations

from itertools import combinations
from math import factorial

import numpy as np
from jaxtyping import Float

from bayesreg.fem.elements import shape_gradients
from bayesreg.mesh import TetMesh

EDGES = tuple(combinations(range(4), 2))


def submesh_variance(mesh: TetMesh, u: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "cells 3"]:
    """The mean square of what a mesh cannot follow of a smooth displacement, in every tetrahedron and component.

    Parameters
    ----------
    mesh : TetMesh
    u : (n, 3) array
        Displacement of every node, mm.

    Returns
    -------
    (m, 3) array
        mm².
    """
    gradient = _nodal_gradient(mesh, u)
    bends = []
    for a, b in EDGES:
        one, other = mesh.cells[:, a], mesh.cells[:, b]
        edge = mesh.points[other] - mesh.points[one]
        bends.append(np.einsum("nij,nj->ni", gradient[one] - gradient[other], edge) / 8)
    return np.einsum("pni,pq,qni->ni", np.stack(bends), _products(), np.stack(bends))


def _nodal_gradient(mesh: TetMesh, u: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "nodes 3 3"]:
    """∂u_i/∂x_j at the nodes: the mean over the tetrahedra about each, by volume."""
    of_cells = np.einsum("nai,naj->nij", np.asarray(u)[mesh.cells], shape_gradients(mesh))
    total, weight = np.zeros((len(mesh.points), 3, 3)), np.zeros(len(mesh.points))
    for corner in mesh.cells.T:
        np.add.at(total, corner, mesh.volumes[:, None, None] * of_cells)
        np.add.at(weight, corner, mesh.volumes)
    return total / weight[:, None, None]


def _products() -> Float[np.ndarray, "6 6"]:
    """The means over a tetrahedron of 16 b_a b_b b_c b_d, for two of its edges: 6 ∏ α! / 7! of ∏ b^α."""
    found = np.empty((6, 6))
    for p, one in enumerate(EDGES):
        for q, other in enumerate(EDGES):
            powers = np.bincount([*one, *other], minlength=4)
            found[p, q] = 16 * 6 * np.prod([factorial(power) for power in powers]) / factorial(7)
    return found
