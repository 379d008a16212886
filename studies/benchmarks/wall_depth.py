"""How deep do the draws of a run lie in the soft wall of the skull?

    python -m studies.benchmarks.wall_depth RUN

The program counts the sampled nodes of every fifth draw. A depth is the distance to the surface of the skull, mm.
"""

from __future__ import annotations

import sys

import numpy as np

from bayesreg.distance import signed_distance
from bayesreg.inference.draws.inference_data import dataset
from bayesreg.report.slices import sample
from bayesreg.results.result import load_result

EVERY = 5
TOUCHING = 1.0  # mm


def main() -> None:
    """Print the share of the places behind the surface, and their depths."""
    result = load_result(sys.argv[1])
    draws = dataset(result.idata, "posterior")["u_boundary"].transpose("chain", "draw", "node", "axis")
    nodes = draws["node"].to_numpy().astype(int)
    displacements = draws.to_numpy()[:, ::EVERY].reshape(-1, len(nodes), 3)
    # Positive in front of the wall.
    distance = signed_distance(result.run.skull)
    height = np.array([sample(distance, result.run.mesh.points[nodes] + u) for u in displacements])
    depth = -height[height < 0]
    median, high, greatest = np.quantile(depth, [0.5, 0.95, 1.0])
    print(
        f"{np.mean(np.abs(height) < TOUCHING):.0%} of the places lie within {TOUCHING:g} mm of the wall, "
        f"{np.mean(height < 0):.1%} behind its surface; depth of these: median {median:.2f} mm, "
        f"95 % {high:.2f} mm, greatest {greatest:.2f} mm"
    )


if __name__ == "__main__":
    main()
