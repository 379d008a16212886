"""Check that a mesh from a file agrees with the labels in position and in the order of its tissues.

A *reading* of the file assumes a unit, the signs of the axes, and an order of the tissues. If another reading than the
file as it is agrees clearly better, the error names this reading.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from bayesreg.image import Image
from bayesreg.io.spaces import LPS
from bayesreg.mesh import TetMesh
from bayesreg.types import InputError

# The units in which the coordinates of a file may be written, by their length in mm.
UNITS = {1.0: "mm", 10.0: "cm", 1000.0: "m"}
# A mesh is refused if the share of its volume that agrees with the labels is below LEAST. The share is about 0.8 for a
# mesh that was made from these labels, or less if tissues are thin. Two shares are about equal if they differ by no
# more than BETTER: if a brain mesh is reversed from left to right, its share falls by 0.07.
LEAST, BETTER = 0.3, 0.05
# Another reading is advised only if it also disagrees in less than this fraction of the volume in which the file as it
# is disagrees.
LESS = 0.8
# The cost of a reading says how unusual it is. Several readings can agree about equally well, since an organ is nearly
# symmetric; then the reading with the lowest cost is chosen. Another unit, or LPS in place of RAS, is a difference
# between formats, and costs 1. Other reversed axes and renumbered tissues are mistakes, and cost 2. COSTS has the costs
# of the signs of the axes (RAS and LPS); COST_OF_SIGNS is the cost of all other signs.
COSTS: dict[tuple[int, ...], int] = {(1, 1, 1): 0, tuple(LPS.astype(int).tolist()): 1}
COST_OF_UNIT, COST_OF_SIGNS, COST_OF_ORDER = 1, 2, 2


class _Reading(NamedTuple):
    """A way to read the file of a mesh, and how well the mesh then agrees with the labels.

    Attributes
    ----------
    share : float
        The share of the mesh's volume whose tissue agrees with the labels.
    unit : float
        The length of the file's unit, mm.
    signs : tuple of int
        The factor of each axis, 1 or −1.
    order : tuple of int
        For every tissue index of the mesh as it is, the index in `mesh.names` that this reading gives it.
    """

    share: float
    unit: float
    signs: tuple[int, ...]
    order: tuple[int, ...]


def require_agreement(mesh: TetMesh, tissue: Image, path: str | Path) -> None:
    """Raise InputError if a mesh disagrees with the labels, or if another reading of its file agrees clearly better.

    Parameters
    ----------
    mesh : TetMesh
        The mesh as it was read from the file, mm.
    tissue : Image
        The labels: 0 outside Ω; in Ω, 1 + the index of the tissue in `mesh.names`.
    path : path
        The path of the file of the mesh, for the message.
    """
    as_is = tuple(range(len(mesh.names)))
    share_as_is = float(np.trace(_volumes(mesh, tissue, 1.0, (1, 1, 1))))
    readings = [_best_order(mesh, tissue, unit, signs) for unit in UNITS for signs in product((1, -1), repeat=3)]
    highest = max(reading.share for reading in readings)
    best = min(
        (reading for reading in readings if reading.share >= highest - BETTER),
        key=lambda reading: (_cost(reading), -reading.share),
    )
    if best.share > share_as_is + BETTER and 1 - best.share < LESS * (1 - share_as_is):
        differences = []
        if best.unit != 1:
            differences.append(f"in {UNITS[best.unit]} (write it in mm)")
        if turned := [axis for axis, sign in zip("xyz", best.signs, strict=True) if sign < 0]:
            lps = " (it may be in LPS: write it in RAS)" if turned == ["x", "y"] else ""
            differences.append(f"with {' and '.join(turned)} reversed{lps}")
        if best.order != as_is:
            names = ", ".join(mesh.names[k] for k in best.order)
            differences.append(f"with its tissues numbered as {names} and not as {', '.join(mesh.names)}")
        raise InputError(
            f"mesh {path} agrees with the labels in {share_as_is:.0%} of its volume; the share would be "
            f"{best.share:.0%} {' and '.join(differences)}"
        )
    if share_as_is < LEAST:
        raise InputError(
            f"mesh {path} agrees with the labels in no more than {share_as_is:.0%} of its volume; give a mesh of these "
            "labels in the world of the fixed image (RAS, mm), or leave mesh.file out"
        )


def _cost(reading: _Reading) -> int:
    renumbered = reading.order != tuple(range(len(reading.order)))
    return COST_OF_UNIT * (reading.unit != 1) + COSTS.get(reading.signs, COST_OF_SIGNS) + COST_OF_ORDER * renumbered


def _best_order(mesh: TetMesh, tissue: Image, unit: float, signs: tuple[int, ...]) -> _Reading:
    """Find the order of the tissues that agrees with the labels in the greatest share of the volume."""
    volumes = _volumes(mesh, tissue, unit, signs)
    rows, columns = linear_sum_assignment(-volumes)
    return _Reading(float(volumes[rows, columns].sum()), unit, signs, tuple(columns.tolist()))


def _volumes(mesh: TetMesh, tissue: Image, unit: float, signs: tuple[int, ...]) -> Float[np.ndarray, "tissues tissues"]:
    """Compute the share of the mesh's volume for each pair of a tissue of the mesh (row) and of the labels (column).

    The label of a tetrahedron is read at the voxel nearest to its centre, after the unit and the signs are applied.
    """
    centres = mesh.points[mesh.cells].mean(axis=1) * unit * np.array(signs)
    labels = tissue.nearest(centres).astype(int)
    shares = np.zeros((len(mesh.names), len(mesh.names) + 1))
    np.add.at(shares, (mesh.tissue, labels), mesh.volumes / mesh.volumes.sum())
    return shares[:, 1:]
