"""The discretisation error of a mesh: the difference between a smooth displacement and a piecewise linear one.

In the middle between two nodes a and b, a smooth u differs from the straight line by (G_a − G_b)(x_b − x_a) / 8, up to
terms of third order, where G is the gradient at the nodes. In a tetrahedron the difference is quadratic in the
barycentric coordinates b: the sum of 4 b_a b_b times these differences over its edges. G is recovered as the mean,
weighted by volume, of the gradients of the tetrahedra around a node (Zienkiewicz and Zhu 1987, "A simple error
estimator and adaptive procedure for practical engineering analysis").
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
    """Compute the mean square of the discretisation error of a displacement, in every tetrahedron and component.

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
    """Compute ∂u_i/∂x_j at the nodes: the mean over the tetrahedra around each, weighted by volume."""
    of_cells = np.einsum("nai,naj->nij", np.asarray(u)[mesh.cells], shape_gradients(mesh))
    total, weight = np.zeros((len(mesh.points), 3, 3)), np.zeros(len(mesh.points))
    for corner in mesh.cells.T:
        np.add.at(total, corner, mesh.volumes[:, None, None] * of_cells)
        np.add.at(weight, corner, mesh.volumes)
    return total / weight[:, None, None]


def _products() -> Float[np.ndarray, "6 6"]:
    """Compute the means over a tetrahedron of 16 b_a b_b b_c b_d, for two of its edges: 6 ∏ α! / 7! of ∏ b^α."""
    found = np.empty((6, 6))
    for p, one in enumerate(EDGES):
        for q, other in enumerate(EDGES):
            powers = np.bincount([*one, *other], minlength=4)
            found[p, q] = 16 * 6 * np.prod([factorial(power) for power in powers]) / factorial(7)
    return found
