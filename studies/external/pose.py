"""How often do the intervals of a pose contain the truth of a rigid pair?

    BAYESREG_DATA=… python -m studies.external.pose -o runs/pose [--seeds 20] [--millimetres 20] [--degrees 15]

Two scans of Colin27 are simulated. Cubic splines turn and shift the second one on its voxel grid, so that its header
does not tell the motion. Each has noise of 0.03 of the intensity of white matter. `bayesreg.run` gets both files,
labels, mask and one coarse mesh for all pairs. The truth has six numbers for each seed. The program counts those inside
the central 50, 90 and 95 % of the draws of the rigid motion.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
from scipy import ndimage as ndi

import bayesreg as br
from bayesreg.config import make_config
from bayesreg.pose import Motion, Pose
from studies.external.make_pair import GLIA, GM, WHITE, data_folder, read_anatomy

NOISE = 0.03
LEVELS = (0.5, 0.9, 0.95)
SETTINGS = ("mesh.edge_length=30.0", "observations=[{kind: images, most_points: 30000}]", "stop.max_minutes=3.0")


def rigid_motion(seed: int, millimetres: float, degrees: float, centre: np.ndarray) -> np.ndarray:
    """A rigid motion, (4, 4) in mm, about a centre, with a random axis and a random shift."""
    axis, shift = (way / np.linalg.norm(way) for way in np.random.default_rng(seed).normal(size=(2, 3)))
    return np.asarray(Motion(millimetres * shift, degrees * axis).pose(centre).matrix)


def write_pair(out: Path, data: Path, seed: int, millimetres: float, degrees: float) -> np.ndarray:
    """Write the files of a pair, and return its rigid motion."""
    rng, anatomy = np.random.default_rng(1000 + seed), read_anatomy(data)
    t1, affine = anatomy.t1, anatomy.affine
    centre = anatomy.world(np.argwhere(anatomy.hull)).mean(axis=0)
    motion = rigid_motion(seed, millimetres, degrees, centre)
    # The place in the first scan of each voxel of the second: X = T x.
    inverse = np.linalg.inv(affine) @ np.linalg.inv(motion) @ affine
    moved = ndi.affine_transform(t1, inverse[:3, :3], inverse[:3, 3], order=3, mode="nearest")
    tissues = np.where(anatomy.labels == GLIA, GM, anatomy.labels) * anatomy.intracranial
    out.mkdir(parents=True, exist_ok=True)
    for name, voxels in {
        "fixed": (t1 + NOISE * WHITE * rng.normal(size=t1.shape)).astype(np.float32),
        "moving": (moved + NOISE * WHITE * rng.normal(size=t1.shape)).astype(np.float32),
        "labels": tissues.astype(np.uint8),
        "intracranial": anatomy.intracranial.astype(np.uint8),
    }.items():
        nib.save(nib.Nifti1Image(voxels, affine), out / f"{name}.nii.gz")
    return motion


def register(out: Path, data: Path, seed: int, millimetres: float, degrees: float, mesh: Path) -> dict[str, Any]:
    """Register a pair; return the error, mm, and the rank of each of the six numbers among its draws."""
    folder = out / f"pair{seed}"
    motion = write_pair(folder, data, seed, millimetres, degrees)
    names = ("fixed", "moving", "labels", "intracranial")
    files = {name: str((folder / f"{name}.nii.gz").absolute()) for name in names}
    mesh_option = [f"mesh.file={mesh.absolute()}"] if mesh.exists() else []
    table = {"csf": [1], "gm": [2], "wm": [3]}
    config = make_config({"data": {"source": "files", "label_table": table, **files}}, [*SETTINGS, *mesh_option])
    result = br.run(config, out / f"run{seed}", progress=False)
    if not mesh.exists():
        mesh.write_bytes((out / f"run{seed}" / "mesh.vtu").read_bytes())
    run = result.run
    truth = np.concatenate(Pose(motion).about(np.asarray(run.predicted.centre)))
    draws = np.asarray(run.predicted.motion).reshape(-1, 6)
    total = run.matching.pose.displacement(run.mesh.points, run.u_mean)
    error = np.linalg.norm(run.mesh.points + total - Pose(motion).place(run.mesh.points), axis=1)
    return {
        "seed": seed,
        "error": float(np.average(error, weights=run.mesh.nodal_volumes)),
        "off": (draws.mean(axis=0) - truth).tolist(),
        "sd": draws.std(axis=0).tolist(),
        "rank": (draws < truth).mean(axis=0).tolist(),
        "converged": result.converged,
    }


def main() -> None:
    """Register the pairs that are not finished, and print the coverage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--millimetres", type=float, default=20.0)
    parser.add_argument("--degrees", type=float, default=15.0)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    results = []
    for seed in range(1, arguments.seeds + 1):
        path = arguments.out / f"{seed}.json"
        if not path.exists():
            result = register(
                arguments.out, data_folder(), seed, arguments.millimetres, arguments.degrees, arguments.out / "mesh.vtu"
            )
            path.write_text(json.dumps(result))
        results.append(json.loads(path.read_text()))
        print(json.dumps(results[-1]), flush=True)
    ranks = np.array([result["rank"] for result in results])
    for level in LEVELS:
        inside = np.abs(ranks - 0.5) < level / 2
        print(f"inside {level:.0%}: {inside.sum()} of {inside.size}")
    print(f"mean error {np.mean([result['error'] for result in results]):.3f} mm")


if __name__ == "__main__":
    main()
