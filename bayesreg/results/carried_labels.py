"""Transformation of a label map to another grid: the probability of each label in every voxel, from draws."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import edt
import numpy as np
from jaxtyping import Float, Int, UInt

from bayesreg.fem.location import Location
from bayesreg.image import Image, slices
from bayesreg.results.transform import Transform

# The largest number of counts (labels times voxels) in one pass over the draws.
MOST_COUNTS = 100_000_000
# The change of a source point by a draw is at most the largest change at the nodes of its tetrahedron times this.
MARGIN = 1.25
# The part of the change that the mesh does not resolve is at most this number of standard deviations.
FURTHEST = 4.0


@dataclass(frozen=True, eq=False)
class CarriedLabels:
    """Labels in the voxels of a grid, with their probabilities.

    Attributes
    ----------
    grid : Image
    values : (L,) int array
        The labels, zero first.
    certain : (V,) int array
        For every voxel, in the order of memory, the index into `values` of its label by the posterior mean; −1 if the
        label is unknown.
    open : (k,) int array
        The voxels whose label may differ between draws.
    counts : (L, k) int array
        Number of draws in which each of these voxels has each label.
    draws : int
        Number of all draws.
    """

    grid: Image
    values: Int[np.ndarray, "L"]
    certain: Int[np.ndarray, "V"]
    open: Int[np.ndarray, "k"]
    counts: UInt[np.ndarray, "L k"]
    draws: int

    @property
    def most_probable(self) -> Image:
        """The most frequent label of each voxel over the draws; zero if it is unknown."""
        labels = np.where(self.certain < 0, 0, self.values[self.certain])
        is_known = self.certain[self.open] >= 0
        labels[self.open[is_known]] = self.values[self.counts[:, is_known].argmax(axis=0)]
        return self.grid.with_voxels(labels.reshape(self.grid.shape).astype(np.int32))

    def probabilities(self) -> Iterator[tuple[int, Float[np.ndarray, "X Y Z"]]]:
        """Yield every label except zero with its probability in each voxel; NaN where the label is unknown."""
        for index, value in enumerate(self.values):
            if value:
                probability = (self.certain == index).astype(np.float32)
                probability[self.open] = self.counts[index] / self.draws
                probability[self.certain < 0] = np.nan
                yield int(value), probability.reshape(self.grid.shape)


def carry_labels(transform: Transform, labels: Image, grid: Image, keep_around: bool = True) -> CarriedLabels:
    """Transform labels by every draw of a transform.

    Parameters
    ----------
    transform : Transform
        The transform from the labels' world to the grid's world.
    labels : Image
        Whole numbers; zero beyond their grid.
    grid : Image
        The grid of the result.
    keep_around : bool
        Whether labels from around the mesh are transformed, too; otherwise they are unknown.

    Notes
    -----
    For each draw, a voxel gets the label of its source, the point that the draw maps to the voxel centre. If the source
    by the posterior mean is further from any other label than draws can move it, all draws agree and none is computed.
    """
    labels = labels.on_orthogonal_grid(order=0)
    values, index = np.unique(np.append(labels.voxels, 0), return_inverse=True)
    labels = labels.with_voxels(index[:-1].reshape(labels.shape).astype(np.int16))
    background = int(index[-1])
    order = np.array([background, *(k for k in range(len(values)) if k != background)])
    rank = np.argsort(order)
    numbers = labels.with_voxels(rank[np.asarray(labels.voxels)].astype(np.int16))

    inverse = transform.inverse
    distance, box = _distance_to_others(numbers), _box(numbers)
    reach = _reach(inverse)
    certain, unsure = (np.empty(int(np.prod(grid.shape)), kind) for kind in (np.int16, bool))
    nearby = []
    for block, places in grid.blocks():
        source, near = inverse.place(places)
        certain[block] = numbers.nearest(source)
        if not keep_around:
            certain[block][~inverse.deformer.is_inside(near)] = -1
        sd = inverse.unresolved_sd(near)
        clearance = np.where(numbers.contains(source), distance.nearest(source), _distance_to_box(numbers, box, source))
        unsure[block] = (clearance <= reach[near.cell] + FURTHEST * sd.max(axis=1)) & (certain[block] >= 0)
        nearby.append(Location(near.cell[unsure[block]], near.barycentric[unsure[block]]))
    open_voxels = np.flatnonzero(unsure)
    cell, barycentric = (np.concatenate(pieces) for pieces in zip(*nearby, strict=True))
    counts = np.zeros((len(values), len(open_voxels)), np.uint16)
    for block in slices(len(open_voxels), max(MOST_COUNTS // len(values), 1)):
        block_counts = counts[:, block]
        _count(
            inverse,
            numbers,
            grid.centres(open_voxels[block]),
            Location(cell[block], barycentric[block]),
            block_counts,
        )
    return CarriedLabels(grid, values[order], certain, open_voxels, counts, len(transform.draws))


def _count(
    inverse: Transform,
    numbers: Image,
    places: Float[np.ndarray, "k 3"],
    near: Location,
    counts: UInt[np.ndarray, "L k"],
) -> None:
    """Count the labels that every draw gives to points, in place."""

    averaged_sd = inverse.averaged_sd(near)

    def labels_of(draw: int) -> Int[np.ndarray, "k"]:
        sources = inverse.place_by(draw, places, near, averaged_sd)
        return numbers.nearest(sources)

    columns = np.arange(len(places))
    for labels in inverse.for_each_draw(labels_of):
        counts[labels, columns] += 1


def _distance_to_others(numbers: Image) -> Image:
    """Compute a lower bound, mm, of the distance of any point in a voxel from other labels."""
    # Zero counts as a label, also beyond the grid.
    shifted = np.pad(np.asarray(numbers.voxels).astype(np.uint32) + 1, 1, constant_values=1)
    distance = edt.edt(shifted, anisotropy=tuple(numbers.voxel_sizes), black_border=False, parallel=0)[1:-1, 1:-1, 1:-1]
    return numbers.with_voxels(np.maximum(distance - np.linalg.norm(numbers.voxel_sizes), 0))


def _box(numbers: Image) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Compute the corners, as voxel indices, of the box of all labelled voxels; infinite if there are none."""
    labelled = np.argwhere(np.asarray(numbers.voxels) != 0)
    if not len(labelled):
        return np.full(3, np.inf), np.full(3, np.inf)
    return labelled.min(axis=0) - 0.5, labelled.max(axis=0) + 0.5


def _distance_to_box(
    numbers: Image, box: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]], points: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "k"]:
    """Compute the distance of points from a box of voxels, mm."""
    index = numbers.world_to_voxel(points)
    outside = np.maximum(np.maximum(box[0] - index, index - box[1]), 0)
    return np.linalg.norm(outside * numbers.voxel_sizes, axis=1)


def _reach(inverse: Transform) -> Float[np.ndarray, "cells"]:
    """Bound the distance, mm, between the sources of a point by a draw and by the posterior mean.

    There is one bound for each tetrahedron of the mesh and its surroundings; the last one holds beyond these.
    """
    surroundings = inverse.deformer.surroundings
    mean = surroundings.extend(inverse.u_mean)
    away = np.zeros(len(mean))
    for u in inverse.draws:
        away = np.maximum(away, np.linalg.norm(surroundings.extend(u) - mean, axis=1))
    corners = surroundings.points[surroundings.cells]
    moved_corners = corners + mean[surroundings.cells]
    edges, moved_edges = (x[:, 1:] - x[:, :1] for x in (corners, moved_corners))
    # A displacement changes the source by up to the norm of (I + ∇u)⁻¹ times its length.
    stretch = np.linalg.norm(np.linalg.solve(moved_edges, edges), ord=2, axis=(1, 2))
    reach = MARGIN * stretch * away[surroundings.cells].max(axis=1)
    return np.append(reach, away.max())
