"""What is the least error of any uniform model inside, with the true displacement of the boundary?

`python -m studies.benchmarks.uniform_bound RUN` prints the mean squared error, mm², in Ω and in each tissue, of the
elastic equilibrium with one λ and one μ for the whole brain, at the best λ/μ. RUN is a run or a simulated pair with a
known truth. Without internal forces only λ/μ affects the equilibrium.
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
    """The least mean squared error, mm², and its λ/μ, for each region of the brain."""
    inputs = read_inputs(RunFolder(folder))
    mesh, truth = inputs.mesh, inputs.truth
    assert truth is not None
    u_true = np.asarray(truth.u)
    errors_by_ratio = []
    for ratio in RATIOS:
        settled = br.solve_interior(mesh, np.array([ratio]), np.array([1.0]), u_true[mesh.boundary])
        assert settled.converged
        errors_by_ratio.append(mean_squared_error(mesh, np.asarray(settled.u), u_true))
    return {
        region: min((errors[region], float(r)) for errors, r in zip(errors_by_ratio, RATIOS, strict=True))
        for region in errors_by_ratio[0]
    }


if __name__ == "__main__":
    for region, (error, ratio) in least_errors(Path(sys.argv[1])).items():
        print(f"{region}: {error:.3f} mm² at λ/μ = {ratio:.3g}")
