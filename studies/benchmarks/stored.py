"""The fastest form of the paper's algorithm with NumPy, SciPy and cholespy, as a peer of bayesreg.

K is an affine sum of stored matrices of one pattern, and is factored anew for every (λ, μ). Images are B-splines whose
coefficients are computed once. No Python code loops over elements or points.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float, Int
from scipy import ndimage

from bayesreg.fem.elasticity import stiffness, unknowns_of
from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from tests.oracles.paper import FOUR_POINTS

Solve = Callable[[scipy.sparse.csr_array, np.ndarray], np.ndarray]
T_SIMILARITY, T_ELASTIC = 0.05, 1e4


def affine_sum(
    mesh: TetMesh, rows: Int[np.ndarray, "rows"], columns: Int[np.ndarray, "columns"]
) -> Callable[[np.ndarray, np.ndarray], scipy.sparse.csr_array]:
    """A function from λ and μ by tissue to these rows and columns of K."""
    submatrices = [
        stiffness(mesh, *pair)[rows][:, columns]
        for e in np.eye(len(mesh.names))
        for pair in ((e, 0 * e), (0 * e, e))
    ]  # fmt: skip
    pattern = scipy.sparse.csr_array(
        stiffness(mesh, np.ones(len(mesh.names)), np.ones(len(mesh.names)))[rows][:, columns]
    )
    pattern.data[:] = 1.0
    stored = np.array([_with_pattern(submatrix, pattern) for submatrix in submatrices])

    def matrix(lam: np.ndarray, mu: np.ndarray) -> scipy.sparse.csr_array:
        theta = np.column_stack([lam, mu]).ravel()
        return scipy.sparse.csr_array((theta @ stored, pattern.indices, pattern.indptr), shape=pattern.shape)

    return matrix


def _with_pattern(matrix: scipy.sparse.csr_matrix, pattern: scipy.sparse.csr_array) -> np.ndarray:
    """The entries of a matrix in the order of a pattern that contains its pattern."""
    combined = (pattern + matrix).tocsr()
    combined.sort_indices()
    pattern.sort_indices()
    return combined.data - pattern.data


def log_density(
    mesh: TetMesh, fixed: Image, moving: Image, order: int, solve: Solve
) -> Callable[[np.ndarray, np.ndarray, np.ndarray], float]:
    """A function from u_B, λ and μ by tissue to the log of eq. (12), with flat priors and the paper's temperatures."""
    free, prescribed = unknowns_of(mesh.interior), unknowns_of(mesh.boundary)
    inner, coupling, outer = (
        affine_sum(mesh, *pair) for pair in ((free, free), (free, prescribed), (prescribed, prescribed))
    )
    count = 4 * len(mesh.cells)
    interpolation = scipy.sparse.csr_array(
        (
            np.tile(FOUR_POINTS, (len(mesh.cells), 1)).ravel(),
            np.repeat(mesh.cells, 4, axis=0).ravel(),
            np.arange(0, 4 * count + 1, 4),
        ),
        shape=(count, len(mesh.points)),
    )
    places, weights = interpolation @ mesh.points, np.repeat(mesh.volumes / 4, 4)
    expected, shown = (_image(image, order) for image in (fixed, moving))
    fixed_values = expected(places)

    def density(u_boundary: np.ndarray, lam: np.ndarray, mu: np.ndarray) -> float:
        boundary_values = u_boundary.ravel()
        load = -coupling(lam, mu) @ boundary_values
        interior_values = solve(inner(lam, mu), load)
        u = np.empty((len(mesh.points), 3))
        u[mesh.boundary], u[mesh.interior] = u_boundary, interior_values.reshape(-1, 3)
        strain = 0.5 * (boundary_values @ (outer(lam, mu) @ boundary_values) - interior_values @ load)
        similarity = weights @ (fixed_values - shown(places + interpolation @ u)) ** 2
        return -similarity / T_SIMILARITY - strain / T_ELASTIC

    return density


def _image(image: Image, order: int) -> Callable[[Float[np.ndarray, "q 3"]], Float[np.ndarray, "q"]]:
    mode = {1: "nearest", 3: "mirror"}[order]
    voxels = np.asarray(image.voxels, float)
    coefficients = ndimage.spline_filter(voxels, order=3, mode=mode) if order == 3 else voxels
    last = np.array(image.shape) - 1.0

    def values(points: np.ndarray) -> np.ndarray:
        indices = np.clip(image.world_to_voxel(points), 0, last)
        return ndimage.map_coordinates(coefficients, indices.T, order=order, mode=mode, prefilter=False)

    return values


def cholespy_solve(matrix: scipy.sparse.csr_array, load: np.ndarray) -> np.ndarray:
    """Solve a system by a new Cholesky factor."""
    from cholespy import CholeskySolverD, MatrixType

    indices = (array.astype(np.int32) for array in (matrix.indptr, matrix.indices))
    factor = CholeskySolverD(matrix.shape[0], *indices, matrix.data, MatrixType.CSR)
    solution = np.zeros_like(load)
    factor.solve(load, solution)
    return solution


def superlu_solve(matrix: scipy.sparse.csr_array, load: np.ndarray) -> np.ndarray:
    """Solve a system by a new LU factor, with SuperLU's options for a symmetric positive matrix."""
    symmetric = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    return scipy.sparse.linalg.splu(matrix.tocsc(), **symmetric).solve(load)


SOLVERS: dict[str, Solve] = {"cholespy": cholespy_solve, "SuperLU": superlu_solve}
