"""The estimands of a run, one by one: their names, places, convergence figures and draws."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from bayesreg.mesh import TetMesh
from bayesreg.report.places import regions

SYMBOLS = {
    "lam": "λ",
    "mu": "μ",
    "ratio": "λ/μ",
    "t_similarity": "T_s",
    "t_elastic": "T_r",
    "body_load": "sd of the random loads inside",
    "surface_load": "sd of the random loads at the surface",
    "field_sd": "sd of the log-stiffness",
    "field": "component of the log-stiffness",
}
DISPLACEMENT = "u_boundary"
AXES = ("x", "y", "z")
MOST_VALUES = 10_000_000


class Estimand(NamedTuple):
    """One sampled scalar, with its convergence figures.

    Attributes
    ----------
    variable : str
        Name in the posterior.
    position : tuple of int
        The index in that variable's array, after chain and draw.
    name : str
        The name in the report, such as "u_x of node 12" or "λ tumour".
    place : tuple of float or None
        World position of its node, mm.
    rhat, ess_bulk, ess_tail : float
        NaN where undefined (chains that never moved, say).
    region : str
        The place in words; empty if the entry has none.
    """

    variable: str
    position: tuple[int, ...]
    name: str
    place: tuple[float, float, float] | None
    rhat: float
    ess_bulk: float
    ess_tail: float
    region: str = ""

    @property
    def badness(self) -> float:
        """The R-hat for sorting: an undefined R-hat is the greatest."""
        return self.rhat if np.isfinite(self.rhat) else np.inf


class Diagnosed(NamedTuple):
    """Convergence figures of all draws: xarray Datasets with the posterior's variables, NaN where not sampled."""

    rhat: xr.Dataset
    ess_bulk: xr.Dataset
    ess_tail: xr.Dataset


def estimands(mesh: TetMesh, diagnosed: Diagnosed, posterior: xr.Dataset) -> list[Estimand]:
    """List every sampled entry of every variable, in the posterior's order.

    An entry of λ or μ without any convergence figure that is equal in all draws was fixed, and is not listed. An entry
    that never moved within its chain is listed, and so is a displacement that never moved at all. Derived quantities
    (the ratios) are left out.
    """
    entries = []
    for variable in diagnosed.rhat.data_vars:
        name = str(variable)
        if name in posterior and name != "ratio":
            entries += _entries(mesh, diagnosed, posterior[name])
    return entries


def _entries(mesh: TetMesh, diagnosed: Diagnosed, draws: xr.DataArray) -> list[Estimand]:
    name = str(draws.name)
    dims = [dim for dim in draws.dims if dim not in ("chain", "draw")]
    figures = np.stack(
        [np.asarray(statistic[name].transpose(*dims).to_numpy(), float) for statistic in diagnosed], axis=-1
    )
    sampled = ~np.isnan(figures).all(axis=-1)
    if name == DISPLACEMENT:
        sampled[...] = True
    elif not sampled.all():
        spread = draws.max(("chain", "draw")) - draws.min(("chain", "draw"))
        sampled |= spread.transpose(*dims).to_numpy() > 0
    naming = _Naming(name, mesh, *_coordinates(draws, dims))
    indices = [tuple(index) for index in np.argwhere(sampled).tolist()]
    places = [naming.place(index) for index in indices]
    existing_places = [place for place in places if place is not None]
    words = iter(regions(mesh, np.array(existing_places).reshape(-1, 3)))
    where = ["" if place is None else next(words) for place in places]
    entries = []
    for index, place, region in zip(indices, places, where, strict=True):
        rhat, bulk, tail = (float(value) for value in figures[index])
        entries.append(Estimand(name, index, naming.name(index), place, rhat, bulk, tail, region))
    return entries


def _coordinates(draws: xr.DataArray, dims: list) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return node indices of a displacement, or the labels of other parameters."""
    if "node" in dims:
        return draws["node"].to_numpy(), None
    return None, draws[dims[0]].to_numpy() if dims else None


class _Naming(NamedTuple):
    variable: str
    mesh: TetMesh
    nodes: np.ndarray | None
    labels: np.ndarray | None

    def name(self, index: tuple[int, ...]) -> str:
        symbol = symbol_of(self.variable)
        if self.nodes is not None:
            return f"u_{AXES[index[1]]} of node {int(self.nodes[index[0]])}"
        if self._by_element:
            return f"{symbol} of element {index[0]}"
        return symbol if self.labels is None else f"{symbol} {self.labels[index[0]]}"

    def place(self, index: tuple[int, ...]) -> tuple[float, float, float] | None:
        if self.nodes is not None:
            point = self.mesh.points[int(self.nodes[index[0]])]
        elif self._by_element:
            point = self.mesh.points[self.mesh.cells[index[0]]].mean(axis=0)
        else:
            return None
        return float(point[0]), float(point[1]), float(point[2])

    @property
    def _by_element(self) -> bool:
        return self.labels is not None and len(self.labels) == len(self.mesh.cells)


def worst(entries: Sequence[Estimand], count: int) -> list[Estimand]:
    """Return the entries with the greatest R-hat, in decreasing order."""
    return sorted(entries, key=lambda entry: -entry.badness)[:count]


def above(entries: Sequence[Estimand], threshold: float) -> int:
    """Count the entries whose R-hat is not below a threshold."""
    return sum(not entry.rhat < threshold for entry in entries)


def draws_of(posterior: xr.Dataset, entry: Estimand, max_draws: int) -> np.ndarray:
    """Return the draws of one estimand, (chain, draw), evenly thinned to about `max_draws` per chain."""
    draws = posterior[entry.variable]
    dims = [dim for dim in draws.dims if dim not in ("chain", "draw")]
    stride = max(1, draws.sizes["draw"] // max_draws)
    chosen = draws.isel({"draw": slice(None, None, stride), **dict(zip(dims, entry.position, strict=True))})
    return np.asarray(chosen.transpose("chain", "draw").to_numpy(), float)


def sampled_scales(posterior: xr.Dataset) -> list[str]:
    """Return the names of temperatures, loads and sds of observations: positive scalars that vary over the draws."""
    scales = (str(name) for name, draws in posterior.data_vars.items() if set(draws.dims) == {"chain", "draw"})
    return [name for name in scales if name != "field_sd" and np.ptp(posterior[name].to_numpy()) > 0]


def symbol_of(name: str) -> str:
    """Return the symbol of a variable in a report; the scales of an observation have its name."""
    if name in SYMBOLS:
        return SYMBOLS[name]
    if name.endswith("_t_similarity"):
        return f"T_s of {name.removesuffix('_t_similarity')}"
    return name.removesuffix("_sd") + " sd, mm" if name.endswith("_sd") else name.replace("_", " ")


class Group(NamedTuple):
    """Elastic parameters that belong together: of one tissue, or of the whole domain.

    Attributes
    ----------
    name : str
    lam, mu : (chain, draw, entries) arrays
        One entry, or one for each element of the tissue.
    """

    name: str
    lam: np.ndarray
    mu: np.ndarray

    @property
    def ratio(self) -> np.ndarray:
        """The ratio λ/μ, NaN if it is undefined."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = self.lam / self.mu
        return np.where(np.isfinite(ratio), ratio, np.nan)


def elastic_draws(posterior: xr.Dataset, max_draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Return λ and μ as (chain, draw, entry), thinned to about `max_draws` per chain, fewer for very many entries."""
    entries = max(1, posterior["lam"].size // posterior.sizes["draw"])
    stride = max(1, posterior.sizes["draw"] // min(max_draws, max(20, MOST_VALUES // entries)))
    thinned = posterior[["lam", "mu"]].isel(draw=slice(None, None, stride)).transpose("chain", "draw", ...)
    return np.asarray(thinned["lam"].to_numpy(), float), np.asarray(thinned["mu"].to_numpy(), float)


def parameter_groups(mesh: TetMesh, posterior: xr.Dataset, max_draws: int = 5000) -> list[Group]:
    """Return the draws of λ and μ by tissue, as one uniform group, or, if sampled by element, gathered by tissue."""
    lam, mu = elastic_draws(posterior, max_draws)
    if lam.shape[-1] == 1:
        return [Group("uniform", lam, mu)]
    if lam.shape[-1] == len(mesh.names):
        return [Group(name, lam[..., [k]], mu[..., [k]]) for k, name in enumerate(mesh.names)]
    by_tissue = [np.flatnonzero(mesh.tissue == k) for k in range(len(mesh.names))]
    return [
        Group(name, lam[..., entries], mu[..., entries])
        for name, entries in zip(mesh.names, by_tissue, strict=True)
        if len(entries)
    ]
