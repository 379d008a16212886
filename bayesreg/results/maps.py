"""Maps of the posterior on a grid: uncertainty of the displacement, change of volume, stiffness."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayesreg.fem.location import Location
from bayesreg.image import Image, slices
from bayesreg.io.volumes import load_image, write_nifti
from bayesreg.mesh import TetMesh, signed_volumes
from bayesreg.model.warp import Covered, covered_voxels
from bayesreg.results.apply import require_distances, require_folder
from bayesreg.results.nodal_draws import POINT_DRAWS, transform_of
from bayesreg.results.result import load_result
from bayesreg.results.transform import Transform, distances_of
from bayesreg.types import InputError

_log = logging.getLogger(__name__)

CHUNK = 500_000


def maps(
    folder: str | Path,
    out: str | Path,
    *,
    far: Sequence[float] = (2.0,),
    like: str | Path | None = None,
    draws: int = POINT_DRAWS,
) -> list[Path]:
    """Write maps of a run on the grid of its fixed image; NaN outside the mesh, where nothing is observed.

    Parameters
    ----------
    folder : path
        The folder of a run.
    out : path
        The output folder; files of the same names are replaced.
    far : sequence of float
        Distances d, mm, for the maps of P(distance > d).
    like : path, optional
        An image in the fixed image's world whose grid is used instead.
    draws : int
        Largest number of draws.

    Returns
    -------
    list of Path
        radius95.nii.gz
            Radius of the ball around the posterior mean that holds a displaced point with 95 % probability, mm.
        p_over_2mm.nii.gz and so on
            P(distance of a displaced point from the posterior mean > d), here with d = 2 mm.
        jacobian_mean.nii.gz, jacobian_sd.nii.gz
            Mean and standard deviation of det F in the tetrahedron of each voxel: the ratio of the volumes after and
            before the deformation.
        p_inverted.nii.gz
            P(det F < 0).
        stiffness_mean.nii.gz, stiffness_sd.nii.gz
            Mean and standard deviation of the ratio of the stiffness to that of the tissue, if the model has a field of
            stiffness.

    Raises
    ------
    InputError
        If the folder holds no run, or a distance is not above zero.
    """
    require_distances(far)
    if draws < 2:
        raise InputError(f"expected at least two draws, got {draws}")
    result, out = load_result(folder), require_folder(out)
    grid = result.run.background if like is None else load_image(like)
    covered = covered_voxels(grid, result.mesh)
    if not len(covered.cell):
        raise InputError(f"no voxel of the grid of {like or 'the fixed image'} lies in the mesh of {folder}")
    transform = transform_of(result, draws)
    values = _distances(transform, covered, far)
    by_cell = jacobians(result.mesh, transform.draws)
    if result.run.predicted is not None:
        by_cell |= {name: x for name, x in result.run.predicted.by_cell.items() if name != "stiffer_probability"}
    values |= {name: np.asarray(x)[covered.cell] for name, x in by_cell.items()}
    middle = float(np.median(values["radius95"]))
    _log.info(f"{len(covered.cell):,} voxels lie in the mesh; half of them have a 95 % radius above {middle:.2g} mm")
    out.mkdir(parents=True, exist_ok=True)
    return [_write(out / f"{name}.nii.gz", grid, covered, x) for name, x in values.items()]


def jacobians(mesh: TetMesh, draws: Float[np.ndarray, "draws nodes 3"]) -> dict[str, Float[np.ndarray, "cells"]]:
    """Compute the mean and standard deviation of det F of every tetrahedron, and the share of draws that invert it."""
    count, total, square, inverted = len(draws), *np.zeros((3, len(mesh.cells)))
    for u in draws:
        ratio = signed_volumes(mesh.points + u, mesh.cells) / mesh.volumes
        total, square, inverted = total + ratio, square + ratio**2, inverted + (ratio < 0)
    mean = total / count
    variance = np.maximum(square / count - mean**2, 0) * count / max(count - 1, 1)
    return {"jacobian_mean": mean, "jacobian_sd": np.sqrt(variance), "p_inverted": inverted / count}


def _distances(transform: Transform, covered: Covered, far: Sequence[float]) -> dict[str, Float[np.ndarray, "k"]]:
    names = ["radius95", *(f"p_over_{distance:g}mm" for distance in far)]
    values = np.empty((len(names), len(covered.cell)), np.float32)
    for chunk in slices(len(covered.cell), CHUNK):
        distances = distances_of(transform.covariance(Location(covered.cell[chunk], covered.barycentric[chunk])), far)
        values[:, chunk] = np.concatenate([distances.radius[None], distances.far])
    return dict(zip(names, values, strict=True))


def _write(path: Path, grid: Image, covered: Covered, values: Float[np.ndarray, "k"]) -> Path:
    voxels = np.full(grid.shape, np.nan, np.float32)
    voxels[tuple(covered.voxel.T)] = values
    write_nifti(voxels, grid.affine, path)
    return path
