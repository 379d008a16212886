"""A label map carried to another grid: how probable each label is in every voxel, over draws of the displacement."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import edt
import numpy as np
from jaxtyping import Float, Int, UInt

from bayesreg.fem.location import Location
from bayesreg.image import Image, slices
from bayesreg.results.transform import Transform

# Counts of labels in one go over the draws.
MOST_COUNTS = 100_000_000
# What a draw changes is bounded by its largest change at the nodes about, times this.
MARGIN = 1.25
# And what the mesh does not resolve of it by so many standard deviations.
FURTHEST = 4.0


@dataclass(frozen=True, eq=False)
class CarriedLabels:
    """Labels in the voxels of a grid.

    Attributes
    ----------
    grid : Image
    values : (L,) int array
        The labels, zero first.
    certain : (V,) int array
        For every voxel, in the order of memory, its index into `values` by the posterior mean; −1 where none is known.
    open : (k,) int array
        The voxels of which draws may tell more than one label.
    counts : (L, k) int array
        Of so many draws each such voxel has each label.
    draws : int
    """

    grid: Image
    values: Int[np.ndarray, "L"]
    certain: Int[np.ndarray, "V"]
    open: Int[np.ndarray, "k"]
    counts: UInt[np.ndarray, "L k"]
    draws: int

    @property
    def most_probable(self) -> Image:
        """The label that most draws give each voxel; zero where none is known."""
        found = np.where(self.certain < 0, 0, self.values[self.certain])
        known = self.certain[self.open] >= 0
        found[self.open[known]] = self.values[self.counts[:, known].argmax(axis=0)]
        return self.grid.with_voxels(found.reshape(self.grid.shape).astype(np.int32))

    def probabilities(self) -> Iterator[tuple[int, Float[np.ndarray, "X Y Z"]]]:
        """Every label but zero, and how probable it is in each voxel; NaN where none is known."""
        for index, value in enumerate(self.values):
            if value:
                found = (self.certain == index).astype(np.float32)
                found[self.open] = self.counts[index] / self.draws
                found[self.certain < 0] = np.nan
                yield int(value), found.reshape(self.grid.shape)


def carry_labels(transform: Transform, labels: Image, grid: Image, keep_around: bool = True) -> CarriedLabels:
    """Carry labels by every draw of a transform.

    Parameters
    ----------
    transform : Transform
        From the world of the labels to that of the grid.
    labels : Image
        Whole numbers; zero beyond its grid.
    grid : Image
        Its voxels get labels.
    keep_around : bool
        Whether what comes from around the mesh is carried, too; where not, no label is known there.

    Notes
    -----
    A voxel gets the label of the place that a draw leads back to. Where that of the posterior mean is further from
    any other label than a draw can lead, all draws agree, and none is asked.
    """
    labels = labels.on_orthogonal_grid(order=0)
    values, index = np.unique(np.append(labels.voxels, 0), return_inverse=True)
    labels = labels.with_voxels(index[:-1].reshape(labels.shape).astype(np.int16))
    background = int(index[-1])
    order = np.array([background, *(k for k in range(len(values)) if k != background)])
    rank = np.argsort(order)
    numbers = labels.with_voxels(rank[np.asarray(labels.voxels)].astype(np.int16))

    back = transform.inverse
    distance, box = _distance_to_others(numbers), _box(numbers)
    reach = _reach(back)
    certain, unsure = (np.empty(int(np.prod(grid.shape)), kind) for kind in (np.int16, bool))
    nearby, unresolved = [], []
    for some, places in grid.blocks():
        source, near = back.place(places)
        certain[some] = numbers.nearest(source)
        if not keep_around:
            certain[some][~back.deformer.is_inside(near)] = -1
        sd = back.unresolved_sd(near)
        apart = np.where(numbers.contains(source), distance.nearest(source), _distance_to_box(numbers, box, source))
        unsure[some] = (apart <= reach[near.cell] + FURTHEST * sd.max(axis=1)) & (certain[some] >= 0)
        nearby.append(Location(near.cell[unsure[some]], near.barycentric[unsure[some]]))
        unresolved.append(sd[unsure[some]].astype(np.float32))
    open_voxels, unresolved_sd = np.flatnonzero(unsure), np.concatenate(unresolved)
    cell, barycentric = (np.concatenate(parts) for parts in zip(*nearby, strict=True))
    counts = np.zeros((len(values), len(open_voxels)), np.uint16)
    for some in slices(len(open_voxels), max(MOST_COUNTS // len(values), 1)):
        part = counts[:, some]
        _count(
            back,
            numbers,
            grid.centres(open_voxels[some]),
            Location(cell[some], barycentric[some]),
            unresolved_sd[some],
            part,
        )
    return CarriedLabels(grid, values[order], certain, open_voxels, counts, len(transform.draws))


def _count(
    back: Transform,
    numbers: Image,
    places: Float[np.ndarray, "k 3"],
    near: Location,
    unresolved_sd: Float[np.ndarray, "k 3"],
    counts: UInt[np.ndarray, "L k"],
) -> None:
    """Add the labels that every draw gives to places."""

    def labels_of(draw: int) -> Int[np.ndarray, "k"]:
        sources = back.place_by(draw, places, near, unresolved_sd)
        return numbers.nearest(sources)

    columns = np.arange(len(places))
    for found in back.for_each_draw(labels_of):
        counts[found, columns] += 1


def _distance_to_others(numbers: Image) -> Image:
    """How far every point of a voxel is at least from other labels, mm."""
    # Zero is a label as others are, also beyond the grid.
    shifted = np.pad(np.asarray(numbers.voxels).astype(np.uint32) + 1, 1, constant_values=1)
    found = edt.edt(shifted, anisotropy=tuple(numbers.voxel_sizes), black_border=False, parallel=0)[1:-1, 1:-1, 1:-1]
    return numbers.with_voxels(np.maximum(found - np.linalg.norm(numbers.voxel_sizes), 0))


def _box(numbers: Image) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The corners of what has a label, as voxel indices; far away where nothing has one."""
    labelled = np.argwhere(np.asarray(numbers.voxels) != 0)
    if not len(labelled):
        return np.full(3, np.inf), np.full(3, np.inf)
    return labelled.min(axis=0) - 0.5, labelled.max(axis=0) + 0.5


def _distance_to_box(
    numbers: Image, box: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]], points: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "k"]:
    """How far points are from a box of voxels, mm."""
    index = numbers.world_to_voxel(points)
    outside = np.maximum(np.maximum(box[0] - index, index - box[1]), 0)
    return np.linalg.norm(outside * numbers.voxel_sizes, axis=1)


def _reach(back: Transform) -> Float[np.ndarray, "cells"]:
    """How far a source by a draw may be from that by the posterior mean, mm, by tetrahedron; last beyond the sphere."""
    around = back.deformer.surroundings
    mean = around.extend(back.u_mean)
    away = np.zeros(len(mean))
    for u in back.draws:
        away = np.maximum(away, np.linalg.norm(around.extend(u) - mean, axis=1))
    corners = around.points[around.cells]
    moved = corners + mean[around.cells]
    edges, moved_edges = (x[:, 1:] - x[:, :1] for x in (corners, moved))
    # Back through (I + ∇u)⁻¹.
    stretch = np.linalg.norm(np.linalg.solve(moved_edges, edges), ord=2, axis=(1, 2))
    reach = MARGIN * stretch * away[around.cells].max(axis=1)
    return np.append(reach, away.max())
