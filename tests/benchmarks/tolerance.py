"""What the tolerance of a chain's solves costs and leaves: iterations, and the error of the log density.

At forty draws of a finished run, solves preconditioned at the mean of their λ, μ (as Normal scores), like chains'.

    python -m tests.benchmarks.tolerance RUN
"""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import bayesreg as br
from bayesreg.assembly import posterior_of
from bayesreg.io import store

DRAWS, TOLERANCES = 40, (1e-10, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4)


def main() -> None:
    """Print a line for each tolerance."""
    folder = Path(sys.argv[1])
    posterior = posterior_of(br.load_config(folder / "config.yaml"), store.read_inputs(folder))
    draws, known = br.load_result(folder).idata.posterior, posterior.reference()
    rng = np.random.default_rng(0)
    places = zip(
        rng.integers(draws.sizes["chain"], size=DRAWS), rng.integers(draws.sizes["draw"], size=DRAWS), strict=True
    )
    at = [{n: jnp.asarray(draws[n].values[place], float) for n in known if n in draws} for place in places]
    estimands = [posterior.estimands(known | values) for values in at]
    positions = [posterior.unconstrain_of(posterior.data, e) for e in estimands]
    middle = jax.tree.map(lambda *x: jnp.stack(x).mean(axis=0), *positions)
    data = posterior.conditioned(posterior.constrain_of(posterior.data, middle))
    evaluate = jax.jit(posterior.evaluate_estimands)

    def found(tolerance: float) -> tuple[np.ndarray, np.ndarray]:
        system = data.system._replace(tolerance=jnp.asarray(tolerance))
        evaluations = [evaluate(data._replace(system=system), e) for e in estimands]
        return np.array([(float(e.logdensity), int(e.solver_iterations)) for e in evaluations]).T

    exact, _ = found(1e-12)
    for tolerance in TOLERANCES:
        logdensity, iterations = found(tolerance)
        error = abs(logdensity - exact)
        print(
            f"{tolerance:.0e}: {iterations.mean():.1f} iterations, at most {iterations.max():.0f}; error of the log "
            f"density {np.sqrt((error**2).mean()):.2g} (rms), {error.max():.2g} at most"
        )


if __name__ == "__main__":
    main()
