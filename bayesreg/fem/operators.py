"""Sparse matrices on the device, applied to the columns of many chains at once.

On the CPU these products go to a compiled loop over the rows with all columns inside, where gathers and scatters of XLA
go entry by entry: with 16 chains the product takes a tenth of the time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax.custom_batching import custom_vmap
from jax.experimental.sparse import BCSR
from jaxtyping import Float

from bayesreg.types import AnyArray

# Rows of so many bytes are aligned; the product of others is three to five times slower.
ALIGNED = 32


class SparseOperator(NamedTuple):
    """A sparse matrix and its transpose (a pytree); differentiable in what it is applied to, by reverse mode.

    Under `vmap` the batch joins the columns. The matrix itself cannot be batched.

    Attributes
    ----------
    matrix, transposed : BCSR
        (r, s) and (s, r).
    """

    matrix: BCSR
    transposed: BCSR

    def __call__(self, x: Float[AnyArray, "s columns"]) -> Float[AnyArray, "r columns"]:
        """A x."""
        return _linear(self, x)

    @property
    def transpose(self) -> SparseOperator:
        """Aᵀ, of the same arrays."""
        return SparseOperator(self.transposed, self.matrix)


def sparse_operator(matrix: scipy.sparse.sparray | scipy.sparse.spmatrix) -> SparseOperator:
    """A matrix of SciPy's for the device."""
    return SparseOperator(_on_device(matrix), _on_device(matrix.T))


def _on_device(matrix: scipy.sparse.sparray | scipy.sparse.spmatrix) -> BCSR:
    rows = scipy.sparse.csr_array(matrix)
    rows.sum_duplicates()
    # Indices of 32 bits: those of 64 have no kernel on GPUs.
    indices, starts = (jnp.asarray(places, jnp.int32) for places in (rows.indices, rows.indptr))
    arrays = jnp.asarray(rows.data), indices, starts
    return BCSR(arrays, shape=rows.shape, indices_sorted=True, unique_indices=True)


def with_chains_as_columns(function: Callable[..., AnyArray]) -> Callable[..., AnyArray]:
    """Decorate f(shared, *arrays), whose arrays end in an axis of chains, as its value does: `vmap` makes it longer.

    `shared` is a pytree that all chains have in common. What is decorated has no derivative.
    """
    decorated = custom_vmap(function)

    @decorated.def_vmap
    def _(size: int, batched: Sequence[Any], shared: Any, *arrays: AnyArray) -> tuple[AnyArray, bool]:
        if any(jax.tree.leaves(batched[0])):
            raise NotImplementedError(f"what {function.__name__} shares among chains cannot differ from chain to chain")
        shapes = [(size, *array.shape[own:]) for array, own in zip(arrays, batched[1:], strict=True)]
        longer = [_joined(jnp.broadcast_to(x, shape)) for x, shape in zip(arrays, shapes, strict=True)]
        found = decorated(shared, *longer)
        return jnp.moveaxis(found.reshape(*found.shape[:-1], -1, size), -1, 0), True

    return decorated


def _joined(x: Float[AnyArray, "size *rows chains"]) -> Float[AnyArray, "*rows all_chains"]:
    moved = jnp.moveaxis(x, 0, -1)
    return moved.reshape(*moved.shape[:-2], -1)


def product(matrix: BCSR, x: Float[AnyArray, "s columns"]) -> Float[AnyArray, "r columns"]:
    """A x, without a derivative and a rule for `vmap`; rows of x are padded to a multiple of `ALIGNED`."""
    columns = x.shape[1]
    padded = jnp.pad(x, ((0, 0), (0, -columns % (ALIGNED // x.dtype.itemsize))))
    return (matrix @ padded)[:, :columns]


@with_chains_as_columns
def _product(matrix: BCSR, x: AnyArray) -> AnyArray:
    return product(matrix, x)


@jax.custom_vjp
def _linear(operator: SparseOperator, x: AnyArray) -> AnyArray:
    return _product(operator.matrix, x)


def _forward(operator: SparseOperator, x: AnyArray) -> tuple[AnyArray, SparseOperator]:
    return _linear(operator, x), operator


def _backward(operator: SparseOperator, cotangent: AnyArray) -> tuple[None, AnyArray]:
    return None, _linear(operator.transpose, cotangent)


_linear.defvjp(_forward, _backward)
