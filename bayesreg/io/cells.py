"""The tetrahedra of a region, with a boundary that nowhere touches itself, and the tissue that fills each of them."""

from __future__ import annotations

from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components

from bayesreg.image import Image
from bayesreg.io.quality import crowded_edges, pinched_nodes
from bayesreg.mesh import FACES, faces_across, signed_volumes

# Points per edge of the lattice inside each tetrahedron; 6 makes 56 points.
SAMPLES = 6


def cells_inside(
    points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"], field: Image
) -> Bool[np.ndarray, "cells"]:
    """Find the tetrahedra inside a region, one part without cavities, whose boundary is a manifold if it can be.

    Parameters
    ----------
    points, cells : (n, 3), (m, 4) arrays
        A mesh of a box around the region, with faces along its surface.
    field : Image
        Above 0.5 inside the region.

    Notes
    -----
    A tetrahedron is inside if most of it is. Where two sheets of the surface were joined, the boundary meets itself at
    an edge or a node. Of the tetrahedra around it, those on one side that are connected by faces are a run; the run
    that costs the least volume changes sides. No tetrahedron changes twice, so that this ends.
    """
    share = _share_inside(points, cells, field)
    cost = np.abs(2 * share - 1) * signed_volumes(points, cells)
    across = faces_across(cells)
    inside = _one_body(share > 0.5, across)
    while (run := _cheapest_run(cells, across, inside, cost)) is not None:
        inside[run] = ~inside[run]
        cost[run] = np.inf
    return _one_body(inside, across)


def tissue_of_cells(
    points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"], labels: Image, samples: int = SAMPLES
) -> Int[np.ndarray, "cells"]:
    """Find the tissue that fills most of each tetrahedron, as an index into the names.

    Parameters
    ----------
    points, cells : (n, 3), (m, 4) array
    labels : Image
        1 + tissue, without zeros (`labels_everywhere`).
    samples : int
        Points per edge of the lattice inside each tetrahedron; 6 makes 56 points.
    """
    votes = np.zeros((len(cells), int(labels.voxels.max())), int)
    corner = points[cells]
    row = np.arange(len(cells))
    for weights in _inner_lattice(samples):
        votes[row, _nearest(labels, weights @ corner) - 1] += 1
    return votes.argmax(axis=1)


def _share_inside(
    points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"], field: Image
) -> Float[np.ndarray, "cells"]:
    """Compute the share of each tetrahedron in which a field is above 0.5; it is zero beyond its grid."""
    corner, lattice, votes = points[cells], _inner_lattice(SAMPLES), np.zeros(len(cells))
    for weights in lattice:
        index = field.world_to_voxel(weights @ corner)
        votes += ndimage.map_coordinates(np.asarray(field.voxels), index.T, order=1, mode="constant") > 0.5
    return votes / len(lattice)


def _one_body(inside: Bool[np.ndarray, "cells"], across: Int[np.ndarray, "cells 4"]) -> Bool[np.ndarray, "cells"]:
    """Keep the largest part of the tetrahedra inside, and fill all that the outside does not reach."""
    inside = _largest_part(inside, across)
    return ~_largest_part(~inside, across)


def _largest_part(chosen: Bool[np.ndarray, "cells"], across: Int[np.ndarray, "cells 4"]) -> Bool[np.ndarray, "cells"]:
    """Find the part of the chosen tetrahedra, connected by faces, that has the most of them."""
    if not chosen.any():
        return chosen
    part = _parts(np.flatnonzero(chosen), across)
    result = np.zeros(len(chosen), bool)
    result[np.flatnonzero(chosen)[part == np.bincount(part).argmax()]] = True
    return result


def _parts(some: Int[np.ndarray, "k"], across: Int[np.ndarray, "cells 4"]) -> Int[np.ndarray, "k"]:
    """Number the parts, connected by faces, of some tetrahedra (sorted)."""
    rows, faces = np.nonzero(np.isin(across[some], some))
    columns = np.searchsorted(some, across[some[rows], faces])
    graph = sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), (len(some), len(some)))
    return connected_components(graph, directed=False)[1]


def _cheapest_run(
    cells: Int[np.ndarray, "cells 4"],
    across: Int[np.ndarray, "cells 4"],
    inside: Bool[np.ndarray, "cells"],
    cost: Float[np.ndarray, "cells"],
) -> Int[np.ndarray, "run"] | None:
    """Find the tetrahedra that change sides at the first place where the boundary meets itself; None if none may."""
    cell, corner = np.nonzero(inside[:, None] & ~(inside[across] & (across >= 0)))
    faces = cells[cell[:, None], FACES[corner]]
    places = crowded_edges(faces)
    if len(places) == 0:
        places = pinched_nodes(faces)[:, None]
    for place in places:
        star = np.flatnonzero(np.isin(cells, place).sum(axis=1) == len(place))
        if (run := _cheapest(star, across, inside, cost)) is not None:
            return run
    return None


def _cheapest(
    star: Int[np.ndarray, "star"],
    across: Int[np.ndarray, "cells 4"],
    inside: Bool[np.ndarray, "cells"],
    cost: Float[np.ndarray, "cells"],
) -> Int[np.ndarray, "run"] | None:
    """Find the run of least cost around an edge or a node, on a side that has several; None if none may change."""
    runs = []
    for side in (star[inside[star]], star[~inside[star]]):
        part = _parts(side, across)
        if len(np.unique(part)) > 1:
            runs += [side[part == number] for number in np.unique(part)]
    best = min(runs, key=lambda run: cost[run].sum(), default=None)
    return None if best is None or np.isinf(cost[best].sum()) else best


def _inner_lattice(samples: int) -> Float[np.ndarray, "points 4"]:
    """Compute the barycentric coordinates of a regular lattice strictly inside a tetrahedron."""
    steps = np.array([s for s in product(range(samples), repeat=3) if sum(s) < samples])
    steps = np.column_stack([steps, samples - 1 - steps.sum(axis=1)])
    return (steps + 0.25) / samples


def _nearest(labels: Image, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Look up the label of the voxel nearest to each point."""
    index = np.clip(np.rint(labels.world_to_voxel(points)).astype(int), 0, np.array(labels.shape) - 1)
    return np.asarray(labels.voxels)[tuple(index.T)].astype(int)
