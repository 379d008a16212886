"""Descriptions of places: sides by world RAS axes relative to the mesh's centre, and the nearest tissue."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from bayesreg.mesh import TetMesh
from bayesreg.tissues import label_of
from bayesreg.types import AnyArray

SIDES = (("left", "right"), ("posterior", "anterior"), ("inferior", "superior"))
# A place within this share of the mesh's half width from the centre is on neither side.
MIDDLE = 0.15


def regions(mesh: TetMesh, places: Float[AnyArray, "places 3"]) -> list[str]:
    """Describe each place in words, as "right anterior, tumour"; the tissue of the nearest tetrahedron's centre."""
    places = np.asarray(places, float)
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    offsets = (places - (low + high) / 2) / ((high - low) / 2)
    _, nearest = cKDTree(mesh.points[mesh.cells].mean(axis=1)).query(places)
    labels = [label_of(mesh.names[k]) for k in mesh.tissue[nearest]]
    return [f"{_sides(offset)}, {label}" for offset, label in zip(offsets, labels, strict=True)]


def _sides(offset: np.ndarray) -> str:
    words = [pair[int(x > 0)] for x, pair in zip(offset, SIDES, strict=True) if abs(x) > MIDDLE]
    return " ".join(words) or "central"
