"""Removal of boundary nodes that belong to too few tetrahedra, by contraction into a neighbour."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from bayesreg.io.quality import mean_ratio
from bayesreg.mesh import FACES

# Boundary nodes of a good mesh belong to about a dozen tetrahedra. In the paper's posterior, nodes with four or five
# tetrahedra can have standard deviations of millimetres and the longest autocorrelation times of all nodes.
FEWEST = 6
LEAST_MEAN_RATIO = 0.1
# The number of the point outside the mesh to which every boundary face is joined.
_OUTSIDE = -1


def without_loose_nodes(
    points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"]
) -> tuple[Float[np.ndarray, "fewer_nodes 3"], Int[np.ndarray, "fewer_cells 4"]]:
    """Remove boundary nodes that belong to fewer than six tetrahedra, if the mesh allows it.

    Only a few quadrature points and a weak spring determine the displacement of such a node. Its standard deviation is
    millimetres, it inverts a tetrahedron, or its posterior has several modes far apart. It delays the convergence of a
    chain that has converged at all other nodes.

    Each such node is contracted into a neighbour on the boundary: the edge between the two and the tetrahedra at this
    edge vanish, and the node's other tetrahedra get the neighbour instead of the node. A neighbour is allowed if the
    topology of the mesh does not change and no new tetrahedron has a mean ratio below 0.1. Among the allowed neighbours
    the one with the best shapes is chosen; if there is none, the node stays. This also removes a tetrahedron that
    shares only one face with the mesh.

    Parameters
    ----------
    points, cells : (n, 3), (m, 4) arrays
        A mesh with positively oriented tetrahedra.

    Returns
    -------
    points, cells
        The renumbered mesh. The remaining points keep their coordinates.
    """
    original_cells = cells
    while True:
        before = len(cells)
        holding = np.bincount(cells.ravel(), minlength=len(points))
        for node in np.argsort(holding, kind="stable")[: np.count_nonzero(holding < FEWEST)]:
            cells = _contract(points, cells, int(node))
        if len(cells) == before:
            break
    if len(cells) == len(original_cells):
        return points, original_cells
    used, renumbered = np.unique(cells, return_inverse=True)
    return points[used], renumbered.reshape(-1, 4)


def _contract(
    points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"], node: int
) -> Int[np.ndarray, "fewer_cells 4"]:
    """Contract a boundary node into a neighbour if it belongs to too few tetrahedra; return the cells."""
    star = _star(cells, node)
    neighbours = np.setdiff1d(_boundary_faces(star, node), node)
    if len(star) in (0, len(cells)) or len(star) >= FEWEST or len(neighbours) == 0:
        return cells
    best, least = cells, LEAST_MEAN_RATIO
    for neighbour in neighbours.tolist():
        contracted = np.where(star == node, neighbour, star)[~(star == neighbour).any(axis=1)]
        shape = mean_ratio(points, contracted).min(initial=np.inf)
        if shape >= least and may_be_contracted(cells, node, neighbour):
            others = cells[~(cells == node).any(axis=1)]
            best, least = np.vstack([others, contracted]), shape
    return best


def may_be_contracted(cells: Int[np.ndarray, "cells 4"], a: int, b: int) -> bool:
    """Check whether Lk a ∩ Lk b = Lk ab; then contraction of the edge ab gives a homeomorphic mesh.

    The mesh is closed by tetrahedra from every boundary face to a point outside. Some edges that violate the condition
    could be contracted as well, such as those of a tetrahedron with one face in the mesh (Dey, Edelsbrunner, Guha and
    Nekhayev, Topology preserving edge contraction, 1999).
    """
    closed = np.vstack([_closed(_star(cells, a), a), _closed(_star(cells, b), b)])
    return _link(closed, a) & _link(closed, b) == _link(closed, a, b)


def _closed(star: Int[np.ndarray, "cells 4"], node: int) -> Int[np.ndarray, "more_cells 4"]:
    """Join the tetrahedra at a node with those from its boundary faces to the point outside."""
    faces = _boundary_faces(star, node)
    return np.vstack([star, np.column_stack([faces, np.full(len(faces), _OUTSIDE)])])


def _star(cells: Int[np.ndarray, "cells 4"], node: int) -> Int[np.ndarray, "around 4"]:
    return cells[(cells == node).any(axis=1)]


def _boundary_faces(star: Int[np.ndarray, "cells 4"], node: int) -> Int[np.ndarray, "faces 3"]:
    """Find the faces at a node that belong to one tetrahedron only; the star holds all tetrahedra at the node."""
    faces = np.sort(star[:, FACES].reshape(-1, 3), axis=1)
    faces, count = np.unique(faces[(faces == node).any(axis=1)], axis=0, return_counts=True)
    return faces[count == 1]


def _link(cells: Int[np.ndarray, "cells 4"], *nodes: int) -> set[tuple[int, ...]]:
    """Collect all simplices opposite to the given nodes in the tetrahedra that contain these nodes."""
    opposite = (sorted(set(cell).difference(nodes)) for cell in cells.tolist() if set(nodes) <= set(cell))
    return {simplex for face in opposite for size in range(1, len(face) + 1) for simplex in combinations(face, size)}
