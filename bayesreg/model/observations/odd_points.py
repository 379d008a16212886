"""Sentences on points that look like a mistake: repeated, contradictory, in one plane, or read in a wrong way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from bayesreg.fem.location import nearest_places
from bayesreg.image import Image
from bayesreg.io.spaces import LPS
from bayesreg.mesh import TetMesh
from bayesreg.printable import join_some

# Points nearer than this are one place, mm.
ONE_PLACE = 1e-3
# Points lie in one plane if they are thinner than this share of their width.
FLAT = 0.05
# Another reading fits clearly better if this share of all points lies near the mesh by it alone.
CLEARLY = 0.25


class Reading(NamedTuple):
    """Another reading of the same numbers.

    Attributes
    ----------
    name : str
        What the points then are, after "if they were".
    remedy : str
        What to do if this is the right reading, after "then".
    near : (k,) bool array
        Whether each point then lies near the mesh (`lie_near`).
    """

    name: str
    remedy: str
    near: Bool[np.ndarray, "k"]


def lie_near(mesh: TetMesh, points: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, "k"]:
    """Check which points lie in a mesh, or outside by no more than the length of its edges."""
    return nearest_places(mesh, points)[2] <= mesh.boundary_edge


def other_readings(mesh: TetMesh, points: Float[np.ndarray, "k 3"], grids: Mapping[str, Image]) -> list[Reading]:
    """Read points in the other of LPS and RAS, and as voxel indices of grids, by names such as "the labels"."""
    mirrored = Reading(
        "of the other sign in x and y, by which LPS and RAS differ",
        "state the right one, in a CSV by a line such as # CoordinateSystem = LPS",
        lie_near(mesh, points * LPS),
    )
    by_voxels = [
        Reading(f"voxel indices of {name}", "convert them to world mm", lie_near(mesh, grid.voxel_to_world(points)))
        for name, grid in grids.items()
    ]
    return [mirrored, *by_voxels]


def suspect_reading(near: Bool[np.ndarray, "k"], others: Sequence[Reading]) -> str:
    """Say by which other reading clearly more points lie near the mesh; empty if by none.

    Parameters
    ----------
    near : (k,) bool array
        Whether each point lies near the mesh as it is given.
    others : sequence of Reading
        Of two that fit alike, the first is told.
    """
    best = max(others, key=lambda reading: np.count_nonzero(reading.near))
    count = np.count_nonzero(best.near)
    if count - np.count_nonzero(near) <= CLEARLY * len(near):
        return ""
    return f"{count} of {len(near)} would lie in the mesh or near it if they were {best.name}; then {best.remedy}"


def first_of_each(fixed: Float[np.ndarray, "k 3"], moving: Float[np.ndarray, "k 3"]) -> Int[np.ndarray, "distinct"]:
    """Return the sorted numbers of the pairs that are no exact copy of an earlier pair."""
    return np.sort(np.unique(np.hstack([fixed, moving]), axis=0, return_index=True)[1])


def describe_contradictions(
    name: str, fixed: Float[np.ndarray, "k 3"], moving: Float[np.ndarray, "k 3"], labels: Sequence[str]
) -> list[str]:
    """Return a sentence on the points that share a place in the fixed image, and not in the moving one."""
    pairs = cKDTree(fixed).query_pairs(ONE_PLACE, output_type="ndarray")
    apart = np.linalg.norm(moving[pairs[:, 0]] - moving[pairs[:, 1]], axis=1)
    order = np.argsort(-apart)
    named = [
        f"{labels[i]} and {labels[j]} ({apart[row]:.3g} mm)" for row, (i, j) in zip(order, pairs[order], strict=True)
    ]
    if not named:
        return []
    return [
        f"{name}: some points share one place in the fixed image, and lie apart in the moving image (by how much): "
        f"{join_some(named)}. One of each two is off by half of this or more; look at them again."
    ]


def describe_plane(name: str, points: Float[np.ndarray, "k 3"]) -> list[str]:
    """Return a sentence if all points, three or more, lie nearly in one plane."""
    if len(points) < 3:
        return []
    _, width, thickness = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if thickness > FLAT * width:
        return []
    return [
        f"{name}: all {len(points)} points lie nearly in one plane; where nothing else is observed, the elastic prior "
        "alone tells what moves off this plane."
    ]
