"""Sparse matrices on the device, applied to the columns of many chains at once.

On the CPU these products go to a compiled loop over the rows with all columns inside, where gathers and scatters of XLA
go entry by entry: with 16 chains the product takes a tenth of the time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import scipy.sparse
from jax.custom_batching import custom_vmap
from jax.experimental.sparse import BCSR
from jaxtyping import Float

from bayesreg.types import AnyArray

# Rows of so many bytes are aligned; the product of others is three to five times slower.
ALIGNED = 32


class SparseOperator(NamedTuple):
    """A sparse matrix and its transpose (a pytree), differentiable by reverse mode in what it is applied to.

    Under `vmap` chains join the columns; the matrix is the same for all.

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


def with_chains_as_columns(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate f(shared, *arrays) whose arrays, as what it returns, end in an axis of chains: `vmap` makes it longer.

    `shared` is a pytree that all chains have in common. What is decorated has a derivative by forward mode alone.
    """
    decorated = custom_vmap(function)

    @decorated.def_vmap
    def _(size: int, batched: Sequence[Any], shared: Any, *arrays: AnyArray) -> tuple[Any, Any]:
        if any(jax.tree.leaves(batched[0])):
            raise NotImplementedError(f"what {function.__name__} shares among chains cannot differ from chain to chain")
        shapes = [(size, *array.shape[own:]) for array, own in zip(arrays, batched[1:], strict=True)]
        longer = [_joined(jnp.broadcast_to(x, shape)) for x, shape in zip(arrays, shapes, strict=True)]
        found = decorated(shared, *longer)
        parted = jax.tree.map(lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], -1, size), -1, 0), found)
        return parted, jax.tree.map(lambda _: True, found)

    return decorated


def _joined(x: Float[AnyArray, "size *rows chains"]) -> Float[AnyArray, "*rows all_chains"]:
    moved = jnp.moveaxis(x, 0, -1)
    return moved.reshape(*moved.shape[:-2], -1)


def product(matrix: BCSR, x: Float[AnyArray, "s columns"]) -> Float[AnyArray, "r columns"]:
    """A x, without a rule for `vmap`; rows of x are padded to a multiple of `ALIGNED`."""
    columns = x.shape[1]
    padded = jnp.pad(x, ((0, 0), (0, -columns % (ALIGNED // x.dtype.itemsize))))
    return (matrix @ padded)[:, :columns]


product_of_chains = with_chains_as_columns(product)


@jax.custom_vjp
def _linear(operator: SparseOperator, x: AnyArray) -> AnyArray:
    return product_of_chains(operator.matrix, x)


# Products without a rule for reverse mode in both: so slopes have derivatives by forward mode.
def _forward(operator: SparseOperator, x: AnyArray) -> tuple[AnyArray, SparseOperator]:
    return product_of_chains(operator.matrix, x), operator


def _backward(operator: SparseOperator, cotangent: AnyArray) -> tuple[None, AnyArray]:
    return None, product_of_chains(operator.transposed, cotangent)


_linear.defvjp(_forward, _backward)
