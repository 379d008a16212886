"""The discretisation error of a mesh: the difference between a smooth displacement and a piecewise linear one.

At the midpoint of the edge between the nodes a and b, a smooth displacement u differs from its linear interpolation by
e_ab = (G_a − G_b)(x_b − x_a) / 8, up to terms of third order in the length of the edge. G_a is the gradient of u at
node a. Within a tetrahedron the difference is quadratic: it is the sum of 4 β_a β_b e_ab over the six edges, where β_a
is the barycentric coordinate of corner a. G_a is estimated by the mean, weighted by volume, of the gradients of the
tetrahedra around node a (Zienkiewicz and Zhu 1987, "A simple error estimator and adaptive procedure for practical
engineering analysis").
"""

from __future__ import annotations

from itertools import combinations
from math import factorial

import numpy as np
from jaxtyping import Float

from bayesreg.fem.elements import shape_gradients
from bayesreg.mesh import TetMesh

# The six edges of a tetrahedron, as pairs of its corners.
EDGES = tuple(combinations(range(4), 2))


def discretisation_variance(mesh: TetMesh, u: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "cells 3"]:
    """Compute the mean square of the discretisation error of a displacement over every tetrahedron, by component.

    Parameters
    ----------
    mesh : TetMesh
    u : (n, 3) array
        Displacement of every node, mm.

    Returns
    -------
    (m, 3) array
        The mean square over each of the m tetrahedra, for the components x, y and z, mm².
    """
    gradient = _nodal_gradient(mesh, u)
    bends = []
    for a, b in EDGES:
        starts, ends = mesh.cells[:, a], mesh.cells[:, b]
        edge = mesh.points[ends] - mesh.points[starts]
        bends.append(np.einsum("nij,nj->ni", gradient[starts] - gradient[ends], edge) / 8)
    return np.einsum("pni,pq,qni->ni", np.stack(bends), _products(), np.stack(bends))


def _nodal_gradient(mesh: TetMesh, u: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "nodes 3 3"]:
    """Compute ∂u_i/∂x_j at every node: the mean over the tetrahedra around the node, weighted by their volumes."""
    of_cells = np.einsum("nai,naj->nij", np.asarray(u)[mesh.cells], shape_gradients(mesh))
    total, weight = np.zeros((len(mesh.points), 3, 3)), np.zeros(len(mesh.points))
    for corner in mesh.cells.T:
        np.add.at(total, corner, mesh.volumes[:, None, None] * of_cells)
        np.add.at(weight, corner, mesh.volumes)
    return total / weight[:, None, None]


def _products() -> Float[np.ndarray, "6 6"]:
    """Compute the mean of 16 β_a β_b β_c β_d over a tetrahedron, for every two edges ab and cd.

    The mean of a product ∏ β_k^α_k with Σ α_k = 4 over a tetrahedron is 6 ∏ α_k! / 7!.
    """
    means = np.empty((6, 6))
    for p, edge in enumerate(EDGES):
        for q, other_edge in enumerate(EDGES):
            powers = np.bincount([*edge, *other_edge], minlength=4)
            means[p, q] = 16 * 6 * np.prod([factorial(power) for power in powers]) / factorial(7)
    return means
