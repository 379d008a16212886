"""Score a displacement against the truth of a pair that `studies.external.make_pair` made.

    python -m studies.external.score PAIR RUN
    python -m studies.external.score PAIR --mean U.nii.gz [--sd S.nii.gz] [--on RUN]

U and S are ITK displacement fields, (X, Y, Z, 1, 3) in mm, LPS, fixed to moving, on the grid of fixed.nii.gz; a run's
folder holds them as displacement_mean.nii.gz and displacement_sd.nii.gz. Counted are the voxels where the truth is
valid and the field is given: where S is not zero, or, with --on, where that of RUN is not, so that a peer is scored on
the same voxels. Told are

- the length of the error, mm: mean, 95 % and greatest; of all, by tissue, where the truth moves by more than 3 mm,
  within 10 mm of a cavity's wall, and (mean and greatest) at the points;
- the share of the voxels inside at which the field folds;
- with an sd, the share of the true components inside the central 50, 90 and 95 % of a Normal with that mean and sd, and
  the root mean square sd over the root mean square error (1 is sharp and honest).

It shares no code with bayesreg, so that no error of the one is hidden by the other.
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
    """What is known of a pair. Displacements are in mm, world RAS, on the grid of the fixed image."""

    # (X, Y, Z, 3)
    u: np.ndarray
    # (X, Y, Z): where u holds; of these, within 10 mm of the wall of a cavity.
    valid: np.ndarray
    walls: np.ndarray | None
    # (X, Y, Z), as in TISSUES
    labels: np.ndarray
    # (n, 3) each, mm, world RAS
    fixed_points: np.ndarray
    moving_points: np.ndarray
    # Voxel index to world RAS, mm; its axes are those of the world.
    affine: np.ndarray


def read_truth(pair: Path) -> Truth:
    """The truth in the folder of a pair."""
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
    """An ITK displacement field as (X, Y, Z, 3), mm, world RAS."""
    array = np.asarray(nib.load(path).dataobj, float)
    return array.reshape(*array.shape[:3], 3) * [-1, -1, 1]


def score(pair: Path, mean: Path, sd: Path | None = None, on: Path | None = None) -> dict[str, Any]:
    """Scores of a field in files.

    Parameters
    ----------
    pair : path
        Folder of the pair.
    mean, sd : path
        Displacement fields of ITK.
    on : path, optional
        Folder of the run whose voxels are counted.
    """
    spread = None if sd is None else np.abs(read_field(sd))
    beside = spread if on is None else np.abs(read_field(on / "displacement_sd.nii.gz"))
    return compare(read_truth(pair), read_field(mean), spread, None if beside is None else beside.sum(axis=-1) > 0)


def compare(
    truth: Truth, mean: np.ndarray, sd: np.ndarray | None = None, defined: np.ndarray | None = None
) -> dict[str, Any]:
    """Scores of a field in memory.

    Parameters
    ----------
    truth : Truth
    mean, sd : (X, Y, Z, 3) arrays
        mm, world RAS.
    defined : (X, Y, Z) array of booleans, optional
        Where the field is given; None is wherever the truth is valid.
    """
    defined = truth.valid if defined is None else defined
    given = truth.valid & defined
    error, size = np.linalg.norm(mean - truth.u, axis=-1), np.linalg.norm(truth.u, axis=-1)
    core = given & ndi.binary_erosion(defined)
    found = {
        "given_share": round(float(given.sum() / truth.valid.sum()), 4),
        "error": _lengths(error[given]),
        **{name: _lengths(error[given & (truth.labels == value)]) for name, value in TISSUES.items()},
        "moved_over_3mm": _lengths(error[given & (size > MOVED)]),
        "cavity_walls": None if truth.walls is None else _lengths(error[given & truth.walls]),
        "unregistered_mean": round(float(size[given].mean()), 3),
        "tre": _error_at_points(truth, mean, given),
        "folded_share": round(float((determinant(mean, truth.affine)[core] <= 0).mean()), 6),
    }
    return found if sd is None else found | _calibration((mean - truth.u)[given], sd[given])


def determinant(u: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """det(I + ∂u/∂x) at every voxel, by differences; u (X, Y, Z, 3) in mm, its grid along the axes of the world."""
    slope = np.stack(np.gradient(u, *nib.affines.voxel_sizes(affine), axis=(0, 1, 2)), axis=-1)
    return np.linalg.det(slope * np.sign(np.diag(affine)[:3]) + np.eye(3))


def _lengths(error: np.ndarray) -> list[float] | None:
    """Mean, 95 % and greatest."""
    if not error.size:
        return None
    return [round(float(value), 3) for value in (error.mean(), np.percentile(error, 95), error.max())]


def _error_at_points(truth: Truth, mean: np.ndarray, given: np.ndarray) -> list[float]:
    """Mean and greatest, of the points inside."""
    inverse = np.linalg.inv(truth.affine)
    at = (truth.fixed_points @ inverse[:3, :3].T + inverse[:3, 3]).T
    u = np.stack([ndi.map_coordinates(mean[..., i], at, order=1) for i in range(3)], axis=1)
    error = np.linalg.norm(truth.fixed_points + u - truth.moving_points, axis=1)
    inside = ndi.map_coordinates(given.astype(float), at, order=1) > 0.99
    return [round(float(value), 3) for value in (error[inside].mean(), error[inside].max())]


def _calibration(error: np.ndarray, sd: np.ndarray) -> dict[str, Any]:
    """Coverage and sharpness by component."""
    z = np.abs(error) / np.maximum(sd, 1e-9)
    return {
        "coverage_50_90_95": [round(float((z < norm.ppf(0.5 + level / 2)).mean()), 3) for level in LEVELS],
        "sd_over_rms_error": round(float(np.sqrt((sd**2).mean()) / np.sqrt((error**2).mean())), 3),
    }


def main() -> None:
    """Print the scores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pair", type=Path)
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--mean", type=Path)
    parser.add_argument("--sd", type=Path)
    parser.add_argument("--on", type=Path)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    if given.run is None and given.mean is None:
        parser.error("give the folder of a run, or --mean")
    sd = given.sd or (given.run and given.run / "displacement_sd.nii.gz")
    found = score(given.pair, given.mean or given.run / "displacement_mean.nii.gz", sd, given.on)
    print(json.dumps(found) if given.json else "\n".join(f"{name:18s} {value}" for name, value in found.items()))


if __name__ == "__main__":
    main()
