"""Time the elastic prior's normaliser on a mesh of thousands of nodes, beside a sparse LU factor of the same matrix.

python -m studies.benchmarks.log_pdet [NODES]
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse.linalg

from bayesreg.fem.determinant import schur_determinant
from bayesreg.fem.elasticity import rigid_modes, stiffness, unknowns_of
from bayesreg.fem.elements import elements_of
from tests.phantoms import LAM, MU, box_mesh

REPETITIONS = 5


def sparse_log_pdet(mesh, lam, mu):
    """log det K_{−J} − log det K_II − 2 log |det N_J| by SuperLU; six boundary unknowns J fix the rigid motions N."""
    matrix = stiffness(mesh, lam, mu).tocsc()
    inner, outer = unknowns_of(mesh.interior), unknowns_of(mesh.boundary)
    basis = rigid_modes(mesh.points[mesh.boundary])
    held = scipy.linalg.qr(basis.T, pivoting=True, mode="r")[1][:6]
    remaining = np.setdiff1d(np.arange(matrix.shape[0]), outer[held])
    null = 2 * np.linalg.slogdet(basis[held])[1]
    return _log_determinant(matrix[remaining][:, remaining]) - _log_determinant(matrix[inner][:, inner]) - null


def _log_determinant(matrix):
    return np.log(np.abs(scipy.sparse.linalg.splu(matrix.tocsc()).U.diagonal())).sum()


def main() -> None:
    node_count = int(sys.argv[1]) if len(sys.argv) > 1 else 5000
    mesh = box_mesh(round((node_count / 2) ** (1 / 3)), size=100.0)
    nothing, elements = np.array([], int), elements_of(mesh)
    determinant = schur_determinant(mesh, mesh.boundary, nothing)

    def of(determinant, elements, lam, mu):
        return determinant.log_pseudo_determinant(elements, lam[mesh.tissue], mu[mesh.tissue])

    value = jax.jit(of)
    value_and_gradient = jax.jit(jax.value_and_grad(of, argnums=(2, 3)))
    arguments = determinant, elements, jnp.asarray(LAM), jnp.asarray(MU)
    log_determinant, (by_lam, _) = value_and_gradient(*arguments)
    step = 1e-5
    ahead, behind = (
        float(value(determinant, elements, jnp.asarray(LAM * np.exp(h)), arguments[3])) for h in (step, -step)
    )
    peer = sparse_log_pdet(mesh, LAM, MU)
    times = {
        "value": lambda: jax.block_until_ready(value(*arguments)),
        "value and gradient": lambda: jax.block_until_ready(value_and_gradient(*arguments)),
        "SuperLU, value": lambda: sparse_log_pdet(mesh, LAM, MU),
    }
    print(f"{len(mesh.points)} nodes, {len(mesh.boundary)} of them sampled")
    print(
        f"log pdet {float(log_determinant):.6f}, SuperLU's differs by "
        f"{abs(float(log_determinant) / peer - 1):.1e} of it"
    )
    slope = float(by_lam @ LAM)
    print(f"slope along log λ {slope:.6f}, by differences {(ahead - behind) / (2 * step):.6f}")
    for name, run in times.items():
        seconds = []
        for _ in range(REPETITIONS):
            began = time.perf_counter()
            run()
            seconds.append(time.perf_counter() - began)
        print(f"{name}: {np.median(seconds):.2f} s")


if __name__ == "__main__":
    main()
