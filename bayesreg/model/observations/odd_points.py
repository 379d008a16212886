"""Sentences on points that look like a mistake: repeated, contradictory, in one plane, or read in a wrong way."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bayesreg.fem.location import nearest_places
from bayesreg.image import Image
from bayesreg.io.spaces import LPS
from bayesreg.mesh import TetMesh
from bayesreg.printable import join_some
from bayesreg.types import InputError

# Points nearer than this are one place, mm.
ONE_PLACE = 1e-3
# Points lie in one plane if they are thinner than this share of their width.
FLAT = 0.05
# Another reading fits clearly better if this share of all points lies near the mesh by it alone, and one of moving
# points if it brings them to this share of their distance from their partners.
CLEARLY = 0.25
# Points are a spot, as points in metres are, if they spread over less than this share of the size of the mesh.
SPOT = 0.01
# Pairs are in disorder if the best rigid motion leaves partners further apart than this share of the points' distance
# from their centre, both in the median.
DISORDER = 0.5


class Reading(NamedTuple):
    """Another reading of the same numbers.

    Attributes
    ----------
    name : str
        What the points then are, after "if they were".
    remedy : str
        What to do if this is the right reading, after "then".
    mesh : TetMesh
        The mesh near which they then lie.
    points : (k, 3) array
        The points by this reading, world RAS mm.
    """

    name: str
    remedy: str
    mesh: TetMesh
    points: Float[np.ndarray, "k 3"]

    @property
    def near(self) -> Bool[np.ndarray, "k"]:
        """Whether each point then lies near the mesh."""
        return lie_near(self.mesh, self.points)


def lie_near(mesh: TetMesh, points: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, "k"]:
    """Check which points lie in a mesh, or outside by no more than the length of its edges."""
    return nearest_places(mesh, points)[2] <= mesh.boundary_edge


def other_readings(mesh: TetMesh, points: Float[np.ndarray, "k 3"], grids: Mapping[str, Image]) -> list[Reading]:
    """Read points in the other of LPS and RAS, in metres, and as voxel indices of grids, named such as "the labels"."""
    mirrored = Reading(
        "of the other sign in x and y, by which LPS and RAS differ",
        "state the right one, in a CSV by a line such as # CoordinateSystem = LPS",
        mesh,
        points * LPS,
    )
    by_voxels = [
        Reading(f"voxel indices of {name}", "convert them to world mm", mesh, grid.voxel_to_world(points))
        for name, grid in grids.items()
    ]
    return [mirrored, *by_voxels, Reading("in metres", "convert them to mm", mesh, 1000 * points)]


def suspect_reading(near: Bool[np.ndarray, "k"], others: Sequence[Reading]) -> str:
    """Say by which other reading clearly more points lie near the mesh; empty if by none.

    Parameters
    ----------
    near : (k,) bool array
        Whether each point lies near the mesh as it is given.
    others : sequence of Reading
        Of two that fit alike, the first is told.
    """
    counts = [np.count_nonzero(reading.near) for reading in others]
    best, count = others[int(np.argmax(counts))], max(counts)
    if count - np.count_nonzero(near) <= CLEARLY * len(near):
        return ""
    return f"{count} of {len(near)} would lie in the mesh or near it if they were {best.name}; then {best.remedy}"


def require_extent(name: str, mesh: TetMesh, points: Float[np.ndarray, "k 3"]) -> None:
    """Raise InputError if several points fill only a spot of the organ, as points in metres do."""
    extent, size = np.ptp(points, axis=0).max(), np.ptp(mesh.points, axis=0).max()
    if len(points) > 3 and 0 < extent < SPOT * size:
        raise InputError(
            f"{name}: all {len(points)} points lie within {extent:.2g} mm of each other, in an organ of {size:.0f} mm; "
            "are they in metres? Convert them to mm"
        )


def require_partners(
    name: str,
    mesh: TetMesh,
    fixed: Float[np.ndarray, "k 3"],
    moving: Float[np.ndarray, "k 3"],
    grids: Mapping[str, Image],
) -> None:
    """Raise InputError if the moving points lie much nearer to their partners by another reading."""
    others = other_readings(mesh, moving, grids)
    distances = [_median_distance(reading.points, fixed) for reading in others]
    given, best = _median_distance(moving, fixed), int(np.argmin(distances))
    if given > mesh.boundary_edge and distances[best] < CLEARLY * given:
        raise InputError(
            f"{name}: half of the moving points lie more than {given:.3g} mm away from their partners, and "
            f"{distances[best]:.3g} mm if they were {others[best].name}; then {others[best].remedy}. If they are "
            "right, data.pose: unknown takes them as they are"
        )


def describe_partners(
    name: str, mesh: TetMesh, fixed: Float[np.ndarray, "k 3"], moving: Float[np.ndarray, "k 3"]
) -> list[str]:
    """Return a sentence if the moving points fit no motion, as in another order, or lie far from their partners."""
    left, spread = _median_distance(_moved_rigidly(fixed, moving), moving), _median_distance(fixed, fixed.mean(axis=0))
    # Medians, so that a wrong pair does not count as disorder; two or three points follow any others nearly.
    if len(fixed) > 3 and left > DISORDER * spread:
        return [
            f"{name}: the best rigid motion leaves half of the points more than {left:.0f} mm away from their "
            f"partners; half of them lie within {spread:.0f} mm of their centre. Are the fixed and the "
            "moving points in the same order?"
        ]
    distance = _median_distance(moving, fixed)
    if distance > np.ptp(mesh.points, axis=0).max() / 2:
        return [
            f"{name}: half of the moving points lie more than {distance:.0f} mm away from their partners; if both are "
            "in mm, but of other coordinates, data.pose: unknown aligns them."
        ]
    return []


def _median_distance(points: Float[np.ndarray, "k 3"], others: Float[np.ndarray, "*k 3"]) -> float:
    return float(np.median(np.linalg.norm(points - others, axis=1)))


def _moved_rigidly(points: Float[np.ndarray, "k 3"], others: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    """Move points by the rigid motion that brings them nearest to others; one point only shifts."""
    away, others_away = points - points.mean(axis=0), others - others.mean(axis=0)
    if len(points) == 1:
        return others
    with warnings.catch_warnings():
        # Points on a line have many best rotations, all with the same distance.
        warnings.simplefilter("ignore", UserWarning)
        return Rotation.align_vectors(others_away, away)[0].apply(away) + others.mean(axis=0)


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
    """Return a sentence if all points, four or more, lie nearly in one plane."""
    if len(points) < 4:
        return []
    _, width, thickness = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if thickness > FLAT * width:
        return []
    return [
        f"{name}: all {len(points)} points lie nearly in one plane; where nothing else is observed, the elastic prior "
        "alone tells what moves off this plane."
    ]
