"""How many steps of the paper's kernel an effective draw costs, from the covariance of a converged run.

python tests/benchmarks/random_walk_ess.py RUN --acceptance 0.042 --steps-per-second 83 --chains 3

A chain of that kernel is too short to tell by itself. For a random walk with step variances D, acceptance a and
posterior covariance C, the effective sample size of entry i per step is a C_ii / (4 [C D⁻¹ C]_ii) (diffusion limit).
"""

import argparse
import json
from pathlib import Path

import numpy as np
import xarray as xr

STEPS = {"u_boundary": 0.008, "lam": 0.03, "mu": 0.003}


def ess_per_step(covariance, variances, acceptance):
    """Of every entry."""
    return acceptance * np.diag(covariance) / (4 * np.einsum("ij,j,ji->i", covariance, 1 / variances, covariance))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--acceptance", type=float, required=True, help="share of all proposals at the posterior")
    parser.add_argument("--steps-per-second", type=float, required=True, help="of one chain")
    parser.add_argument("--chains", type=int, default=3)
    given = parser.parse_args()
    draws = xr.open_dataset(given.run / "posterior.nc", group="posterior")
    flat = {name: draws[name].values.reshape(draws.sizes["chain"] * draws.sizes["draw"], -1) for name in STEPS}
    free = {name: values[:, np.ptp(values, axis=0) > 0] for name, values in flat.items()}
    variances = np.concatenate([np.full(free[name].shape[1], step**2) for name, step in STEPS.items()])
    covariance = np.cov(np.concatenate(list(free.values()), axis=1).T)
    ess = ess_per_step(covariance, variances, given.acceptance)
    print("steps per effective draw: median {:,.0f}, greatest {:,.0f}".format(*np.quantile(1 / ess, [0.5, 1.0])))
    manifest = json.loads((given.run / "run.json").read_text())
    least = ess.min() * given.steps_per_second * given.chains
    for kind in ("bulk", "tail"):
        found = manifest["convergence"][f"ess_{kind}_min"] / manifest["timings"]["sampling"]
        print(f"least {kind} ESS per second: {found:.3g} against {least:.3g}, {found / least:,.0f} times")


if __name__ == "__main__":
    main()
