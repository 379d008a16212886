"""Time a hundred interior solves, each with its own λ and μ, beside other libraries on the same systems.

    python -m studies.benchmarks.solves [--nodes 5000 30000 100000] [--peers pyamg cholespy superlu] …

The mesh is a ball of three shells. λ and μ are scattered about the reference by a factor of 1.35, and the displacements
of the boundary are random. Every solve ends at 1e-8 of the load in the norm of the inverse diagonal. Set-up counts:
bayesreg and PyAMG set up once, at the reference, and a direct solver factors every matrix. The total is the median time
of a solve (for bayesreg, of a batch of solves side by side) times their number; slow peers make fewer solves.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float

from bayesreg.fem.conjugate_gradients import ElasticSystem
from bayesreg.fem.elasticity import rigid_modes, stiffness, unknowns_of
from bayesreg.fem.equilibrium import elastic_system, equilibrium
from bayesreg.mesh import TetMesh
from studies.benchmarks.places import SPREAD
from studies.benchmarks.stored import Solve, affine_sum, cholespy_solve, superlu_solve
from tests.phantoms import LAM, MU, ball_mesh

TOLERANCE, LONGEST = 1e-8, 60.0
# The allowed error, as a share of the greatest displacement, for a residual of `TOLERANCE` in the soft directions.
AGREEMENT = 1e-6

System = tuple[scipy.sparse.csr_array, np.ndarray]


def main() -> None:
    """Print a table for each mesh."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, nargs="+", default=[5_000, 30_000, 100_000])
    parser.add_argument("--solves", type=int, default=100)
    parser.add_argument("--chains", type=int, default=20, help="solved side by side, as columns")
    parser.add_argument("--peers", nargs="*", default=list(PEERS), choices=list(PEERS), metavar="PEER")
    options = parser.parse_args()
    if options.solves % options.chains:
        parser.error("the chains must divide the solves")
    for nodes in options.nodes:
        compare(mesh_of(nodes), options.solves, options.chains, options.peers)


def mesh_of(nodes: int) -> TetMesh:
    """A ball of about `nodes` nodes."""
    # A body-centred lattice of spacing s has two nodes in s³.
    return ball_mesh(radius=80.0, spacing=(2 * 4 / 3 * np.pi * 80.0**3 / nodes) ** (1 / 3))


def compare(mesh: TetMesh, solves: int, chains: int, peers: list[str]) -> None:
    """Time all solvers on one mesh, and check that they agree."""
    rng = np.random.default_rng(0)
    lam, mu = (values * np.exp(SPREAD * rng.normal(size=(solves, 3))) for values in (LAM, MU))
    u = rng.normal(size=(solves, len(mesh.boundary), 3))
    print(f"\n{len(mesh.points):,} nodes, {3 * len(mesh.interior):,} unknowns; seconds for {solves} solves")
    seconds_of_bayesreg, expected = _bayesreg(mesh, lam, mu, u, chains)
    for name in peers:
        seconds, worst, count = _peer(mesh, PEERS[name], lam, mu, u, expected)
        print(
            f"  {name:10s} {seconds:9.1f}  {seconds / seconds_of_bayesreg:6.2f} times bayesreg's  ({count} solves, "
            f"greatest difference {worst:.0e})",
            flush=True,
        )


def _bayesreg(mesh: TetMesh, lam: np.ndarray, mu: np.ndarray, u: np.ndarray, chains: int) -> tuple[float, np.ndarray]:
    begun = time.perf_counter()
    system = elastic_system(mesh, mesh.boundary, LAM, MU, TOLERANCE)
    jax.block_until_ready(system)
    ready = time.perf_counter()
    shape = jax.eval_shape(lambda: jnp.zeros((chains, *u.shape[1:])))
    entries = jax.eval_shape(lambda: jnp.zeros((chains, 3)))
    tissue = jnp.asarray(mesh.tissue)

    @jax.jit
    def solve_batch(system: ElasticSystem, lam: jax.Array, mu: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
        states = jax.vmap(lambda lam, mu, u: equilibrium(system, lam[tissue], mu[tissue], u))(lam, mu, u)
        return states.u, jnp.where(states.converged, states.iterations, -1)

    compiled = solve_batch.lower(system, entries, entries, shape).compile()
    compiling = time.perf_counter() - ready
    displacements, iterations, batches = [], [], []
    for i in range(0, len(u), chains):
        start = time.perf_counter()
        batch = jax.block_until_ready(compiled(system, *(jnp.asarray(x[i : i + chains]) for x in (lam, mu, u))))
        batches.append(time.perf_counter() - start)
        displacements.append(np.asarray(batch[0]))
        iterations.append(np.asarray(batch[1]))
    displacements, iterations = np.concatenate(displacements), np.concatenate(iterations)
    assert iterations.min() > 0, "a solve did not converge"
    seconds = ready - begun + len(batches) * float(np.median(batches))
    print(
        f"  {'bayesreg':10s} {seconds:9.1f}  of which set-up {ready - begun:.1f}; compiling, not "
        f"counted, {compiling:.1f}; {iterations.min()} to {iterations.max()} iterations; at most "
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GiB so far",
        flush=True,
    )
    return seconds, displacements[:, mesh.interior].reshape(len(u), -1)


def _peer(
    mesh: TetMesh,
    setup: Callable[[TetMesh], Solve],
    lam: np.ndarray,
    mu: np.ndarray,
    u: np.ndarray,
    expected: Float[np.ndarray, "solves unknowns"],
) -> tuple[float, float, int]:
    """Return the seconds for all solves, the greatest relative difference from `expected`, and the number of solves."""
    begun = time.perf_counter()
    solve, system = setup(mesh), _systems(mesh)
    setting_up, worst = time.perf_counter() - begun, 0.0
    seconds: list[float] = []
    for each, expected_solution in zip(zip(lam, mu, u, strict=True), expected, strict=True):
        start = time.perf_counter()
        solution = solve(*system(*each))
        seconds.append(time.perf_counter() - start)
        worst = max(worst, float(abs(solution - expected_solution).max() / abs(expected_solution).max()))
        assert worst < AGREEMENT, f"the solutions differ by {worst:.0e}"
        if sum(seconds) > LONGEST:
            break
    return setting_up + len(u) * float(np.median(seconds)), worst, len(seconds)


def _systems(mesh: TetMesh) -> Callable[[np.ndarray, np.ndarray, np.ndarray], System]:
    """A function from λ, μ and u_B to the system K_II and −K_IB u_B."""
    free, prescribed = unknowns_of(mesh.interior), unknowns_of(mesh.boundary)
    inner, coupling = affine_sum(mesh, free, free), affine_sum(mesh, free, prescribed)
    return lambda lam, mu, u: (inner(lam, mu), -coupling(lam, mu) @ u.ravel())


def _pyamg(mesh: TetMesh) -> Solve:
    import pyamg

    free = unknowns_of(mesh.interior)
    reference = scipy.sparse.bsr_array(stiffness(mesh, LAM, MU)[free][:, free], blocksize=(3, 3))
    hierarchy = pyamg.smoothed_aggregation_solver(
        reference, rigid_modes(mesh.points[mesh.interior]), strength=("symmetric", {"theta": 0.08}), max_coarse=100
    )
    cycle = hierarchy.aspreconditioner()
    # PyAMG factors the coarsest matrix at its first use.
    cycle @ np.ones(reference.shape[0])

    def solve(matrix: scipy.sparse.csr_array, load: np.ndarray) -> np.ndarray:
        # SciPy stops by the plain norm. In coordinates scaled by the diagonal this is bayesreg's criterion.
        root = np.sqrt(matrix.diagonal())
        scaled = scipy.sparse.linalg.LinearOperator(matrix.shape, lambda x: (matrix @ (x / root)) / root)
        precondition = scipy.sparse.linalg.LinearOperator(matrix.shape, lambda x: root * (cycle @ (root * x)))
        solution, failed = scipy.sparse.linalg.cg(scaled, load / root, rtol=TOLERANCE, M=precondition)
        assert not failed
        return solution / root

    return solve


def _scikit_fem(_mesh: TetMesh) -> Solve:
    """Solve by scikit-fem's conjugate gradients with its diagonal preconditioner; an incomplete factor took longer."""
    from skfem.utils import solver_iter_pcg

    iterate = solver_iter_pcg(rtol=TOLERANCE)

    def solve(matrix: scipy.sparse.csr_array, load: np.ndarray) -> np.ndarray:
        # scikit-fem stops by the plain norm, too.
        inverse_root = scipy.sparse.diags_array(1 / np.sqrt(matrix.diagonal()))
        return inverse_root @ iterate(scipy.sparse.csr_array(inverse_root @ matrix @ inverse_root), inverse_root @ load)

    return solve


PEERS: dict[str, Callable[[TetMesh], Solve]] = {
    "pyamg": _pyamg,
    "scikit-fem": _scikit_fem,
    "cholespy": lambda mesh: cholespy_solve,
    "superlu": lambda mesh: superlu_solve,
}


if __name__ == "__main__":
    main()
