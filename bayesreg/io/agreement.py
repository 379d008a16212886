"""The check that a mesh from a file agrees with the labels in position and in the order of its tissues."""

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

# The units, in mm, in which the coordinates of a file may be written.
UNITS = {1.0: "mm", 10.0: "cm", 1000.0: "m"}
# A mesh of these labels agrees with them in four fifths of its volume, or in less if tissues are thin. A brain mesh
# that is reversed from left to right loses 0.07 of this share.
LEAST, BETTER = 0.3, 0.05
# Another reading is advised if the share of the volume in which it disagrees is below this fraction of the file's own.
LESS = 0.8
# How unusual a reading is. Several readings can agree about equally well, since an organ is nearly symmetric; then the
# most usual one is chosen. LPS and RAS, and units, differ between formats. Reversed single axes and renumbered tissues
# are mistakes, and so less usual.
COSTS: dict[tuple[int, ...], int] = {(1, 1, 1): 0, tuple(LPS.astype(int).tolist()): 1}
COST_OF_UNIT, COST_OF_SIGNS, COST_OF_ORDER = 1, 2, 2


class _Reading(NamedTuple):
    """A way to read a file, and the share of the mesh's volume whose tissue then agrees with the labels."""

    share: float
    unit: float
    signs: tuple[int, ...]
    order: tuple[int, ...]


def require_agreement(mesh: TetMesh, tissue: Image, path: str | Path) -> None:
    """Raise InputError if a mesh disagrees with the labels, or if another reading of its file agrees clearly better.

    Parameters
    ----------
    mesh : TetMesh
    tissue : Image
        0 outside, 1 + index into `mesh.names` inside.
    path : path
        The path of the mesh, for the message.
    """
    as_is = tuple(range(len(mesh.names)))
    own = float(np.trace(_volumes(mesh, tissue, 1.0, (1, 1, 1))))
    readings = [_best_order(mesh, tissue, unit, signs) for unit in UNITS for signs in product((1, -1), repeat=3)]
    highest = max(reading.share for reading in readings)
    best = min(
        (reading for reading in readings if reading.share >= highest - BETTER),
        key=lambda reading: (_cost(reading), -reading.share),
    )
    if best.share > own + BETTER and 1 - best.share < LESS * (1 - own):
        parts = []
        if best.unit != 1:
            parts.append(f"in {UNITS[best.unit]} (write it in mm)")
        if turned := [axis for axis, sign in zip("xyz", best.signs, strict=True) if sign < 0]:
            lps = " (it may be in LPS: write it in RAS)" if turned == ["x", "y"] else ""
            parts.append(f"with {' and '.join(turned)} reversed{lps}")
        if best.order != as_is:
            names = ", ".join(mesh.names[k] for k in best.order)
            parts.append(f"with its tissues numbered as {names} and not as {', '.join(mesh.names)}")
        raise InputError(
            f"mesh {path} has the tissue of the labels in {own:.0%} of its volume; it would have it in "
            f"{best.share:.0%} {' and '.join(parts)}"
        )
    if own < LEAST:
        raise InputError(
            f"mesh {path} has the tissue of the labels in no more than {own:.0%} of its volume; give a mesh of these "
            "labels in the world of the fixed image (RAS, mm), or leave mesh.file out"
        )


def _cost(reading: _Reading) -> int:
    renumbered = reading.order != tuple(range(len(reading.order)))
    return COST_OF_UNIT * (reading.unit != 1) + COSTS.get(reading.signs, COST_OF_SIGNS) + COST_OF_ORDER * renumbered


def _best_order(mesh: TetMesh, tissue: Image, unit: float, signs: tuple[int, ...]) -> _Reading:
    """Find the order of the tissues that agrees with the labels in most of the volume."""
    volumes = _volumes(mesh, tissue, unit, signs)
    rows, columns = linear_sum_assignment(-volumes)
    return _Reading(float(volumes[rows, columns].sum()), unit, signs, tuple(columns.tolist()))


def _volumes(mesh: TetMesh, tissue: Image, unit: float, signs: tuple[int, ...]) -> Float[np.ndarray, "tissues tissues"]:
    """Compute the share of the mesh's volume for each pair of mesh tissue (rows) and label tissue (columns).

    The label is read at the centre of each tetrahedron.
    """
    centres = mesh.points[mesh.cells].mean(axis=1) * unit * np.array(signs)
    labels = tissue.nearest(centres).astype(int)
    shares = np.zeros((len(mesh.names), len(mesh.names) + 1))
    np.add.at(shares, (mesh.tissue, labels), mesh.volumes / mesh.volumes.sum())
    return shares[:, 1:]
