"""Put chains on the last axis of arrays under `vmap`, which would put them on the first axis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Float

from bayesreg.types import AnyArray


def with_chains_as_columns(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate f(shared, *arrays) so that `vmap` makes the last axis (chains) of its arrays and results longer.

    `shared` is a pytree that all chains have in common. The decorated function has no derivative.
    """
    decorated = custom_vmap(function)

    @decorated.def_vmap
    def _(size: int, batched: Sequence[Any], shared: Any, *arrays: AnyArray) -> tuple[Any, Any]:
        if any(jax.tree.leaves(batched[0])):
            raise NotImplementedError(f"what {function.__name__} shares among chains cannot differ from chain to chain")
        shapes = [(size, *array.shape[is_batched:]) for array, is_batched in zip(arrays, batched[1:], strict=True)]
        longer = [_join(jnp.broadcast_to(x, shape)) for x, shape in zip(arrays, shapes, strict=True)]
        results, chains = decorated(shared, *longer), shapes[0][-1]
        parted = jax.tree.map(lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], chains, size), -1, 0), results)
        return parted, jax.tree.map(lambda _: True, results)

    return decorated


def _join(x: Float[AnyArray, "size *rows chains"]) -> Float[AnyArray, "*rows all_chains"]:
    chains_last = jnp.moveaxis(x, 0, -1)
    return chains_last.reshape(*chains_last.shape[:-2], chains_last.shape[-2] * chains_last.shape[-1])
