"""From how many unknowns on does the multigrid hierarchy beat the dense inverse? `DENSE_LIMIT` rests on the answer.

    python -m studies.benchmarks.preconditioners [--nodes 800 1500 2500 4000 5500] [--chains 4 16]

The mesh is a ball of three shells. λ and μ of each chain are scattered about the reference by a factor of 1.35, and the
displacements of the boundary are random. Solves have the tolerance of chains. Times are medians of nine.
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
    arguments = parser.parse_args()
    print("| nodes | unknowns | set-up, s, dense / multigrid | chains | iterations | solve, ms |")
    print("|---|---|---|---|---|---|")
    for nodes in arguments.nodes:
        compare(mesh_of(nodes), arguments.chains)


def compare(mesh: TetMesh, numbers: list[int]) -> None:
    """Time both preconditioners on one mesh."""
    systems = {way: _timed_system(mesh, limit) for way, limit in WAYS.items()}
    setup = " / ".join(f"{seconds:.1f}" for _, seconds in systems.values())
    for chains in numbers:
        rng = np.random.default_rng(0)
        lam, mu = (values * np.exp(SPREAD * rng.normal(size=(chains, 3))) for values in (LAM, MU))
        by_cell = [jax.vmap(lambda x: lame_by_cell(x, mesh))(jnp.asarray(x)) for x in (lam, mu)]
        u = jnp.asarray(rng.normal(size=(chains, len(mesh.boundary), 3)))
        solve = jax.jit(jax.vmap(equilibrium, in_axes=(None, 0, 0, 0)))
        states = {way: solve(system, *by_cell, u) for way, (system, _) in systems.items()}
        assert np.allclose(*(state.u for state in states.values()), atol=1e-3)
        times = [1e3 * _median(solve, system, *by_cell, u) for system, _ in systems.values()]
        iterations = " / ".join(f"{float(state.iterations.mean()):.1f}" for state in states.values())
        print(
            f"| {len(mesh.points):,} | {3 * len(mesh.interior):,} | {setup} | {chains} | {iterations} | "
            f"{times[0]:.1f} / {times[1]:.1f} |",
            flush=True,
        )


def _timed_system(mesh: TetMesh, limit: int) -> tuple[ElasticSystem, float]:
    began = time.perf_counter()
    with mock.patch.object(preconditioners, "DENSE_LIMIT", limit):
        system = elastic_system(mesh, mesh.boundary, LAM, MU, CHAIN_TOLERANCE)
    return jax.block_until_ready(system), time.perf_counter() - began


if __name__ == "__main__":
    main()
