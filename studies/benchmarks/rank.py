"""Is a low-rank update of the prior enough for Laplace's approximation?

The program computes the eigenvalues of the similarity's Gauss–Newton curvature in the displacements, relative to that
of the elastic prior, at the last draw of a run. Directions with an eigenvalue far below one keep the curvature of the
prior; the number of the others is the rank.

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
    """The relative eigenvalues in descending order."""
    posterior = posterior_of(br.load_config(folder / "config.yaml"), store.read_inputs(RunFolder(folder)))
    draws = br.load_result(folder).idata.posterior
    reference = posterior.reference()
    last = reference | {name: jnp.asarray(draws[name].values[0, -1], float) for name in reference if name in draws}
    estimands = posterior.estimands(last)
    without_images = posterior.data._replace(blocks={**posterior.data.blocks, "t_similarity": Scale(jnp.asarray(1e30))})
    both, prior = (
        posterior.target.mode_search.curvature(data, estimands).gauss_newton
        for data in (posterior.data, without_images)
    )
    # The prior leaves rigid motions free; a small multiple of the identity makes it definite.
    definite = prior + 1e-9 * np.trace(prior) / len(prior) * np.eye(len(prior))
    return scipy.linalg.eigh(both - prior, definite, eigvals_only=True)[::-1]


def main() -> None:
    """Print the number of eigenvalues, and the numbers above 1, 10 and 100."""
    spectrum = eigenvalues(Path(sys.argv[1]))
    counts = ", ".join(f"{(spectrum > bound).sum()} above {bound}" for bound in (1, 10, 100))
    print(f"{len(spectrum)} eigenvalues, {counts}; least {spectrum[-1]:.3g}, median {np.median(spectrum):.3g}")


if __name__ == "__main__":
    main()
