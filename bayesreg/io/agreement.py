"""Whether a mesh from a file lies where the labels are, and calls the tissues as they do."""

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

# Other readings of a file: its unit in mm, and the axes that may be reversed.
UNITS = {1.0: "mm", 10.0: "cm", 1000.0: "m"}
# A mesh of these labels agrees with them in four fifths of its volume, less where tissues are thin; what is reversed in
# a brain from left to right loses .07 of it.
LEAST, BETTER = 0.3, 0.05
# Advice is given where a reading disagrees in so much less of the volume.
LESS = 0.8
# How unusual a reading is: of those that agree about as well (an organ is much the same reversed) the most usual is
# meant. Formats differ by LPS and RAS, and by units; single axes are reversed, and tissues renumbered, by mistake.
COSTS: dict[tuple[int, ...], int] = {(1, 1, 1): 0, tuple(LPS.astype(int).tolist()): 1}
COST_OF_UNIT, COST_OF_SIGNS, COST_OF_ORDER = 1, 2, 2


class _Reading(NamedTuple):
    """How a file may be read, and the share of the mesh's volume that has the tissue of the labels then."""

    share: float
    unit: float
    signs: tuple[int, ...]
    order: tuple[int, ...]


def require_agreement(mesh: TetMesh, tissue: Image, path: str | Path) -> None:
    """Raise InputError where a mesh does not lie where the labels do, or another reading of it would do so better.

    Parameters
    ----------
    mesh : TetMesh
    tissue : Image
        0 outside, 1 + index into `mesh.names` inside.
    path : path
        Of the mesh, for the message.
    """
    as_is = tuple(range(len(mesh.names)))
    own = float(np.trace(_volumes(mesh, tissue, 1.0, (1, 1, 1))))
    readings = [_best_order(mesh, tissue, unit, signs) for unit in UNITS for signs in product((1, -1), repeat=3)]
    highest = max(reading.share for reading in readings)
    best = min((one for one in readings if one.share >= highest - BETTER), key=lambda one: (_cost(one), -one.share))
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
    """The reading with the tissues named as the labels are in most of the volume."""
    volumes = _volumes(mesh, tissue, unit, signs)
    rows, columns = linear_sum_assignment(-volumes)
    return _Reading(float(volumes[rows, columns].sum()), unit, signs, tuple(columns.tolist()))


def _volumes(mesh: TetMesh, tissue: Image, unit: float, signs: tuple[int, ...]) -> Float[np.ndarray, "tissues tissues"]:
    """Share of the mesh's volume by its tissue and by that of the labels at the centre of each tetrahedron."""
    centres = mesh.points[mesh.cells].mean(axis=1) * unit * np.array(signs)
    labels = tissue.nearest(centres).astype(int)
    found = np.zeros((len(mesh.names), len(mesh.names) + 1))
    np.add.at(found, (mesh.tissue, labels), mesh.volumes / mesh.volumes.sum())
    return found[:, 1:]
