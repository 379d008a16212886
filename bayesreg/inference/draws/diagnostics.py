"""R̂ and effective sample sizes of every estimand."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Int

from bayesreg.inference.draws.blocks import Block, Blocks
from bayesreg.inference.draws.inference_data import DERIVED, STATISTICS, arviz, dataset

# Numbers (8 MB of them) that are judged at once, so that memory does not grow with the draws: ArviZ takes many times as
# much.
AT_ONCE = 2**20


class Convergence(NamedTuple):
    """Diagnostics of every estimand, as datasets shaped like the posterior; NaN where an entry is known.

    Attributes
    ----------
    rhat : xarray.Dataset
        Rank-normalised split R̂ (Vehtari et al. 2021).
    ess_bulk, ess_tail : xarray.Dataset
        Effective sample sizes.
    """

    rhat: xr.Dataset
    ess_bulk: xr.Dataset
    ess_tail: xr.Dataset


def convergence(idata: Any) -> Convergence:
    """R̂ and effective sample sizes of every estimand; of few draws (below 4) all NaN.

    Draws that lie in a file are read in parts.
    """
    draws = dataset(idata, "posterior")
    judged = [_judge(values) for name, values in draws.items() if name not in DERIVED]
    return Convergence(*(xr.merge([found[k] for found in judged]) for k in range(len(Convergence._fields))))


def _judge(draws: xr.DataArray) -> list[xr.DataArray]:
    """R̂, bulk and tail ESS of one variable."""
    others = [dim for dim in draws.dims if dim not in ("chain", "draw")]
    if draws.sizes["draw"] < 4 or draws.size == 0:
        return [xr.full_like(draws.isel(chain=0, draw=0, drop=True), np.nan, float)] * 3
    if not others:
        return _figures(draws.astype(float))
    along = others[0]
    width = max(1, AT_ONCE // (draws.size // draws.sizes[along]))
    parts = [
        _figures(draws.isel({along: slice(first, first + width)}).astype(float))
        for first in range(0, draws.sizes[along], width)
    ]
    return [xr.concat(found, along) for found in zip(*parts, strict=True)]


def _figures(draws: xr.DataArray) -> list[xr.DataArray]:
    draws = draws.compute()
    constant = draws.min(("chain", "draw")) == draws.max(("chain", "draw"))
    return [found[draws.name].where(~constant) for found in _diagnose(draws.to_dataset())]


class Worst(NamedTuple):
    """The greatest rank-normalised split R̂ and the least effective sample sizes of all estimands."""

    rhat: float
    ess_bulk: float
    ess_tail: float


def worst(blocks: Blocks, chosen: Int[np.ndarray, "k"] | None = None) -> Worst:
    """The worst figures of blocks of draws (see `to_inference_data`), of all estimands or of those chosen.

    Estimands are numbered in the order of their names, each as it lies in memory.

    R̂ is infinite, and the effective sample sizes are zero, where there are too few draws, one is not a number, or an
    estimand has stood still in all chains.
    """
    parts = [_worst(part) for part in _columns(blocks, chosen)] if len(blocks) else []
    return Worst(
        max((part.rhat for part in parts), default=np.inf),
        min((part.ess_bulk for part in parts), default=0.0),
        min((part.ess_tail for part in parts), default=0.0),
    )


def _columns(blocks: Blocks, chosen: Int[np.ndarray, "k"] | None) -> Iterator[np.ndarray]:
    """All draws of some of the estimands, (chain, draw, estimand), then of others."""
    first, last = _flat(blocks[0]), _flat(blocks[len(blocks) - 1])
    longest = max(first.shape[1], last.shape[1])
    width = max(1, AT_ONCE // (first.shape[0] * longest * len(blocks)))
    places = np.arange(first.shape[-1]) if chosen is None else chosen
    for low in range(0, len(places), width):
        # Taken by their numbers and so copied: a view would keep its whole block.
        yield np.concatenate([_flat(block)[..., places[low : low + width]] for block in blocks], axis=1)


def _flat(block: Block) -> np.ndarray:
    """All estimands of a block side by side, by name: blocks of one run need not agree in their order."""
    draws = [block[name] for name in sorted(block) if name not in STATISTICS]
    return np.concatenate([values.reshape(*values.shape[:2], -1) for values in draws], axis=-1)


def _worst(draws: np.ndarray) -> Worst:
    if draws.shape[1] < 4:
        return Worst(np.inf, 0.0, 0.0)
    data = xr.Dataset({"draws": (["chain", "draw", "estimand"], draws)})
    rhat, bulk, tail = (found["draws"] for found in _diagnose(data))
    least = (float(ess.where(rhat.notnull(), 0.0).min()) for ess in (bulk, tail))
    return Worst(float(rhat.fillna(np.inf).max()), *least)


def _diagnose(draws: xr.Dataset) -> list[xr.Dataset]:
    """R̂, bulk and tail ESS of every variable."""
    # It takes a second to import, for which the first draws need not wait.
    az = arviz()
    # ArviZ divides zero by zero for what has stood still.
    with np.errstate(invalid="ignore"):
        found = (az.rhat(draws), az.ess(draws, method="bulk"), az.ess(draws, method="tail"))
    return [one if isinstance(one, xr.Dataset) else one.to_dataset() for one in found]
