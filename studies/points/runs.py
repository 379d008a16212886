"""Runs of bayesreg on pairs of points and a mask, as a new user would start them."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import Delaunay

import bayesreg as br
from bayesreg.results.result import Result
from studies.points.peers import Points

# The number of voxels along the longest side of a mask.
VOXELS = 80
# Status 3 means that the run wrote its results but did not converge.
WRITTEN = (0, 3)


def mask_of(points: Points, margin: float) -> br.Image:
    """Make a mask of all places that lie no further than a margin, mm, from the convex hull of points."""
    size = (np.ptp(points, axis=0).max() + 2 * margin) / VOXELS
    low = points.min(axis=0) - margin - 2 * size
    shape = np.ceil((points.max(axis=0) + margin - low) / size).astype(int) + 3
    affine = np.diag([size, size, size, 1.0])
    affine[:3, 3] = low
    grid = br.Image(np.zeros(shape), affine)
    inside = Delaunay(points).find_simplex(grid.grid_points().reshape(-1, 3)).reshape(shape) >= 0
    return grid.with_voxels((size * distance_transform_edt(~inside) <= margin).astype(np.uint8))


def register(fixed: Points, shift: Points, mask: br.Image, folder: Path) -> tuple[Result, float]:
    """Run bayesreg in a folder, or go on there; return its result, and the seconds of the whole command."""
    folder.mkdir(parents=True, exist_ok=True)
    run, record = folder / "run", folder / "seconds.json"
    if not record.exists():
        br.save_image(mask, folder / "mask.nii.gz")
        header = "fixed_x,fixed_y,fixed_z,moving_x,moving_y,moving_z"
        rows = np.c_[fixed, fixed + shift]
        np.savetxt(folder / "pairs.csv", rows, fmt="%.6f", delimiter=",", header=header, comments="")
        configuration = {
            "data": {"source": "files", "labels": "mask.nii.gz", "label_table": {"organ": 1}},
            "observations": [{"kind": "landmarks", "file": "pairs.csv"}],
        }
        (folder / "run.yaml").write_text(json.dumps(configuration), encoding="utf-8")
        began = time.perf_counter()
        command = [Path(sys.executable).parent / "bayesreg", "run", folder / "run.yaml", "-o", run, "--resume"]
        with (folder / "log.txt").open("w", encoding="utf-8") as log:
            status = subprocess.run(command, stdout=log, stderr=log, check=False).returncode
        if status not in WRITTEN:
            raise SystemExit(f"{folder.name}: status {status}, see {folder / 'log.txt'}")
        record.write_text(json.dumps({"seconds": time.perf_counter() - began}), encoding="utf-8")
    return br.load_result(run), json.loads(record.read_text(encoding="utf-8"))["seconds"]
