"""Draws to ArviZ and back; R̂, effective sample sizes and Monte Carlo errors of every estimand.

The one module that knows which ArviZ it has: 0.23 (InferenceData) and 1.x (xarray.DataTree) differ in
how draws are handed over, and read each other's NetCDF files.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import arviz as az
import numpy as np
import xarray as xr

from bayesreg.inference.target import Target
from bayesreg.types import InputError

_OLD = int(az.__version__.split(".")[0]) < 1

STATISTICS = (
    "lp", "acceptance_rate", "similarity_energy", "strain_energy", "solver_iterations", "solver_failed",
    "outside_support", "diverging", "gradients",
)  # fmt: skip
# Estimands besides u_boundary, λ and μ, which only some posteriors have.
OTHERS = ("t_similarity", "t_elastic", "field_sd", "field")
_DIMS = {
    "u_boundary": ["node", "axis"],
    "lam": ["tissue"],
    "mu": ["tissue"],
    "ratio": ["tissue"],
    "field": ["mode"],
    "points": ["point", "axis"],
    "cells": ["cell", "corner"],
    "tissue": ["cell"],
    "boundary": ["node"],
}


def to_inference_data(target: Target, blocks: list[dict[str, np.ndarray]]) -> Any:
    """Blocks of draws as ArviZ data.

    Parameters
    ----------
    target : Target
        For the known entries of λ and μ and the names of all of them.
    blocks : list of mappings
        Arrays (chain, draw, …) of the estimands and of `STATISTICS`.

    Returns
    -------
    arviz.InferenceData or xarray.DataTree
        posterior: u_boundary (chain, draw, node, axis) in mm, lam, mu and ratio = λ/μ (chain, draw, tissue),
        known entries included, where they were sampled t_similarity, t_elastic, field_sd (chain, draw) and
        field (chain, draw, mode), the components of the log-stiffness; sample_stats;
        constant_data.
    """
    draws = {name: np.concatenate([block[name] for block in blocks], axis=1) for name in blocks[0]}
    estimands = {name: value for name, value in draws.items() if name not in STATISTICS}
    values = {"u_boundary": estimands["u_boundary"], **_completed(target, estimands)}
    with np.errstate(divide="ignore", invalid="ignore"):
        values["ratio"] = values["lam"] / values["mu"]
    values |= {name: estimands[name] for name in OTHERS if name in estimands}
    groups: dict[str, Any] = {
        "posterior": values,
        "sample_stats": {name: draws[name] for name in STATISTICS},
        "constant_data": {name: np.asarray(value) for name, value in target.constant_data().items()},
    }
    coords = {"node": np.asarray(target.sampled), "axis": list("xyz"), "tissue": list(target.entry_names)}
    return (
        az.from_dict(**groups, coords=coords, dims=_DIMS) if _OLD else az.from_dict(groups, coords=coords, dims=_DIMS)
    )


def to_block(target: Target, idata: Any) -> dict[str, np.ndarray]:
    """All draws as one block: the inverse of `to_inference_data`."""
    posterior, statistics = dataset(idata, "posterior"), dataset(idata, "sample_stats")
    block = {}
    for name in target.estimands(target.reference()):
        values = np.asarray(posterior[name].values, float)
        block[name] = values[..., np.asarray(target.free[name])] if name in target.free else values
    return block | {name: statistics[name].values for name in STATISTICS}


def _completed(target: Target, estimands: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """λ and μ with their known entries, on the host: there may be many draws."""
    reference = target.reference()
    found = {}
    for name in ("lam", "mu"):
        known = np.asarray(reference[name])
        full = np.tile(known, (*estimands["u_boundary"].shape[:2], 1))
        if name in estimands:
            full[..., np.asarray(target.free[name])] = estimands[name]
        found[name] = full
    return found


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
    """R̂ and effective sample sizes of every estimand; of few draws (below 4) all NaN."""
    draws = dataset(idata, "posterior")
    posterior = draws[["u_boundary", "lam", "mu", *(name for name in OTHERS if name in draws)]]
    if posterior.sizes["draw"] < 4:
        nothing = xr.full_like(posterior.isel(chain=0, draw=0, drop=True), np.nan)
        return Convergence(nothing, nothing, nothing)
    constant = posterior.min(("chain", "draw")) == posterior.max(("chain", "draw"))
    # ArviZ divides zero by zero for the known entries, which are left out below.
    with np.errstate(invalid="ignore"):
        found = (az.rhat(posterior), az.ess(posterior, method="bulk"), az.ess(posterior, method="tail"))
    return Convergence(*(_plain(result).where(~constant) for result in found))


class Worst(NamedTuple):
    """The greatest rank-normalised split R̂ and the least effective sample sizes of all estimands."""

    rhat: float
    ess_bulk: float
    ess_tail: float


def worst(blocks: list[dict[str, np.ndarray]]) -> Worst:
    """The worst figures of blocks of draws (see `to_inference_data`).

    R̂ is infinite, and the effective sample sizes are zero, where there are too few draws, one is not a number, or an
    estimand has stood still in all chains.
    """
    names = [name for name in blocks[0] if name not in STATISTICS] if blocks else []
    draws = {name: np.concatenate([block[name] for block in blocks], axis=1) for name in names}
    if not draws or next(iter(draws.values())).shape[1] < 4:
        return Worst(np.inf, 0.0, 0.0)
    data = xr.Dataset(
        {name: (["chain", "draw", *(f"{name}_{k}" for k in range(x.ndim - 2))], x) for name, x in draws.items()}
    )
    moving = [name for name, x in draws.items() if x.size]
    # ArviZ divides zero by zero for what has stood still.
    with np.errstate(invalid="ignore"):
        rhat, bulk, tail = (_plain(found) for found in (az.rhat(data), az.ess(data), az.ess(data, method="tail")))
    return Worst(
        max(float(rhat[name].fillna(np.inf).max()) for name in moving),
        *(min(float(ess[name].where(rhat[name].notnull(), 0.0).min()) for name in moving) for ess in (bulk, tail)),
    )


def _plain(result: Any) -> xr.Dataset:
    return result if isinstance(result, xr.Dataset) else result.to_dataset()


def dataset(idata: Any, group: str) -> xr.Dataset:
    """One group of the draws as an xarray Dataset, whichever ArviZ made them."""
    found = getattr(idata, group)
    return found if isinstance(found, xr.Dataset) else found.to_dataset()


def save_posterior(idata: Any, path: str | Path) -> None:
    """Write draws as NetCDF, displacements in single precision and compressed."""
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    groups = idata.groups() if _OLD else [name.strip("/") for name in idata.groups if name != "/"]
    for index, group in enumerate(groups):
        data = dataset(idata, group)
        compact = {"dtype": "float32", "zlib": True, "complevel": 1}
        encoding = {"u_boundary": compact} if "u_boundary" in data else {}
        data.to_netcdf(partial, mode="w" if index == 0 else "a", group=group, engine="netcdf4", encoding=encoding)
    partial.replace(path)


def open_posterior(path: str | Path) -> Any:
    """Read draws written by `save_posterior`; InputError where there are none."""
    if not Path(path).is_file():
        raise InputError(f"{path} is missing: the folder holds no draws")
    return az.from_netcdf(str(path))
