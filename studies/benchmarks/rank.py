"""Would a low-rank update of the prior do for Laplace's approximation? Eigenvalues of a finished run's curvature.

Those of the similarity's Gauss–Newton curvature in the displacements relative to the elastic prior's, at the run's last
draw: directions whose eigenvalue is far below one are left as the prior has them, the others make up the rank.

    python -m studies.benchmarks.rank RUN
"""

from __future__ import annotations

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import scipy.linalg

import bayesreg as br
from bayesreg.io import store
from bayesreg.io.run_folder import RunFolder
from bayesreg.model.blocks import Scale
from bayesreg.workflow.assembly import posterior_of


def eigenvalues(folder: Path) -> np.ndarray:
    """In descending order."""
    posterior = posterior_of(br.load_config(folder / "config.yaml"), store.read_inputs(RunFolder(folder)))
    draws = br.load_result(folder).idata.posterior
    known = posterior.reference()
    last = known | {name: jnp.asarray(draws[name].values[0, -1], float) for name in known if name in draws}
    estimands = posterior.estimands(last)
    without_images = posterior.data._replace(blocks={**posterior.data.blocks, "t_similarity": Scale(jnp.asarray(1e30))})
    both, prior = (
        posterior.target.mode_search.curvature(data, estimands).gauss_newton
        for data in (posterior.data, without_images)
    )
    # The prior leaves rigid motions free: a trace of the identity keeps it definite.
    held = prior + 1e-9 * np.trace(prior) / len(prior) * np.eye(len(prior))
    return scipy.linalg.eigh(both - prior, held, eigvals_only=True)[::-1]


def main() -> None:
    """Print how many there are, and how many exceed 1, 10 and 100."""
    found = eigenvalues(Path(sys.argv[1]))
    counts = ", ".join(f"{(found > bound).sum()} above {bound}" for bound in (1, 10, 100))
    print(f"{len(found)} eigenvalues, {counts}; least {found[-1]:.3g}, median {np.median(found):.3g}")


if __name__ == "__main__":
    main()
