"""From how many unknowns on the multigrid hierarchy beats the dense inverse: what `DENSE_LIMIT` rests on.

    python -m studies.benchmarks.preconditioners [--nodes 800 1500 2500 4000 5500] [--chains 4 16]

A ball of three shells; each chain has λ and μ of its own, scattered about the reference by a factor of 1.35, and
displacements of the boundary at random. Solves end where those of chains do. Medians of nine.
"""

from __future__ import annotations

import argparse
import time
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.fem import preconditioners
from bayesreg.fem.conjugate_gradients import ElasticSystem
from bayesreg.fem.elasticity import lame_by_cell
from bayesreg.fem.equilibrium import elastic_system, equilibrium
from bayesreg.mesh import TetMesh
from bayesreg.model.conditioning import CHAIN_TOLERANCE
from studies.benchmarks.bench_sampling import _median
from studies.benchmarks.places import SPREAD
from studies.benchmarks.solves import mesh_of
from tests.phantoms import LAM, MU

WAYS = {"dense": 10**9, "multigrid": 0}


def main() -> None:
    """Print a row for each mesh and number of chains."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, nargs="+", default=[800, 1500, 2500, 4000, 5500])
    parser.add_argument("--chains", type=int, nargs="+", default=[4, 16])
    given = parser.parse_args()
    print("| nodes | unknowns | set-up, s, dense / multigrid | chains | iterations | solve, ms |")
    print("|---|---|---|---|---|---|")
    for nodes in given.nodes:
        compare(mesh_of(nodes), given.chains)


def compare(mesh: TetMesh, numbers: list[int]) -> None:
    """One mesh, both ways."""
    made = {way: _made(mesh, limit) for way, limit in WAYS.items()}
    setup = " / ".join(f"{seconds:.1f}" for _, seconds in made.values())
    for chains in numbers:
        rng = np.random.default_rng(0)
        lam, mu = (values * np.exp(SPREAD * rng.normal(size=(chains, 3))) for values in (LAM, MU))
        by_cell = [jax.vmap(lambda x: lame_by_cell(x, mesh))(jnp.asarray(x)) for x in (lam, mu)]
        u = jnp.asarray(rng.normal(size=(chains, len(mesh.boundary), 3)))
        many = jax.jit(jax.vmap(equilibrium, in_axes=(None, 0, 0, 0)))
        found = {way: many(system, *by_cell, u) for way, (system, _) in made.items()}
        assert np.allclose(*(state.u for state in found.values()), atol=1e-3)
        times = [1e3 * _median(many, system, *by_cell, u) for system, _ in made.values()]
        iterations = " / ".join(f"{float(state.iterations.mean()):.1f}" for state in found.values())
        print(
            f"| {len(mesh.points):,} | {3 * len(mesh.interior):,} | {setup} | {chains} | {iterations} | "
            f"{times[0]:.1f} / {times[1]:.1f} |",
            flush=True,
        )


def _made(mesh: TetMesh, limit: int) -> tuple[ElasticSystem, float]:
    began = time.perf_counter()
    with mock.patch.object(preconditioners, "DENSE_LIMIT", limit):
        system = elastic_system(mesh, mesh.boundary, LAM, MU, CHAIN_TOLERANCE)
    return jax.block_until_ready(system), time.perf_counter() - began


if __name__ == "__main__":
    main()
