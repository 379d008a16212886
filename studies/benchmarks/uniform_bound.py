"""What any uniform model leaves inside, were the true displacement of the boundary given to it.

`python -m studies.benchmarks.uniform_bound RUN` prints the mean squared error in Ω and each tissue, mm², of the elastic
equilibrium of one λ and one μ for the whole brain, at the λ/μ that leave least; RUN is a run or a simulated pair with
a known truth. With no internal forces nothing but λ/μ matters.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import bayesreg as br
from bayesreg.io.run_folder import RunFolder
from bayesreg.io.store import read_inputs
from bayesreg.report.metrics import mean_squared_error

RATIOS = np.concatenate([[0.0], np.geomspace(0.1, 1000, 41)])


def least_errors(folder: Path) -> dict[str, tuple[float, float]]:
    """By part of the brain the least mean squared error, mm², and the λ/μ that leaves it."""
    inputs = read_inputs(RunFolder(folder))
    mesh, truth = inputs.mesh, inputs.truth
    assert truth is not None
    u_true = np.asarray(truth.u)
    found = []
    for ratio in RATIOS:
        settled = br.solve_interior(mesh, np.array([ratio]), np.array([1.0]), u_true[mesh.boundary])
        assert settled.converged
        found.append(mean_squared_error(mesh, np.asarray(settled.u), u_true))
    return {part: min((errors[part], float(r)) for errors, r in zip(found, RATIOS, strict=True)) for part in found[0]}


if __name__ == "__main__":
    for part, (error, ratio) in least_errors(Path(sys.argv[1])).items():
        print(f"{part}: {error:.3f} mm² at λ/μ = {ratio:.3g}")
