"""Score a displacement against the truth of a pair that `studies.external.make_pair` made.

    python -m studies.external.score PAIR RUN
    python -m studies.external.score PAIR --mean U.nii.gz [--sd S.nii.gz] [--on RUN]

U and S are ITK displacement fields, (X, Y, Z, 1, 3) in mm, LPS, fixed to moving, on the grid of fixed.nii.gz; a run's
folder holds them as displacement_mean.nii.gz and displacement_sd.nii.gz. The scores count the voxels where the truth is
valid and the field is defined. The field is defined where S is not zero or, with --on, where the sd of RUN is not zero,
so that a peer is scored on the same voxels. The scores are

- the length of the error, mm: mean, 95 % and greatest; for all voxels, by tissue, where the truth moves by more than
  3 mm, within 10 mm of the wall of a cavity, and (mean and greatest) at the points;
- the share of the inner voxels at which the field folds;
- with an sd, the share of the true components inside the central 50, 90 and 95 % of a Normal with that mean and sd, and
  the root mean square sd over the root mean square error, which should be 1.

This module shares no code with bayesreg, so that it cannot repeat an error of bayesreg.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import nibabel as nib
import numpy as np
from scipy import ndimage as ndi
from scipy.stats import norm

TISSUES = {"csf": 1, "gm": 2, "wm": 3}
LEVELS = (0.5, 0.9, 0.95)
# mm
MOVED = 3.0


class Truth(NamedTuple):
    """The truth of a pair; displacements are in mm, world RAS, on the grid of the fixed image."""

    # (X, Y, Z, 3)
    u: np.ndarray
    # (X, Y, Z): the voxels where u is right, and those of them within 10 mm of the wall of a cavity.
    valid: np.ndarray
    walls: np.ndarray | None
    # (X, Y, Z), labels as in TISSUES
    labels: np.ndarray
    # (n, 3) each, mm, world RAS
    fixed_points: np.ndarray
    moving_points: np.ndarray
    # Voxel index to world RAS, mm; its axes are those of the world.
    affine: np.ndarray


def read_truth(pair: Path) -> Truth:
    """Read the truth from the folder of a pair."""
    arrays = np.load(pair / "truth.npz")
    points = np.loadtxt(pair / "points.csv", delimiter=",", skiprows=1)
    return Truth(
        u=arrays["u"].astype(float),
        valid=arrays["valid"],
        walls=arrays.get("walls"),
        labels=np.asarray(nib.load(pair / "labels.nii.gz").dataobj),
        fixed_points=points[:, :3],
        moving_points=points[:, 3:],
        affine=nib.load(pair / "fixed.nii.gz").affine,
    )


def read_field(path: Path) -> np.ndarray:
    """Read an ITK displacement field as (X, Y, Z, 3), mm, world RAS."""
    array = np.asarray(nib.load(path).dataobj, float)
    return array.reshape(*array.shape[:3], 3) * [-1, -1, 1]


def score(pair: Path, mean: Path, sd: Path | None = None, on: Path | None = None) -> dict[str, Any]:
    """Score a field in files.

    Parameters
    ----------
    pair : path
        Folder of the pair.
    mean, sd : path
        Displacement fields of ITK.
    on : path, optional
        The folder of the run whose voxels are counted.
    """
    spread = None if sd is None else np.abs(read_field(sd))
    beside = spread if on is None else np.abs(read_field(on / "displacement_sd.nii.gz"))
    return compare(read_truth(pair), read_field(mean), spread, None if beside is None else beside.sum(axis=-1) > 0)


def compare(
    truth: Truth, mean: np.ndarray, sd: np.ndarray | None = None, defined: np.ndarray | None = None
) -> dict[str, Any]:
    """Score a field in memory.

    Parameters
    ----------
    truth : Truth
    mean, sd : (X, Y, Z, 3) arrays
        mm, world RAS.
    defined : (X, Y, Z) array of booleans, optional
        The voxels where the field is defined; by default those where the truth is valid.
    """
    defined = truth.valid if defined is None else defined
    counted = truth.valid & defined
    error, size = np.linalg.norm(mean - truth.u, axis=-1), np.linalg.norm(truth.u, axis=-1)
    core = counted & ndi.binary_erosion(defined)
    scores = {
        "given_share": round(float(counted.sum() / truth.valid.sum()), 4),
        "error": _lengths(error[counted]),
        **{name: _lengths(error[counted & (truth.labels == value)]) for name, value in TISSUES.items()},
        "moved_over_3mm": _lengths(error[counted & (size > MOVED)]),
        "cavity_walls": None if truth.walls is None else _lengths(error[counted & truth.walls]),
        "unregistered_mean": round(float(size[counted].mean()), 3),
        "tre": _error_at_points(truth, mean, counted),
        "folded_share": round(float((determinant(mean, truth.affine)[core] <= 0).mean()), 6),
    }
    return scores if sd is None else scores | _calibration((mean - truth.u)[counted], sd[counted])


def determinant(u: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """Compute det(I + ∂u/∂x) at every voxel by differences, for u (X, Y, Z, 3) in mm on a grid along the world axes."""
    slope = np.stack(np.gradient(u, *nib.affines.voxel_sizes(affine), axis=(0, 1, 2)), axis=-1)
    return np.linalg.det(slope * np.sign(np.diag(affine)[:3]) + np.eye(3))


def _lengths(error: np.ndarray) -> list[float] | None:
    """Return the mean, the 95 % quantile and the greatest error."""
    if not error.size:
        return None
    return [round(float(value), 3) for value in (error.mean(), np.percentile(error, 95), error.max())]


def _error_at_points(truth: Truth, mean: np.ndarray, counted: np.ndarray) -> list[float]:
    """Return the mean and the greatest error of the points inside the counted voxels."""
    inverse = np.linalg.inv(truth.affine)
    indices = (truth.fixed_points @ inverse[:3, :3].T + inverse[:3, 3]).T
    u = np.stack([ndi.map_coordinates(mean[..., i], indices, order=1) for i in range(3)], axis=1)
    error = np.linalg.norm(truth.fixed_points + u - truth.moving_points, axis=1)
    inside = ndi.map_coordinates(counted.astype(float), indices, order=1) > 0.99
    return [round(float(value), 3) for value in (error[inside].mean(), error[inside].max())]


def _calibration(error: np.ndarray, sd: np.ndarray) -> dict[str, Any]:
    """Compute coverage and sharpness over the components."""
    z = np.abs(error) / np.maximum(sd, 1e-9)
    return {
        "coverage_50_90_95": [round(float((z < norm.ppf(0.5 + level / 2)).mean()), 3) for level in LEVELS],
        "sd_over_rms_error": round(float(np.sqrt((sd**2).mean()) / np.sqrt((error**2).mean())), 3),
    }


def main() -> None:
    """Read the command line, and print the scores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pair", type=Path)
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--mean", type=Path)
    parser.add_argument("--sd", type=Path)
    parser.add_argument("--on", type=Path)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    if arguments.run is None and arguments.mean is None:
        parser.error("give the folder of a run, or --mean")
    sd = arguments.sd or (arguments.run and arguments.run / "displacement_sd.nii.gz")
    scores = score(arguments.pair, arguments.mean or arguments.run / "displacement_mean.nii.gz", sd, arguments.on)
    print(json.dumps(scores) if arguments.json else "\n".join(f"{name:18s} {value}" for name, value in scores.items()))


if __name__ == "__main__":
    main()
