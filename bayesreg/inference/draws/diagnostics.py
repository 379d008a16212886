"""R̂ and effective sample sizes of every estimand."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from bayesreg.inference.draws.blocks import Block, Blocks
from bayesreg.inference.draws.inference_data import DERIVED, PIECE, STATISTICS, arviz, dataset, to_inference_data
from bayesreg.inference.target import Target

# Both limits keep the memory constant as the draws grow. AT_ONCE numbers (8 MB) are judged at once; ArviZ takes many
# times as much. READ_AT_ONCE numbers (256 MB) are read at once; every block is read again for each part of the
# estimands.
AT_ONCE, READ_AT_ONCE = 2**20, 2**25
# Threads help because sorting and Fourier transforms, which take most of the time, release Python's lock.
MOST_THREADS = 4


class Convergence(NamedTuple):
    """Diagnostics of every estimand, as datasets shaped like the posterior; known entries are NaN.

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


class Worst(NamedTuple):
    """The greatest rank-normalised split R̂ and the least effective sample sizes of all estimands."""

    rhat: float
    ess_bulk: float
    ess_tail: float


class Figures(NamedTuple):
    """Diagnostics of estimands as flat arrays; NaN with too few draws, or if all draws of an estimand are equal.

    Attributes
    ----------
    rhat : (k,) array
        Rank-normalised split R̂.
    ess_bulk, ess_tail : (k,) arrays
        Effective sample sizes.
    """

    rhat: Float[np.ndarray, "k"]
    ess_bulk: Float[np.ndarray, "k"]
    ess_tail: Float[np.ndarray, "k"]

    @property
    def worst(self) -> Worst:
        """The greatest R̂ and the least effective sample sizes of all estimands.

        R̂ is infinite and the effective sample sizes are zero if one R̂ is unknown or there is no estimand.
        """
        if not self.rhat.size:
            return Worst(np.inf, 0.0, 0.0)
        unknown = np.isnan(self.rhat)
        least = (float(np.where(unknown, 0.0, ess).min()) for ess in (self.ess_bulk, self.ess_tail))
        return Worst(float(np.where(unknown, np.inf, self.rhat).max()), *least)


def convergence(idata: Any) -> Convergence:
    """Compute R̂ and effective sample sizes of every estimand; all are NaN with fewer than 4 draws.

    Draws in a file are read in parts.
    """
    draws = dataset(idata, "posterior")
    judged = [_judge(values) for name, values in draws.items() if name not in DERIVED]
    return Convergence(*(xr.merge([diagnostics[k] for diagnostics in judged]) for k in range(len(Convergence._fields))))


def _judge(draws: xr.DataArray) -> list[xr.DataArray]:
    """Compute R̂, bulk and tail ESS of one variable."""
    draws = draws.transpose("chain", "draw", ...)
    like = draws.isel(chain=0, draw=0, drop=True)
    figures_by_block = [_diagnose(block.to_numpy().reshape(*block.shape[:2], -1)) for block in _parts(draws)]
    return [
        xr.DataArray(np.concatenate([np.zeros(0), *pieces]).reshape(like.shape), like.coords, like.dims, like.name)
        for pieces in zip(*figures_by_block, strict=True)
    ]


def _parts(draws: xr.DataArray) -> Iterator[xr.DataArray]:
    """Yield all draws of one range of entries after the other, in whole pieces of a file."""
    if draws.ndim == 2:
        yield draws
        return
    along, of_entry = draws.dims[2], math.prod(draws.shape[:2]) * math.prod(draws.shape[3:])
    width = max(1, READ_AT_ONCE // max(1, of_entry))
    width = width // PIECE * PIECE or width
    for first in range(0, max(1, draws.sizes[along]), width):
        yield draws.isel({along: slice(first, first + width)})


def figures(blocks: Blocks, chosen: Int[np.ndarray, "k"] | None = None) -> Figures:
    """Compute the figures of all or of the chosen estimands from blocks of draws (see `to_inference_data`).

    Estimands are numbered in the order of their names; the entries of each are numbered in C order.
    """
    figures_by_block = [_diagnose(columns) for columns in _columns(blocks, chosen)] if len(blocks) else []
    return (
        Figures(*map(np.concatenate, zip(*figures_by_block, strict=True)))
        if figures_by_block
        else Figures(*(np.zeros(0),) * 3)
    )


def worst(blocks: Blocks, chosen: Int[np.ndarray, "k"] | None = None) -> Worst:
    """Compute the worst figures of all or of the chosen estimands, numbered as in `figures`."""
    return figures(blocks, chosen).worst


def labelled(target: Target, blocks: Blocks, all_figures: Figures) -> Convergence:
    """Convert the figures of all estimands to datasets, equal to those that `convergence` returns for these draws."""
    first = blocks[0]
    names, statistics = _names(first), {name: np.zeros((1, 1)) for name in STATISTICS}
    shapes = [first[name].shape[2:] for name in names]
    ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]

    def variables(figure: np.ndarray) -> xr.Dataset:
        """Arrange one figure of each estimand as the variables of one draw."""
        entries = zip(names, np.split(figure, ends), shapes, strict=True)
        block = {name: values.reshape(1, 1, *shape) for name, values, shape in entries}
        data = dataset(to_inference_data(target, [block | statistics]), "posterior")
        return data.isel(chain=0, draw=0, drop=True).drop_vars(DERIVED, errors="ignore")

    # An entry that does not depend on the estimands is known.
    zeros, ones = (variables(np.full(all_figures.rhat.shape, value)) for value in (0.0, 1.0))
    return Convergence(*(variables(figure).where(zeros != ones) for figure in all_figures))


def _columns(blocks: Blocks, chosen: Int[np.ndarray, "k"] | None) -> Iterator[np.ndarray]:
    """Yield all draws (chain, draw, estimand) of one group of estimands after the other."""
    first, last = _flat(blocks[0]), _flat(blocks[len(blocks) - 1])
    chains, length, count = first.shape
    draws = length * (len(blocks) - 1) + last.shape[1]
    places = np.arange(count) if chosen is None else chosen
    width = max(1, READ_AT_ONCE // max(1, chains * draws))
    for low in range(0, len(places), width):
        # An index array makes a copy; a view would keep its whole block in memory.
        yield np.concatenate([_flat(block)[..., places[low : low + width]] for block in blocks], axis=1)


def _flat(block: Block) -> np.ndarray:
    """Concatenate all estimands of a block, sorted by name: blocks of one run may differ in their order."""
    return np.concatenate([block[name].reshape(*block[name].shape[:2], -1) for name in _names(block)], axis=-1)


def _names(block: Block) -> list[str]:
    return sorted(name for name in block if name not in STATISTICS)


def _diagnose(draws: Float[np.ndarray, "chain draw k"]) -> Figures:
    """Compute R̂, bulk and tail ESS of the columns of an array."""
    chains, length, count = draws.shape
    if length < 4 or not count:
        return Figures(*(np.full(count, np.nan),) * 3)
    # The import takes a second, so it is left until there are enough draws.
    az = arviz()
    width = max(1, AT_ONCE // (chains * length))

    def judge(low: int) -> Figures:
        block = draws[..., low : low + width].astype(float)
        varying = block.min(axis=(0, 1)) != block.max(axis=(0, 1))
        data = xr.Dataset({"draws": (["chain", "draw", "estimand"], block)})
        # ArviZ divides zero by zero if all draws of an estimand are equal.
        with np.errstate(invalid="ignore"):
            diagnostics = az.rhat(data), az.ess(data, method="bulk"), az.ess(data, method="tail")
        return Figures(*(np.where(varying, diagnostic["draws"].to_numpy(), np.nan) for diagnostic in diagnostics))

    # On a shared machine the process may be allowed to use only some of the cores.
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with ThreadPoolExecutor(min(MOST_THREADS, cores)) as pool:
        figures_by_block = list(pool.map(judge, range(0, count, width)))
    return Figures(*map(np.concatenate, zip(*figures_by_block, strict=True)))
