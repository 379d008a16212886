"""Running means and variances (Welford), and R̂ computed from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.types import AnyArray


class Moments(NamedTuple):
    """The count, mean and sum of squared deviations of a pytree; their size does not grow with the draws."""

    count: AnyArray
    mean: Any
    squares: Any


def zero_moments(like: Any) -> Moments:
    """Make the moments before the first draw."""
    zeros = jax.tree.map(lambda x: jnp.zeros(jnp.shape(x)), like)
    return Moments(jnp.zeros(()), zeros, zeros)


def update(moments: Moments, draw: Any, weight: AnyArray | int = 1) -> Moments:
    """Add a draw to the moments, counted `weight` times (West 1979)."""
    count = moments.count + weight
    share = weight / jnp.maximum(count, 1)
    mean = jax.tree.map(lambda m, x: m + share * (x - m), moments.mean, draw)
    squares = jax.tree.map(
        lambda s, x, old, new: s + weight * (x - old) * (x - new), moments.squares, draw, moments.mean, mean
    )
    return Moments(count, mean, squares)


def extend(moments: Moments, block: Any) -> Moments:
    """Add a block of draws to the moments of several chains (Chan et al.), on the host.

    Parameters
    ----------
    moments : Moments
        The moments, with chains as the leading axis.
    block : pytree
        NumPy arrays (chain, draw, …).
    """
    before, more = np.asarray(moments.count), jax.tree.leaves(block)[0].shape[1]
    total = before + more

    def mean(old: AnyArray, x: np.ndarray) -> np.ndarray:
        share = (more / total).reshape(-1, *(1,) * (x.ndim - 2))
        return old + share * (x.mean(axis=1) - old)

    def squares(old: AnyArray, x: np.ndarray, old_mean: AnyArray) -> np.ndarray:
        between = (before * more / total).reshape(-1, *(1,) * (x.ndim - 2))
        block_mean = x.mean(axis=1)
        return old + ((x - block_mean[:, None]) ** 2).sum(axis=1) + between * (block_mean - old_mean) ** 2

    return Moments(
        total,
        jax.tree.map(mean, moments.mean, block),
        jax.tree.map(squares, moments.squares, block, moments.mean),
    )


def pool(moments: Moments) -> tuple[Any, Any]:
    """Compute mean and standard deviation over all draws of all chains (leading axis) of equal length."""
    count = np.asarray(moments.count)[0]

    def total(mean: AnyArray, squares: AnyArray) -> np.ndarray:
        mean, squares = np.asarray(mean), np.asarray(squares)
        between = count * ((mean - mean.mean(axis=0)) ** 2).sum(axis=0)
        return np.asarray(np.sqrt((squares.sum(axis=0) + between) / max(count * len(mean) - 1, 1)))

    return jax.tree.map(lambda m: np.asarray(m).mean(axis=0), moments.mean), jax.tree.map(
        total, moments.mean, moments.squares
    )


def scale_reduction(moments: Moments) -> Any:
    """Compute R̂ = √(var⁺ / W) of Gelman et al. (the paper's reference 12), with unsplit chains, for every entry.

    R̂ is NaN with fewer than two chains or two draws, and infinite if the draws of each chain are all equal.
    """
    count = float(np.asarray(moments.count)[0])

    def ratio(mean: AnyArray, squares: AnyArray) -> np.ndarray:
        mean, squares = np.asarray(mean), np.asarray(squares)
        if len(mean) < 2 or count < 2:
            return np.full(mean.shape[1:], np.nan)
        within = squares.mean(axis=0) / (count - 1)
        pooled_variance = (count - 1) / count * within + mean.var(axis=0, ddof=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(within == 0, np.inf, np.sqrt(pooled_variance / within))

    return jax.tree.map(ratio, moments.mean, moments.squares)


def greatest_rhat(rhat: Mapping[str, AnyArray]) -> float:
    """Find the greatest R̂ of all estimands; NaN if one R̂ is NaN or there is no estimand."""
    values = np.concatenate([np.zeros(0), *(np.ravel(value) for value in rhat.values())])
    return float(values.max()) if values.size else np.nan
