"""A hundred interior solves, each at its own λ and μ, beside other libraries on the same systems.

    python -m studies.benchmarks.solves [--nodes 5000 30000 100000] [--peers pyamg cholespy superlu] …

A ball of three shells, λ and μ scattered about the reference by a factor of 1.35, displacements of the boundary random.
Every solve ends at 1e-8 of the load in the norm of the inverse diagonal. Set-up is counted, ours and PyAMG's once,
at the reference; a direct solver factors every matrix. The times of single solves (ours of batches, side by side) enter
by their median; slow peers make fewer of them.
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
# Of the greatest displacement: what a residual of `TOLERANCE` may leave in the soft directions.
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
    """A ball of about so many nodes."""
    # A body-centred lattice of spacing s has two nodes in s³.
    return ball_mesh(radius=80.0, spacing=(2 * 4 / 3 * np.pi * 80.0**3 / nodes) ** (1 / 3))


def compare(mesh: TetMesh, solves: int, chains: int, peers: list[str]) -> None:
    """Time all ways on one mesh, and check that they agree."""
    rng = np.random.default_rng(0)
    lam, mu = (values * np.exp(SPREAD * rng.normal(size=(solves, 3))) for values in (LAM, MU))
    u = rng.normal(size=(solves, len(mesh.boundary), 3))
    print(f"\n{len(mesh.points):,} nodes, {3 * len(mesh.interior):,} unknowns; seconds for {solves} solves")
    ours, expected = _ours(mesh, lam, mu, u, chains)
    for name in peers:
        seconds, worst, made = _peer(mesh, PEERS[name], lam, mu, u, expected)
        print(
            f"  {name:10s} {seconds:9.1f}  {seconds / ours:6.2f} times ours  ({made} made, off by {worst:.0e})",
            flush=True,
        )


def _ours(mesh: TetMesh, lam: np.ndarray, mu: np.ndarray, u: np.ndarray, chains: int) -> tuple[float, np.ndarray]:
    begun = time.perf_counter()
    system = elastic_system(mesh, mesh.boundary, LAM, MU, TOLERANCE)
    jax.block_until_ready(system)
    ready = time.perf_counter()
    shape = jax.eval_shape(lambda: jnp.zeros((chains, *u.shape[1:])))
    entries = jax.eval_shape(lambda: jnp.zeros((chains, 3)))
    tissue = jnp.asarray(mesh.tissue)

    @jax.jit
    def many(system: ElasticSystem, lam: jax.Array, mu: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = jax.vmap(lambda lam, mu, u: equilibrium(system, lam[tissue], mu[tissue], u))(lam, mu, u)
        return found.u, jnp.where(found.converged, found.iterations, -1)

    compiled = many.lower(system, entries, entries, shape).compile()
    compiling = time.perf_counter() - ready
    found, iterations, batches = [], [], []
    for i in range(0, len(u), chains):
        start = time.perf_counter()
        batch = jax.block_until_ready(compiled(system, *(jnp.asarray(x[i : i + chains]) for x in (lam, mu, u))))
        batches.append(time.perf_counter() - start)
        found.append(np.asarray(batch[0]))
        iterations.append(np.asarray(batch[1]))
    found, iterations = np.concatenate(found), np.concatenate(iterations)
    assert iterations.min() > 0, "a solve did not converge"
    seconds = ready - begun + len(batches) * float(np.median(batches))
    print(
        f"  {'bayesreg':10s} {seconds:9.1f}  of which set-up {ready - begun:.1f}; compiling, not "
        f"counted, {compiling:.1f}; {iterations.min()} to {iterations.max()} iterations; at most "
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GiB so far",
        flush=True,
    )
    return seconds, found[:, mesh.interior].reshape(len(u), -1)


def _peer(
    mesh: TetMesh,
    setup: Callable[[TetMesh], Solve],
    lam: np.ndarray,
    mu: np.ndarray,
    u: np.ndarray,
    expected: Float[np.ndarray, "solves unknowns"],
) -> tuple[float, float, int]:
    """Seconds for all solves, the greatest relative difference from what we found, and how many were made."""
    begun = time.perf_counter()
    solve, system = setup(mesh), _systems(mesh)
    setting_up, worst = time.perf_counter() - begun, 0.0
    seconds: list[float] = []
    for each, known in zip(zip(lam, mu, u, strict=True), expected, strict=True):
        start = time.perf_counter()
        found = solve(*system(*each))
        seconds.append(time.perf_counter() - start)
        worst = max(worst, float(abs(found - known).max() / abs(known).max()))
        assert worst < AGREEMENT, f"off by {worst:.0e}"
        if sum(seconds) > LONGEST:
            break
    return setting_up + len(u) * float(np.median(seconds)), worst, len(seconds)


def _systems(mesh: TetMesh) -> Callable[[np.ndarray, np.ndarray, np.ndarray], System]:
    """λ, μ and u_B to K_II and −K_IB u_B."""
    free, given = unknowns_of(mesh.interior), unknowns_of(mesh.boundary)
    inner, coupling = affine_sum(mesh, free, free), affine_sum(mesh, free, given)
    return lambda lam, mu, u: (inner(lam, mu), -coupling(lam, mu) @ u.ravel())


def _pyamg(mesh: TetMesh) -> Solve:
    import pyamg

    free = unknowns_of(mesh.interior)
    reference = scipy.sparse.bsr_array(stiffness(mesh, LAM, MU)[free][:, free], blocksize=(3, 3))
    hierarchy = pyamg.smoothed_aggregation_solver(
        reference, rigid_modes(mesh.points[mesh.interior]), strength=("symmetric", {"theta": 0.08}), max_coarse=100
    )
    cycle = hierarchy.aspreconditioner()
    # The coarsest matrix is factored when it is first met.
    cycle @ np.ones(reference.shape[0])

    def solve(matrix: scipy.sparse.csr_array, load: np.ndarray) -> np.ndarray:
        # SciPy stops by the plain norm: exactly as far as ours it goes in the coordinates scaled by the diagonal.
        root = np.sqrt(matrix.diagonal())
        scaled = scipy.sparse.linalg.LinearOperator(matrix.shape, lambda x: (matrix @ (x / root)) / root)
        precondition = scipy.sparse.linalg.LinearOperator(matrix.shape, lambda x: root * (cycle @ (root * x)))
        found, failed = scipy.sparse.linalg.cg(scaled, load / root, rtol=TOLERANCE, M=precondition)
        assert not failed
        return found / root

    return solve


def _scikit_fem(_mesh: TetMesh) -> Solve:
    """Its conjugate gradients as they come, preconditioned by the diagonal; an incomplete factor took longer."""
    from skfem.utils import solver_iter_pcg

    iterate = solver_iter_pcg(rtol=TOLERANCE)

    def solve(matrix: scipy.sparse.csr_array, load: np.ndarray) -> np.ndarray:
        # It stops by the plain norm, too.
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
