"""How well do points of real patients predict other points, and do the predicted regions hold?

    python -m studies.points DATA [SET …] [--refit SET …] [-o OUT]

DATA is a folder with `dirlab/case*.csv` (DIR-Lab 4DCT, 300 pairs a patient; Castillo et al. 2009), `gel/beads.csv`
(beads in a hydrogel, µm; Yang et al. 2022), and, in it or beside it, `resect/Case*.tag` (RESECT, some 15 pairs of the
MRI and the ultrasound of a brain before the resection of a tumour; Xiao et al. 2017). A SET is the name of a file such
as case1, beads, or resect1 for Case1 of RESECT; the default is all. DIR-Lab: 100 pairs at random are data and 200 are
held out, three times. Gel: 400 are data and 5,000 held out. RESECT: each pair is predicted by the others.

bayesreg gets the points and a mask, the convex hull of all points of the set with a margin, and no other option. The
table shows for each method the mean, median and 95 % error at the held-out points, the share of them in the predicted
50, 90 and 95 % regions, the root mean square of the predicted sd, and the seconds. On RESECT, bayesreg runs once with
all points, and its report predicts each by the others; --refit also samples without each point of these patients. OUT,
by default runs/points, keeps finished runs.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayesreg.fem.location import nearest_places
from bayesreg.io.points import read_point_pairs
from bayesreg.model.observations.landmarks import ROBUST, STRAIN
from bayesreg.model.observations.landmarks_report import region_probability
from bayesreg.results.nodal_draws import transform_of
from bayesreg.results.transform import Transform
from studies.points.left_out import compare
from studies.points.peers import METHODS, Points
from studies.points.runs import mask_of, register
from studies.points.table import Errors, describe, errors_of, pool

# The margin about the points of a lung or a gel, in units of their greatest extent.
MARGIN = 1 / 40


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


def predict(split: Split, folder: Path) -> Errors:
    """Run bayesreg, and predict the held-out points."""
    mask = mask_of(split.fixed, MARGIN * float(np.ptp(split.fixed, axis=0).max()))
    result, seconds = register(split.fixed[split.data], split.shift[split.data], mask, folder)
    transform, points = transform_of(result), split.fixed[split.held_out]
    places, _ = transform.place(points)
    posterior = result.idata.posterior
    squares = [float((posterior[name] ** 2).mean()) for name in posterior if str(name).startswith("landmarks_sd")]
    own = ROBUST.variance * np.diag(np.broadcast_to(squares, 3))
    away, covariance = split.shift[split.held_out] - (places - points), covariance_near(transform, points) + own
    print(split.name, result.converged, np.sqrt(squares), result.run.manifest["stopped"]["reason"], flush=True)
    return Errors(away, covariance, region_probability(away, covariance), seconds)


def covariance_near(transform: Transform, points: Points) -> Float[np.ndarray, "k 3 3"]:
    """Compute the covariance of the displacement of points, mm²; around the mesh as that of landmarks that are data."""
    nodes, weights, distance = nearest_places(transform.mesh, points)
    inward = 0.999 * np.asarray(weights) + 0.001 / 4
    nearest = np.einsum("ka,kai->ki", inward, transform.mesh.points[nodes])
    return transform.covariance(transform.deformer.locate(nearest)) + (STRAIN * distance[:, None, None]) ** 2 * np.eye(
        3
    )


def hold_out(path: Path, out: Path, splits: int) -> None:
    """Print the rows of a lung or of the gel."""
    for split in list(splits_of(path))[:splits]:
        truth = split.shift[split.held_out]
        for name, method in METHODS.items():
            began = time.perf_counter()
            predicted = method(split.fixed[split.data], split.shift[split.data], split.fixed[split.held_out])
            print(describe(split.name, name, errors_of(predicted, truth, time.perf_counter() - began)), flush=True)
        print(describe(split.name, "bayesreg", predict(split, out / split.name)), flush=True)


def leave_out_each(paths: dict[str, Path], out: Path, refits: Sequence[str]) -> None:
    """Print the rows of the patients of RESECT, and of all of them together."""
    by_method: dict[str, list[Errors]] = defaultdict(list)
    for name, path in paths.items():
        for method, errors in compare(path, out / name, name in refits):
            print(describe(name, method, errors), flush=True)
            by_method[method].append(errors)
    for method, parts in by_method.items():
        print(describe(f"RESECT ({len(parts)})", method, pool(parts)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("sets", nargs="*")
    parser.add_argument("-o", "--out", type=Path, default=Path("runs/points"))
    parser.add_argument("--splits", type=int, default=3)
    parser.add_argument("--refit", nargs="*", default=())
    arguments = parser.parse_args()
    data, chosen = arguments.data, arguments.sets
    for path in sorted([*data.glob("dirlab/*.csv"), *data.glob("gel/*.csv")]):
        if not chosen or path.stem in chosen:
            hold_out(path, arguments.out, arguments.splits)
    tags = sorted([*data.glob("resect/*.tag"), *data.glob("../resect/*.tag")])
    patients = {path.stem.split("-")[0].lower().replace("case", "resect"): path for path in tags}
    leave_out_each({n: p for n, p in patients.items() if not chosen or n in chosen}, arguments.out, arguments.refit)


if __name__ == "__main__":
    main()
