"""Functions of posterior draws, in blocks, with mean, sd and quantiles in bounded memory.

A function takes one draw, a mapping of arrays, and a further argument. It is compiled: large arrays (a mesh, an image)
belong in the further argument, because they would otherwise become constants of the program.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Int

from bayesreg.inference.draws.inference_data import STRETCH
from bayesreg.inference.draws.moments import Moments, extend, pool, zero_moments
from bayesreg.types import AnyArray

Draws = Mapping[str, AnyArray]

BLOCK = 16
MOST_KEPT = 1024


class Summary(NamedTuple):
    """Moments and quantiles of a function of the draws; pytrees of the function's own structure.

    Attributes
    ----------
    mean, sd : pytree
        Mean and sd over all draws of all chains.
    chain_mean : pytree
        Mean over the draws of each chain, with chains as the leading axis.
    quantiles : pytree
        Quantiles over all chains, with probabilities as the leading axis. They come from at most about `MOST_KEPT`
        evenly spaced draws of each chain.
    """

    mean: Any
    sd: Any
    chain_mean: Any
    quantiles: Any


def evenly_spaced(total: int, most: int) -> Int[np.ndarray, "k"]:
    """List at most `most` indices below `total`, the middles of ranges of equal length."""
    count = min(total, most)
    return ((np.arange(count) + 0.5) * total / count).astype(int)


def thin(posterior: xr.Dataset, names: Iterable[str], most: int) -> dict[str, np.ndarray]:
    """Take evenly spaced draws of the named variables.

    Parameters
    ----------
    posterior : xarray.Dataset
    names : iterable of str
    most : int
        The greatest number of draws over all chains together; at least one of each chain is taken.

    Returns
    -------
    dict
        Arrays (chain, draw, …).
    """
    total = posterior.sizes["draw"]
    chosen = evenly_spaced(total, max(1, most // posterior.sizes["chain"]))
    variables = posterior[list(names)].transpose("chain", "draw", ...)
    parts_by_name: dict[str, list[np.ndarray]] = {str(name): [] for name in variables.data_vars}
    # A chunk of the file holds STRETCH draws: one draw costs as much to read as its whole chunk.
    for first in range(0, total, STRETCH):
        within = chosen[(chosen >= first) & (chosen < first + STRETCH)] - first
        if len(within):
            stretch = variables.isel(draw=slice(first, first + STRETCH))
            for name, pieces in parts_by_name.items():
                pieces.append(np.asarray(stretch[name].to_numpy()[:, within], float))
    return {name: np.concatenate(pieces, axis=1) for name, pieces in parts_by_name.items()}


def push_forward(function: Callable[..., Any], draws: Draws, shared: Any = None, block: int = BLOCK) -> Iterator[Any]:
    """Evaluate a function at every draw, block by block.

    Parameters
    ----------
    function : callable
        (one draw, shared) → a pytree of arrays; traceable by JAX.
    draws : mapping
        Arrays (chain, draw, …).
    shared : pytree
        A further argument, the same for all draws.
    block : int
        Draws evaluated side by side.

    Yields
    ------
    pytree
        NumPy arrays (chain, stretch, …) of consecutive ranges of draws.
    """
    chains, total = next(iter(draws.values())).shape[:2]
    stretch = max(1, min(total, block // chains))
    batched = jax.jit(jax.vmap(jax.vmap(function, (0, None)), (0, None)))
    for first in range(0, total, stretch):
        # The last draw fills up the last stretch, because JAX would compile another shape again.
        chosen = np.minimum(np.arange(first, first + stretch), total - 1)
        outputs = batched({name: jnp.asarray(values[:, chosen]) for name, values in draws.items()}, shared)
        wanted = slice(total - first)
        yield jax.tree.map(lambda leaf, wanted=wanted: np.asarray(leaf)[:, wanted], outputs)


def summarise(blocks: Iterable[Any], probabilities: Sequence[float] = (0.025, 0.5, 0.975)) -> Summary:
    """Compute mean, sd and quantiles of the blocks from `push_forward`.

    One block and `MOST_KEPT` draws of each chain are in memory at a time.
    """
    moments, retained, stride, count = None, None, 1, 0
    for block in blocks:
        moments = extend(_nothing(block) if moments is None else moments, block)
        chosen = slice(-count % stride, None, stride)
        thinned = jax.tree.map(lambda leaf, chosen=chosen: leaf[:, chosen], block)
        retained = (
            thinned
            if retained is None
            else jax.tree.map(lambda a, b: np.concatenate([a, b], axis=1), retained, thinned)
        )
        count += jax.tree.leaves(block)[0].shape[1]
        while jax.tree.leaves(retained)[0].shape[1] > MOST_KEPT:
            retained, stride = jax.tree.map(lambda leaf: leaf[:, ::2], retained), 2 * stride
    if moments is None:
        raise ValueError("there is no draw to summarise")
    mean, sd = pool(moments)
    return Summary(
        mean, sd, moments.mean, jax.tree.map(lambda leaf: np.quantile(leaf, probabilities, (0, 1)), retained)
    )


def _nothing(block: Any) -> Moments:
    chains = jax.tree.leaves(block)[0].shape[0]
    moments = zero_moments(jax.tree.map(lambda leaf: leaf[:, 0], block))
    return jax.tree.map(np.asarray, moments._replace(count=np.zeros(chains)))
