"""Grids of voxels: the grid of a file, and tests whether two images share one; world RAS, mm."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.memory import memory_of_machine
from bayesreg.types import InputError

# Two grids are the same if the distance between their corners is at most this share of a voxel.
SAME_GRID = 0.1

_log = logging.getLogger(__name__)


class Volume(NamedTuple):
    """The voxels and the affine of a file.

    Attributes
    ----------
    voxels : (X, Y, Z, ...) array
        Values after the file's intensity scale. Components of vectors are the last axis.
    affine : (4, 4) array
        Voxel index to world RAS, mm.
    header : object
        The header from nibabel; None if SimpleITK read the file.
    """

    voxels: np.ndarray
    affine: Float[np.ndarray, "4 4"]
    header: Any = None


class Grid(NamedTuple):
    """The grid of a file, from its header only.

    Attributes
    ----------
    shape : tuple of int
    affine : (4, 4) array
        Voxel index to world RAS, mm.
    qform : (4, 4) array or None
        The q-form of a NIfTI header if it differs from the s-form, which is used.
    remarks : tuple of str
        Messages for the user.
    """

    shape: tuple[int, ...]
    affine: Float[np.ndarray, "4 4"]
    qform: Float[np.ndarray, "4 4"] | None = None
    remarks: tuple[str, ...] = ()


def require_memory(shape: Sequence[int], path: Path) -> None:
    """Raise InputError if the voxels that a header declares need more memory than the machine has."""
    needed = 8 * prod(map(int, shape))
    held = memory_of_machine()
    if needed > held:
        grid = " × ".join(map(str, shape))
        raise InputError(
            f"image {path} has a grid of {grid} voxels by its header, which need {needed / 1e9:,.0f} GB; this machine "
            f"has {held / 1e9:,.0f} GB"
        )


def corners_apart(
    first_affine: Float[np.ndarray, "4 4"], second_affine: Float[np.ndarray, "4 4"], shape: tuple[int, ...]
) -> float:
    """Compute the largest distance, mm, between the corners of a grid under two affines."""
    corners = np.stack(np.meshgrid(*((0.0, n - 1.0) for n in shape[:3]), indexing="ij"), axis=-1).reshape(-1, 3)
    return float(
        np.linalg.norm(
            corners @ (first_affine - second_affine)[:3, :3].T + (first_affine - second_affine)[:3, 3], axis=1
        ).max()
    )


def is_same_grid(a: Image, b: Image) -> bool:
    """Check whether two images have the same grid (corners within a tenth of a voxel)."""
    distance = corners_apart(np.asarray(a.affine), np.asarray(b.affine), a.shape)
    return a.shape == b.shape and bool(distance <= SAME_GRID * a.voxel_sizes.min())


def check_same_grid(a: Image, b: Image, names: tuple[str, str] = ("first", "second")) -> None:
    """Raise InputError unless two images have the same grid (corners within a tenth of a voxel)."""
    if a.shape != b.shape:
        raise InputError(
            f"the {names[0]} and the {names[1]} image must share one grid, but have shapes {a.shape} and {b.shape}; "
            "resample one onto the other"
        )
    distance = corners_apart(a.affine, b.affine, a.shape)
    if not is_same_grid(a, b):
        raise InputError(
            f"the {names[0]} and the {names[1]} image must share one grid, but their affines place corners up to "
            f"{distance:.3g} mm apart; resample one onto the other"
        )


def on_grid_of(
    grid: Image, image: Image, names: tuple[str, str] = ("first", "second"), anywhere: bool = False
) -> Image:
    """Resample labels or a mask on the grid of another image by the nearest voxel; the log reports it.

    If the grids are the same, the voxels stay as they are.

    Parameters
    ----------
    grid : Image
    image : Image
        Labels or a mask; zero beyond its own grid.
    names : pair of str
        Names of the two images in a message.
    anywhere : bool
        Whether the image may be a small part of the grid.

    Raises
    ------
    InputError
        If the two hardly overlap in world space.
    """
    if is_same_grid(grid, image):
        return grid.with_voxels(image.voxels)
    if not anywhere:
        check_same_space(grid, image, names)
    between = image.to_voxel @ grid.affine
    resampled = grid.with_voxels(
        ndimage.affine_transform(
            np.asarray(image.voxels), between[:3, :3], between[:3, 3], grid.shape, order=0, mode="grid-constant"
        )
    )
    before, after = (np.count_nonzero(labels.voxels) * labels.voxel_volume / 1e3 for labels in (image, resampled))
    reordered = np.allclose(between, np.rint(between), atol=SAME_GRID / max(grid.shape)) and np.isclose(before, after)
    if not (reordered and round(abs(np.linalg.det(between))) == 1):
        _log.warning(
            "the %s image lies on another grid than the %s one; the nearest voxel is taken, and of %.4g ml that are "
            "not zero %.4g remain", names[1], names[0], before, after,
        )  # fmt: skip
    return resampled


def check_same_space(a: Image, b: Image, names: tuple[str, str] = ("first", "second"), least: float = 0.1) -> None:
    """Raise InputError unless two images overlap in world space.

    Parameters
    ----------
    a, b : Image
        The two images, on any grids.
    names : pair of str
        Names of the two images in the message.
    least : float
        Least fraction of the first image's extent that the second must cover.
    """
    samples = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 16) for n in a.shape), indexing="ij"), axis=-1)
    covered = float(np.mean(b.contains(a.voxel_to_world(samples))))
    if covered < least:
        raise InputError(
            f"the {names[1]} image covers {covered:.0%} of the {names[0]} one, expected at least {least:.0%}: "
            f"their centres lie at {_centre(a)} and {_centre(b)} mm; check the affines, or align the images"
        )


def _centre(image: Image) -> list[float]:
    return image.voxel_to_world((np.array(image.shape) - 1) / 2).round(1).tolist()
