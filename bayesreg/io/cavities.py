"""Removal of the cavities that fTetWild leaves inside a mesh by mistake."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy import optimize, sparse
from scipy.sparse.csgraph import connected_components

from bayesreg.mesh import boundary_faces_of, signed_volumes


def without_cavities(
    points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"]
) -> tuple[Float[np.ndarray, "all_nodes 3"], Int[np.ndarray, "all_cells 4"]]:
    """Fill the small cavities of a mesh.

    fTetWild treats regions with a low winding number as outside. If its inner surfaces are locally turned inside out, a
    few tetrahedra at such a surface are missing. A cavity gets a node in its middle, unless a single tetrahedron fills
    it. A cavity stays open if no point inside it sees all its faces.

    Parameters
    ----------
    points : (n, 3) array
    cells : (m, 4) array
        Positively oriented.

    Returns
    -------
    points, cells
        The given points and cells first, then the new ones.
    """
    faces = boundary_faces_of(cells)
    surface = _surface_parts(faces)
    a, b, c = np.moveaxis(points[faces], 1, 0)
    volume = np.bincount(surface, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6)
    for cavity in np.flatnonzero(volume < 0):
        points, cells = _fill(points, cells, faces[surface == cavity])
    return points, cells


def _surface_parts(faces: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "faces"]:
    """Number the closed surfaces and return the number for each face.

    Two surfaces that touch along an edge, which then has four faces, count as two.
    """
    edges = np.sort(faces[:, [(0, 1), (1, 2), (2, 0)]].reshape(-1, 2), axis=1)
    _, edge, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(edge, kind="stable")
    pairs = (order // 3)[count[edge[order]] == 2].reshape(-1, 2)
    graph = sparse.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(faces), len(faces)))
    return connected_components(graph, directed=False)[1]


def _fill(
    points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"], walls: Int[np.ndarray, "walls 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Fill the cavity between faces (`walls`) whose normals point into it."""
    corners = np.unique(walls)
    if len(corners) == 4:
        last = np.setdiff1d(corners, walls[0])
        return points, np.vstack([cells, np.append(walls[0], last)])
    middle = _middle(points, walls)
    grown = np.vstack([points, middle])
    added = np.column_stack([walls, np.full(len(walls), len(points))])
    if not (signed_volumes(grown, added) > 0).all():
        return points, cells
    return grown, np.vstack([cells, added])


def _middle(points: Float[np.ndarray, "nodes 3"], walls: Int[np.ndarray, "walls 3"]) -> Float[np.ndarray, "3"]:
    """Compute the centre of the largest ball between the planes of the faces (`walls`) of a cavity."""
    a, b, c = np.moveaxis(points[walls], 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # Largest r with normal · (x − a) ≥ r.
    result = optimize.linprog(
        (0, 0, 0, -1),
        A_ub=np.column_stack([-normal, np.ones(len(walls))]),
        b_ub=-(normal * a).sum(axis=1),
        bounds=[(None, None)] * 4,
    )
    return result.x[:3] if result.success else points[np.unique(walls)].mean(axis=0)
