"""How do iterations and the error of the log density depend on the tolerance of a chain's solves?

The program evaluates the density at forty draws of a finished run, with the preconditioner at the mean of their λ and μ
(as Normal scores), as in chains. With --again it repeats the run on the same mesh with a tolerance a hundred times
smaller, and compares the two posteriors: it prints differences of the mean and the standard deviation of every
estimand, over their Monte Carlo error.

    python -m studies.benchmarks.tolerance RUN [--again OUT]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from unittest import mock

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np

import bayesreg as br
from bayesreg.inference.target import estimands_of
from bayesreg.io import store
from bayesreg.io.run_folder import RunFolder
from bayesreg.model import conditioning
from bayesreg.workflow.assembly import posterior_of
from bayesreg.workflow.run import Result

DRAWS, TOLERANCES = 40, (1e-10, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4)


def main() -> None:
    """Print a line for each tolerance, and the differences of the posteriors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--again", type=Path, metavar="OUT", help="folder for the run with tighter solves")
    arguments = parser.parse_args()
    compare_tolerances(arguments.run)
    if arguments.again is not None:
        compare(br.load_result(arguments.run), tightened(arguments.run, arguments.again))


def tightened(folder: Path, out: Path) -> Result:
    """Repeat the run with a tolerance that is a hundred times smaller."""
    config = br.load_config(folder / "config.yaml", [f"mesh.file={(folder / 'mesh.vtu').absolute()}"])
    with mock.patch.object(conditioning, "CHAIN_TOLERANCE", conditioning.CHAIN_TOLERANCE / 100):
        return br.run(config, out)


def compare(first: Result, second: Result) -> None:
    """Print the differences between two posteriors."""
    means = [result.run.manifest["solver"]["iterations_mean"] for result in (first, second)]
    print(f"{means[0]:.1f} and {means[1]:.1f} iterations")
    for kind in ("mean", "std"):
        distances = []
        for name in ("u_boundary", "lam", "mu"):
            draws = [result.idata.posterior[name].astype(float) for result in (first, second)]
            value = [getattr(each, kind)(("chain", "draw")).values for each in draws]
            error = [az.mcse(each.to_dataset(), method="sd" if kind == "std" else kind)[name].values for each in draws]
            with np.errstate(invalid="ignore"):
                distances.append(((value[0] - value[1]) / np.hypot(*error)).ravel())
        differences = np.concatenate(distances)
        differences = abs(differences[np.isfinite(differences)])
        middle, most = np.median(differences), differences.max()
        print(f"{kind} of {len(differences)} estimands: {middle:.2f} Monte Carlo errors apart, {most:.2f} at most")


def compare_tolerances(folder: Path) -> None:
    """Print the iterations and the error for each tolerance."""
    posterior = posterior_of(br.load_config(folder / "config.yaml"), store.read_inputs(RunFolder(folder)))
    draws, reference = br.load_result(folder).idata.posterior, posterior.reference()
    rng = np.random.default_rng(0)
    places = zip(
        rng.integers(draws.sizes["chain"], size=DRAWS), rng.integers(draws.sizes["draw"], size=DRAWS), strict=True
    )
    sampled_values = [
        {n: jnp.asarray(draws[n].values[place], float) for n in reference if n in draws} for place in places
    ]
    estimands = [posterior.estimands(reference | values) for values in sampled_values]
    positions = [posterior.target.coordinates.unconstrain(posterior.data, e) for e in estimands]
    middle = jax.tree.map(lambda *x: jnp.stack(x).mean(axis=0), *positions)
    data = posterior.target.condition(estimands_of(posterior.target, posterior.data, middle))
    evaluate = jax.jit(posterior.target.evaluate_estimands)

    def evaluated(tolerance: float) -> tuple[np.ndarray, np.ndarray]:
        system = data.body.system._replace(tolerance=jnp.asarray(tolerance))
        tight = data._replace(body=data.body._replace(system=system))
        evaluations = [evaluate(tight, e) for e in estimands]
        return np.array([(float(e.logdensity), int(e.solver_iterations)) for e in evaluations]).T

    exact, _ = evaluated(1e-12)
    for tolerance in TOLERANCES:
        logdensity, iterations = evaluated(tolerance)
        error = abs(logdensity - exact)
        print(
            f"{tolerance:.0e}: {iterations.mean():.1f} iterations, at most {iterations.max():.0f}; error of the log "
            f"density {np.sqrt((error**2).mean()):.2g} (rms), {error.max():.2g} at most"
        )


if __name__ == "__main__":
    main()
