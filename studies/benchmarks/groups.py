"""What a chain's density and gradient cost where so many chains run side by side: what `_TOGETHER` rests on.

    python -m studies.benchmarks.groups [--mesh 0.8k] [--chains 64] [--sizes 4 8 16 32 64]

The cubic problems of `studies.benchmarks.bench_evaluation`. All sizes one after the other, five times; the least of
five medians of nine.
"""

from __future__ import annotations

import argparse
from unittest import mock

import numpy as np

from bayesreg.inference.chains import devices
from studies.benchmarks.bench_evaluation import CHAINS, _places, _problem, program
from studies.benchmarks.bench_sampling import _median

PARTS, PASSES = ("density", "gradient", "solve", "similarity"), 5


def main() -> None:
    """Print a row for each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", choices=list(CHAINS), default="0.8k")
    parser.add_argument("--chains", type=int, default=64)
    parser.add_argument("--sizes", type=int, nargs="+", default=[4, 8, 16, 32, 64])
    given = parser.parse_args()
    problem, places = _problem(given.mesh, "cubic"), _places(given.mesh, "cubic", given.chains)
    calls = {}
    for size in given.sizes:
        with mock.patch.object(devices, "_TOGETHER", size):
            for part in PARTS:
                function, each = program(problem, places, part)
                calls[size, part] = function.lower(problem.data, *each).compile(), (problem.data, *each)
    passes = [[_median(function, *arguments) for function, arguments in calls.values()] for _ in range(PASSES)]
    least = 1e3 * np.min(passes, axis=0).reshape(len(given.sizes), -1) / given.chains
    print(f"{len(problem.posterior.mesh.points)} nodes, {given.chains} chains, ms a chain")
    print("| together | " + " | ".join(PARTS) + " |\n" + "|---" * (len(PARTS) + 1) + "|")
    for size, row in zip(given.sizes, least, strict=True):
        print(f"| {size} | " + " | ".join(f"{value:.2f}" for value in row) + " |")


if __name__ == "__main__":
    main()
