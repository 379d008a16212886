"""Sparse matrices on the device, applied to the columns of many chains at once.

On the CPU the product is a compiled loop over the rows with all columns inside; XLA's gathers and scatters would treat
one entry at a time. The product is a JAX primitive, so that `vmap` adds columns instead of making a batch of products.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import scipy.sparse
from jax.experimental.sparse import BCSR
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Float, Int

from bayesreg.types import AnyArray

# Rows of a multiple of this number of bytes are aligned; the product with other rows is three to five times slower.
ALIGNED = 32


class SparseMatrix(NamedTuple):
    """A matrix in compressed rows (a pytree).

    Attributes
    ----------
    entries : (k,) array
    columns : (k,) int array
    starts : (r + 1,) int array
        The index of the first entry of each row.
    """

    entries: Float[AnyArray, "entries"]
    columns: Int[AnyArray, "entries"]
    starts: Int[AnyArray, "starts"]


class SparseOperator(NamedTuple):
    """A matrix A and its transpose (a pytree).

    `operator(x)` is A x, differentiable in x to any order and in both modes. Under `vmap` the chains become further
    columns; the matrix is the same for all chains.

    Attributes
    ----------
    matrix, transposed : SparseMatrix
        A (r, s) and Aᵀ (s, r).
    """

    matrix: SparseMatrix
    transposed: SparseMatrix

    def __call__(self, x: Float[AnyArray, "s columns"]) -> Float[AnyArray, "r columns"]:
        """Compute the product A x."""
        return _product.bind(*self.matrix, *self.transposed, x)

    @property
    def transpose(self) -> SparseOperator:
        """The operator of Aᵀ, which shares the arrays."""
        return SparseOperator(self.transposed, self.matrix)


def sparse_operator(matrix: scipy.sparse.sparray | scipy.sparse.spmatrix) -> SparseOperator:
    """Convert a SciPy matrix to an operator on the device."""
    return SparseOperator(*(_on_device(each) for each in (matrix, matrix.T)))


def symmetric_operator(matrix: scipy.sparse.sparray | scipy.sparse.spmatrix) -> SparseOperator:
    """Convert a symmetric SciPy matrix to an operator on the device, which keeps the matrix once."""
    rows = _on_device(matrix)
    return SparseOperator(rows, rows)


def _on_device(matrix: scipy.sparse.sparray | scipy.sparse.spmatrix) -> SparseMatrix:
    # The copy is needed because `sum_duplicates` sorts in place, and JAX may not have read yet an earlier array of the
    # caller in the same memory.
    rows = scipy.sparse.csr_array(matrix, copy=True)
    rows.sum_duplicates()
    return SparseMatrix(jnp.asarray(rows.data), *(jnp.asarray(x, jnp.int32) for x in (rows.indices, rows.indptr)))


_product = Primitive("sparse_product")


@_product.def_impl
def _implementation(*operands: AnyArray) -> AnyArray:
    """Compute the product of the matrix and x, with the rows of x padded to a multiple of `ALIGNED` bytes."""
    *matrix, _, _, from_rows, x = operands
    columns = x.shape[1]
    padded = jnp.pad(x, ((0, 0), (0, -columns % (ALIGNED // x.dtype.itemsize))))
    shape = len(matrix[2]) - 1, len(from_rows) - 1
    return (BCSR(tuple(matrix), shape=shape, indices_sorted=True, unique_indices=True) @ padded)[:, :columns]


@_product.def_abstract_eval
def _shape(*operands: Any) -> jax.core.ShapedArray:
    starts, x = operands[2], operands[-1]
    return jax.core.ShapedArray((starts.shape[0] - 1, x.shape[1]), x.dtype)


def _multiply_in_batches(operands: Sequence[AnyArray], axes: Sequence[int | None]) -> tuple[AnyArray, int]:
    *matrices, x = operands
    *of_matrices, axis = axes
    if axis is None or any(each is not None for each in of_matrices):
        raise NotImplementedError("the matrix of a sparse product cannot differ from chain to chain")
    chains_last = jnp.moveaxis(x, axis, -1)
    product = _product.bind(*matrices, chains_last.reshape(len(chains_last), -1))
    return product.reshape(len(product), *chains_last.shape[1:]), 2


def _transpose(cotangent: Any, *operands: Any) -> list[Any]:
    *matrices, x = operands
    if isinstance(cotangent, ad.Zero):
        return [None] * 6 + [ad.Zero(x.aval)]
    return [None] * 6 + [_product.bind(*matrices[3:], *matrices[:3], cotangent)]


mlir.register_lowering(_product, mlir.lower_fun(_implementation, multiple_results=False))
batching.primitive_batchers[_product] = _multiply_in_batches
ad.defjvp(_product, *[None] * 6, lambda change, *operands: _product.bind(*operands[:-1], change))
ad.primitive_transposes[_product] = _transpose
