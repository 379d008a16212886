"""Boundary nodes that too few tetrahedra hold, contracted into their neighbours."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from bayesreg.io.quality import mean_ratio
from bayesreg.mesh import FACES

# Nodes of the boundary of a fair mesh have a dozen tetrahedra. In the paper's posterior those of four or five can have
# standard deviations of millimetres and the longest autocorrelation times of all.
FEWEST = 6
LEAST_MEAN_RATIO = 0.1
# Stands for the neighbour of a face of the boundary.
_OUTSIDE = -1


def without_loose_nodes(
    points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"]
) -> tuple[Float[np.ndarray, "fewer_nodes 3"], Int[np.ndarray, "fewer_cells 4"]]:
    """The mesh without boundary nodes that fewer than six tetrahedra hold, as far as it allows that.

    A few quadrature points and a weak spring are all that is known of such a node: its displacement has a standard
    deviation of millimetres, tips a tetrahedron over, or has several places far apart, and keeps a chain from
    converging that has long agreed about all the others.

    Each is contracted into a neighbour on the boundary: their edge and the tetrahedra about it vanish, the others of
    the node take the neighbour for it. Of the neighbours with which the mesh stays what it is topologically and no
    tetrahedron is worse than a mean ratio of 0.1 the one is taken that leaves the best shapes; without any the node
    stays. A tetrahedron that hangs on the mesh by a face is so cut off.

    Parameters
    ----------
    points, cells : (n, 3), (m, 4) arrays
        Positively oriented.

    Returns
    -------
    points, cells
        Renumbered. No point has moved.
    """
    given = cells
    while True:
        before = len(cells)
        holding = np.bincount(cells.ravel(), minlength=len(points))
        for node in np.argsort(holding, kind="stable")[: np.count_nonzero(holding < FEWEST)]:
            cells = _contract(points, cells, int(node))
        if len(cells) == before:
            break
    if len(cells) == len(given):
        return points, given
    used, kept = np.unique(cells, return_inverse=True)
    return points[used], kept.reshape(-1, 4)


def _contract(
    points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"], node: int
) -> Int[np.ndarray, "fewer_cells 4"]:
    """The cells without a node of the boundary, if it is loose and can be spared."""
    star = _star(cells, node)
    neighbours = np.setdiff1d(_boundary_faces(star, node), node)
    if len(star) in (0, len(cells)) or len(star) >= FEWEST or len(neighbours) == 0:
        return cells
    best, least = cells, LEAST_MEAN_RATIO
    for neighbour in neighbours.tolist():
        moved = np.where(star == node, neighbour, star)[~(star == neighbour).any(axis=1)]
        shape = mean_ratio(points, moved).min(initial=np.inf)
        if shape >= least and may_be_contracted(cells, node, neighbour):
            others = cells[~(cells == node).any(axis=1)]
            best, least = np.vstack([others, moved]), shape
    return best


def may_be_contracted(cells: Int[np.ndarray, "cells 4"], a: int, b: int) -> bool:
    """Whether Lk a ∩ Lk b = Lk ab, with which the mesh without the edge ab is homeomorphic to the one with it.

    The mesh is closed by tetrahedra from every face of the boundary to a point outside. Some edges that do not meet
    the condition, those of ears among them, could be contracted as well (Dey, Edelsbrunner, Guha and Nekhayev,
    Topology preserving edge contraction, 1999).
    """
    closed = np.vstack([_closed(_star(cells, a), a), _closed(_star(cells, b), b)])
    return _link(closed, a) & _link(closed, b) == _link(closed, a, b)


def _closed(star: Int[np.ndarray, "cells 4"], node: int) -> Int[np.ndarray, "more_cells 4"]:
    """The tetrahedra about a node, and those outside."""
    faces = _boundary_faces(star, node)
    return np.vstack([star, np.column_stack([faces, np.full(len(faces), _OUTSIDE)])])


def _star(cells: Int[np.ndarray, "cells 4"], node: int) -> Int[np.ndarray, "around 4"]:
    return cells[(cells == node).any(axis=1)]


def _boundary_faces(star: Int[np.ndarray, "cells 4"], node: int) -> Int[np.ndarray, "faces 3"]:
    """Faces at a node that belong to one tetrahedron only; all that they could belong to are about it."""
    faces = np.sort(star[:, FACES].reshape(-1, 3), axis=1)
    faces, count = np.unique(faces[(faces == node).any(axis=1)], axis=0, return_counts=True)
    return faces[count == 1]


def _link(cells: Int[np.ndarray, "cells 4"], *nodes: int) -> set[tuple[int, ...]]:
    """All simplices opposite to some nodes in the tetrahedra that have them."""
    opposite = (sorted(set(cell).difference(nodes)) for cell in cells.tolist() if set(nodes) <= set(cell))
    return {simplex for face in opposite for size in range(1, len(face) + 1) for simplex in combinations(face, size)}
