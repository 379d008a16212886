"""How often do the ellipsoids of `bayesreg apply`, and those of the draws alone, contain the points of a pair?

    python -m studies.external.points PAIR RUN

PAIR is a folder of `studies.external.make_pair`. The run did not use its points.csv.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from bayesreg.io.points import read_point_pairs
from bayesreg.model.observations.landmarks_report import region_probability
from bayesreg.results.nodal_draws import transform_of
from bayesreg.results.result import load_result

LEVELS = (0.5, 0.9, 0.95)


def main() -> None:
    pair, run = map(Path, sys.argv[1:3])
    points, transform = read_point_pairs(pair / "points.csv"), transform_of(load_result(run))
    places, near = transform.place(points.fixed)
    # The errors are along the axes of the world of the fixed image, as the covariance of u.
    away = (points.moving - places) @ transform.pose.rotation
    covariance = transform.covariance(near)
    added = transform.unresolved.covariance_at(near.cell, near.barycentric)
    drawn = covariance - added - transform.averaged_sd(near)[:, :, None] ** 2 * np.eye(3)
    print(f"{len(places)} points, mean error {np.linalg.norm(away, axis=1).mean():.3f} mm")
    for name, matrix in {"ellipsoids of points.csv": covariance, "of the draws alone": drawn}.items():
        inside = region_probability(away, matrix)
        print(name, *(f"{(inside <= level).mean():.0%} in the {level:.0%}" for level in LEVELS), sep="  ")


if __name__ == "__main__":
    main()
