"""How does the cost of a density and of a gradient depend on the chains in a group? `_TOGETHER` rests on the answer.

    python -m studies.benchmarks.groups [--mesh 0.8k] [--chains 64] [--sizes 4 8 16 32 64]

The problems are the cubic ones of `studies.benchmarks.bench_evaluation`. All sizes are timed in turn, in five passes;
the table shows the least of five medians of nine.
"""

from __future__ import annotations

import argparse
from unittest import mock

import numpy as np

from bayesreg.inference.chains import devices
from studies.benchmarks.bench_evaluation import CHAINS, _places, _problem, program
from studies.benchmarks.bench_sampling import _median

OPERATIONS, PASSES = ("density", "gradient", "solve", "similarity"), 5


def main() -> None:
    """Print a row for each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", choices=list(CHAINS), default="0.8k")
    parser.add_argument("--chains", type=int, default=64)
    parser.add_argument("--sizes", type=int, nargs="+", default=[4, 8, 16, 32, 64])
    options = parser.parse_args()
    problem, places = _problem(options.mesh, "cubic"), _places(options.mesh, "cubic", options.chains)
    calls = {}
    for size in options.sizes:
        with mock.patch.object(devices, "_TOGETHER", size):
            for operation in OPERATIONS:
                function, each = program(problem, places, operation)
                calls[size, operation] = function.lower(problem.data, *each).compile(), (problem.data, *each)
    passes = [[_median(function, *arguments) for function, arguments in calls.values()] for _ in range(PASSES)]
    least = 1e3 * np.min(passes, axis=0).reshape(len(options.sizes), -1) / options.chains
    print(f"{len(problem.posterior.mesh.points)} nodes, {options.chains} chains, ms a chain")
    print("| together | " + " | ".join(OPERATIONS) + " |\n" + "|---" * (len(OPERATIONS) + 1) + "|")
    for size, row in zip(options.sizes, least, strict=True):
        print(f"| {size} | " + " | ".join(f"{value:.2f}" for value in row) + " |")


if __name__ == "__main__":
    main()
