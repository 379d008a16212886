"""Linear (P1) tetrahedra: shape gradients, displacement gradients and quadrature.

Arrays over cells have the cell as their *last* axis, and small sums over nodes and axes are written out. XLA then fuses
them into one pass over the cells; an `einsum` over 3 × 4 blocks is several times slower on the CPU.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from bayesreg.fem.operators import SparseOperator, sparse_operator
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray


class Elements(NamedTuple):
    """The geometry that linear elements need (a pytree).

    Attributes
    ----------
    cells : (4, m) int array
        Node indices.
    gradients : (4, 3, m) array
        ∂N_a/∂x_i of each node's shape function, 1/mm.
    volumes : (m,) array
        Volumes of the cells, mm³.
    derivative : SparseOperator
        The (3m, n) map from nodal values to ∂/∂x_j in each cell, with row j · m + cell.
    """

    cells: Int[AnyArray, "4 cells"]
    gradients: Float[AnyArray, "4 3 cells"]
    volumes: Float[AnyArray, "cells"]
    derivative: SparseOperator


def elements_of(mesh: TetMesh) -> Elements:
    """Compute the shape gradients, volumes and derivative of a mesh."""
    gradients = np.moveaxis(shape_gradients(mesh), 0, -1)
    derivative = sparse_operator(derivative_matrix(mesh))
    return Elements(jnp.asarray(mesh.cells.T), jnp.asarray(gradients), jnp.asarray(mesh.volumes), derivative)


def derivative_matrix(mesh: TetMesh) -> scipy.sparse.csr_array:
    """Make the (3m, n) map from nodal values to ∂/∂x_j in each cell, with row j · m + cell, on the host."""
    gradients = np.moveaxis(shape_gradients(mesh), 2, 0)
    columns, starts = np.broadcast_to(mesh.cells, gradients.shape), np.arange(0, gradients.size + 1, 4)
    shape = (3 * len(mesh.cells), len(mesh.points))
    return scipy.sparse.csr_array((gradients.ravel(), columns.ravel(), starts), shape=shape)


def shape_gradients(mesh: TetMesh) -> Float[np.ndarray, "cells 4 3"]:
    """Compute ∂N_a/∂x_i of every cell, 1/mm, on the host."""
    corners = mesh.points[mesh.cells]
    # Rows of the inverse Jacobian are the gradients of N_1, N_2, N_3; the four of them sum to zero.
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    last_three = np.linalg.inv(edges)
    return np.concatenate([-last_three.sum(axis=1, keepdims=True), last_three], axis=1)


def boundary_areas(mesh: TetMesh) -> Float[np.ndarray, "nodes"]:
    """Compute a third of the area of the boundary faces about each node, mm²; zero for inner nodes."""
    corners = mesh.points[mesh.boundary_faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return np.bincount(mesh.boundary_faces.ravel(), np.repeat(areas / 3, 3), len(mesh.points))


# ∂u_k/∂x_j of every cell, by k, then j. If u has a last axis of chains, each entry has this axis, too.
Gradient = tuple[tuple[AnyArray, ...], ...]


def displacement_gradient(derivative: SparseOperator, u: Float[AnyArray, "nodes 3 *chains"]) -> Gradient:
    """Compute ∇u of every cell, as a tuple of entries; `derivative` is that of `Elements`.

    The entries are slices of the product, so that under `vmap` the chains stay next to each other in memory.
    """
    rows = derivative(u.reshape(len(u), -1)).reshape(-1, *u.shape[1:])
    count = len(rows) // 3
    return tuple(tuple(rows[j * count : (j + 1) * count, k] for j in range(3)) for k in range(3))


class Quadrature(NamedTuple):
    """Points inside the cells at which an integral over Ω is summed (a pytree).

    Attributes
    ----------
    cells : (q,) int array
        The cell of each point.
    barycentric : (q, 4) array
        Its barycentric coordinates there.
    weights : (q,) array
        Weights, mm³. Those of a Gauss rule sum to the volume of Ω, those of voxels to the volume of the voxels whose
        centres lie inside.
    interpolation : SparseOperator
        The (q, n) map from values at the nodes to values at the points, N_a(x_q).
    """

    cells: Int[AnyArray, "points"]
    barycentric: Float[AnyArray, "points 4"]
    weights: Float[AnyArray, "points"]
    interpolation: SparseOperator

    def positions(self, mesh: TetMesh) -> Float[np.ndarray, "points 3"]:
        """Compute the world coordinates of every point, mm."""
        corners = mesh.points[mesh.cells[np.asarray(self.cells)]]
        return np.einsum("qa,qai->qi", np.asarray(self.barycentric), corners)


def quadrature_at(
    mesh: TetMesh,
    cells: Int[np.ndarray, "points"],
    barycentric: Float[np.ndarray, "points 4"],
    weights: Float[np.ndarray, "points"],
) -> Quadrature:
    """Make quadrature points with given cells, barycentric coordinates and weights (mm³)."""
    starts, shape = np.arange(0, 4 * len(cells) + 1, 4), (len(cells), len(mesh.points))
    matrix = scipy.sparse.csr_array((barycentric.ravel(), mesh.cells[cells].ravel(), starts), shape=shape)
    return Quadrature(jnp.asarray(cells), jnp.asarray(barycentric), jnp.asarray(weights), sparse_operator(matrix))


# The paper's four-point Gauss rule, exact for quadratics (Zienkiewicz and Taylor).
_NEAR, _FAR = (5 + 3 * np.sqrt(5)) / 20, (5 - np.sqrt(5)) / 20
_GAUSS4 = np.full((4, 4), _FAR) + (_NEAR - _FAR) * np.eye(4)

GAUSS_SUBDIVISIONS = {"gauss4": 0, "gauss32": 1, "gauss256": 2}


def gauss_quadrature(mesh: TetMesh, rule: str = "gauss4") -> Quadrature:
    """Make the four-point Gauss rule on every cell, or on the 8 or 64 equal parts of every cell.

    Parameters
    ----------
    mesh : TetMesh
    rule : {"gauss4", "gauss32", "gauss256"}
        The rule, named by its number of points per cell. All weights are positive and equal within a cell. The noise
        model of the Boltzmann similarity gives a point of weight w_q the variance T_s / (2 w_q), so it excludes the
        negative weights of Gauss rules of higher order.
    """
    barycentric = _subdivide(GAUSS_SUBDIVISIONS[rule])
    count, per_cell = len(mesh.cells), len(barycentric)
    cells, weights = np.repeat(np.arange(count), per_cell), np.repeat(mesh.volumes / per_cell, per_cell)
    return quadrature_at(mesh, cells, np.tile(barycentric, (count, 1)), weights)


def _subdivide(levels: int) -> Float[np.ndarray, "points 4"]:
    """Compute the points of the four-point rule on the parts of a tetrahedron, in barycentric coordinates."""
    children = [np.eye(4)]
    for _ in range(levels):
        children = [child for parent in children for child in _children(parent)]
    return np.concatenate([_GAUSS4 @ child for child in children])


def _children(corners: Float[np.ndarray, "4 4"]) -> list[np.ndarray]:
    """Cut a tetrahedron into eight equal parts: one at each corner, four in the octahedron between them."""
    mid = {frozenset(pair): corners[list(pair)].mean(axis=0) for pair in combinations(range(4), 2)}

    def middle(a: int, b: int) -> np.ndarray:
        return mid[frozenset((a, b))]

    at_corners = [np.stack([corners[a], *(middle(a, b) for b in range(4) if b != a)]) for a in range(4)]
    diagonal = [middle(0, 1), middle(2, 3)]
    ring = [middle(0, 2), middle(0, 3), middle(1, 3), middle(1, 2)]
    in_octahedron = [np.stack([*diagonal, ring[i], ring[(i + 1) % 4]]) for i in range(4)]
    return at_corners + in_octahedron
