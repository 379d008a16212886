"""Tetrahedra that hang on a mesh by a face, alone or in pairs."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def without_ears(
    points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"]
) -> tuple[Float[np.ndarray, "fewer_nodes 3"], Int[np.ndarray, "fewer_cells 4"]]:
    """The mesh without tetrahedra that alone or in pairs hold a node, again and again until there are none.

    A few quadrature points and a weak spring are all that is known of such a node: its displacement has a standard
    deviation of many millimetres, tips a tetrahedron over, or has several places far apart, and keeps a chain from
    converging that has long agreed about all the others.

    Parameters
    ----------
    points, cells : (n, 3), (m, 4) arrays

    Returns
    -------
    points, cells
        Renumbered; the volume of the ears is missing.
    """
    while True:
        holding = np.bincount(cells.ravel(), minlength=len(points))
        ears = (holding <= 2)[cells].any(axis=1)
        if not ears.any() or ears.all():
            return points, cells
        used, kept = np.unique(cells[~ears], return_inverse=True)
        points, cells = points[used], kept.reshape(-1, 4)
