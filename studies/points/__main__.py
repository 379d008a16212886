"""How well do points of real patients predict other points, and do the predicted regions hold?

    python -m studies.points DATA [SET …] [-o OUT]

DATA is a folder with `dirlab/case*.csv` (DIR-Lab 4DCT, 300 pairs a patient; Castillo et al. 2009) and `gel/beads.csv`
(beads in a hydrogel, µm; Yang et al. 2022). A SET is the name of a file such as case1 or beads; the default is all.
DIR-Lab: 100 pairs at random are data and 200 are held out, three times. Gel: 400 are data and 5,000 held out.

bayesreg gets the points and a mask, the convex hull of all points of the set, and no other option. The table shows for
each method the mean, median and 95 % error at the held-out points, the share of them in the predicted 50, 90 and 95 %
regions, the root mean square of the predicted sd, and the seconds. OUT, by default runs/points, keeps finished steps.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_dilation
from scipy.spatial import Delaunay

import bayesreg as br
from bayesreg.fem.location import nearest_places
from bayesreg.io.points import read_point_pairs
from bayesreg.model.observations.landmarks import STRAIN
from bayesreg.model.observations.landmarks_report import region_probability
from bayesreg.results.nodal_draws import transform_of
from bayesreg.results.transform import Transform
from studies.points.peers import METHODS, Points, Predicted

LEVELS = (0.5, 0.9, 0.95)
# The number of voxels along the longest side of a mask, and the voxels by which it is wider than the hull.
VOXELS, MARGIN = 80, 2
# Status 3 means that the run wrote its results but did not converge.
WRITTEN = (0, 3)


class Split(NamedTuple):
    """Pairs of points, of which some are data and others held out."""

    name: str
    fixed: Points
    shift: Points
    data: np.ndarray
    held_out: np.ndarray


def splits_of(path: Path) -> Iterator[Split]:
    """Split a file at random: 100 of 300 pairs three times, or 400 of many once."""
    pairs = read_point_pairs(path)
    many = len(pairs.fixed) > 1000
    for seed in range(1 if many else 3):
        order = np.random.default_rng(seed).permutation(len(pairs.fixed))
        data, held_out = (order[:400], order[400:5400]) if many else (order[:100], order[100:])
        yield Split(f"{path.stem}-{seed}", pairs.fixed, pairs.moving - pairs.fixed, data, held_out)


def mask_of(points: Points) -> br.Image:
    """Make a mask of the convex hull of points."""
    size = np.ptp(points, axis=0).max() / VOXELS
    low = points.min(axis=0) - (MARGIN + 2) * size
    shape = np.ceil((points.max(axis=0) - low) / size).astype(int) + MARGIN + 3
    affine = np.diag([size, size, size, 1.0])
    affine[:3, 3] = low
    grid = br.Image(np.zeros(shape), affine)
    inside = Delaunay(points).find_simplex(grid.grid_points().reshape(-1, 3)).reshape(shape) >= 0
    return grid.with_voxels(binary_dilation(inside, iterations=MARGIN).astype(np.uint8))


def register(split: Split, folder: Path) -> tuple[Predicted, Float[np.ndarray, "k 3 3"], dict[str, Any]]:
    """Run bayesreg as a new user would; return its prediction at the held-out points with its covariance."""
    folder.mkdir(parents=True, exist_ok=True)
    run, record = folder / "run", folder / "seconds.json"
    if not record.exists():
        br.save_image(mask_of(split.fixed), folder / "mask.nii.gz")
        rows = np.c_[split.fixed, split.fixed + split.shift][split.data]
        header = "fixed_x,fixed_y,fixed_z,moving_x,moving_y,moving_z"
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
            raise SystemExit(f"{split.name}: status {status}, see {folder / 'log.txt'}")
        record.write_text(json.dumps({"seconds": time.perf_counter() - began}), encoding="utf-8")
    result = br.load_result(run)
    transform = transform_of(result)
    places, _ = transform.place(split.fixed[split.held_out])
    posterior = result.idata.posterior
    sd = [float(np.sqrt((posterior[name] ** 2).mean())) for name in posterior if str(name).startswith("landmarks_sd")]
    # Errors of Student's t with ν = 4 have twice the variance of their scale.
    covariance = covariance_near(transform, split.fixed[split.held_out]) + 2 * np.diag(
        np.broadcast_to(np.square(sd), 3)
    )
    facts = {
        "seconds": json.loads(record.read_text(encoding="utf-8"))["seconds"],
        "converged": result.converged,
        "sd": sd,
        "reason": result.run.manifest["stopped"]["reason"],
    }
    return Predicted(places - split.fixed[split.held_out]), covariance, facts


def covariance_near(transform: Transform, points: Points) -> Float[np.ndarray, "k 3 3"]:
    """Compute the covariance of the displacement of points, mm²; around the mesh as that of landmarks that are data."""
    nodes, weights, distance = nearest_places(transform.mesh, points)
    inward = 0.999 * np.asarray(weights) + 0.001 / 4
    nearest = np.einsum("ka,kai->ki", inward, transform.mesh.points[nodes])
    return transform.covariance(transform.deformer.locate(nearest)) + (STRAIN * distance[:, None, None]) ** 2 * np.eye(
        3
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("sets", nargs="*")
    parser.add_argument("-o", "--out", type=Path, default=Path("runs/points"))
    parser.add_argument("--splits", type=int, default=3)
    arguments = parser.parse_args()
    paths = sorted([*arguments.data.glob("dirlab/*.csv"), *arguments.data.glob("gel/*.csv")])
    for path in paths:
        if arguments.sets and path.stem not in arguments.sets:
            continue
        for split in list(splits_of(path))[: arguments.splits]:
            truth = split.shift[split.held_out]
            for name, method in METHODS.items():
                began = time.perf_counter()
                predicted = method(split.fixed[split.data], split.shift[split.data], split.fixed[split.held_out])
                covariance = None if predicted.variance is None else predicted.variance[:, :, None] * np.eye(3)
                print(describe(split.name, name, truth, predicted, covariance, time.perf_counter() - began), flush=True)
            predicted, covariance, facts = register(split, arguments.out / split.name)
            line = describe(split.name, "bayesreg", truth, predicted, covariance, facts["seconds"])
            print(line, facts["converged"], facts["sd"], facts["reason"], flush=True)


def describe(
    split: str,
    method: str,
    truth: Points,
    predicted: Predicted,
    covariance: Float[np.ndarray, "k 3 3"] | None,
    seconds: float,
) -> str:
    """Make a row of the table."""
    away = truth - predicted.mean
    error = np.linalg.norm(away, axis=1)
    shares, sd = "", ""
    if covariance is not None:
        inside = region_probability(away, covariance)
        shares = " / ".join(f"{(inside <= level).mean():.1%}" for level in LEVELS)
        sd = f"{np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean()):.2f}"
    errors = [f"{value:.2f}" for value in (error.mean(), np.median(error), np.quantile(error, 0.95))]
    return f"| {' | '.join([split, method, *errors, shares, sd, f'{seconds:.0f}'])} |"


if __name__ == "__main__":
    main()
