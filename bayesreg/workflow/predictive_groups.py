"""What ArviZ wants to know of the observations: groups observed_data, posterior_predictive and log_likelihood."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax.scipy.stats import norm
from jaxtyping import Float

from bayesreg.inference.draws.predictive import evenly_spaced, push_forward, thin
from bayesreg.model import coordinates
from bayesreg.model.posterior import Posterior
from bayesreg.model.state import State, state_of
from bayesreg.model.terms.images import ComparedImages
from bayesreg.model.terms.landmarks import ComparedPoints
from bayesreg.types import AnyArray

# Replicated observations: draws of all chains together, and quadrature points of a pair of images.
MOST_DRAWS, MOST_POINTS = 400, 1000

Groups = dict[str, xr.Dataset]
Variables = dict[str, xr.DataArray]


def predictive_groups(posterior: Posterior, draws: xr.Dataset, seed: int) -> Groups:
    """Observations, and what the model would have observed by the draws, as ArviZ names them.

    Parameters
    ----------
    posterior : Posterior
    draws : xarray.Dataset
        The group `posterior` of the run.
    seed : int
        Of the replicated noise.

    Returns
    -------
    dict
        A Dataset by group, each with a variable by observation. Landmarks: displacements (…, point, axis), mm. Images:
        intensities, as they are compared, at up to 1,000 evenly spaced quadrature points. `posterior_predictive` has up
        to 400 evenly spaced draws. `log_likelihood` (chain, draw, point) has all draws of landmarks alone, with its
        normaliser, as leave-one-out needs it: voxels of an image depend on one another, and one that is left out is
        told by those beside it.
    """
    observed: Variables = {}
    replicated: Variables = {}
    for name, term in posterior.data.terms.items():
        if isinstance(term, ComparedImages):
            points = evenly_spaced(len(term.positions), MOST_POINTS)
            dim, unit = f"{name}_point", {"units": "1", "long_name": "intensity of the fixed image, as it is compared"}
            where = {"units": "mm", "long_name": "position of the point in the fixed image, world RAS"}
            places = zip("xyz", np.asarray(term.positions)[points].T, strict=True)
            labels: dict[str, Any] = {dim: points} | {f"{name}_{axis}": (dim, place, where) for axis, place in places}
            observed[name] = xr.DataArray(np.asarray(term.fixed_values)[points], labels, [dim], attrs=unit)
        elif isinstance(term, ComparedPoints):
            labels = {f"{name}_point": list(posterior.observations[name].labels), "axis": list("xyz")}
            unit = {"units": "mm", "long_name": "displacement of the landmarks, world RAS"}
            observed[name] = xr.DataArray(np.asarray(term.shift), labels, list(labels), attrs=unit)
    if not observed:
        return {}
    chosen = evenly_spaced(draws.sizes["draw"], max(MOST_DRAWS // draws.sizes["chain"], 1))
    some = draws.isel(draw=chosen)
    for name, values in _replicate(posterior, some, list(observed), seed).items():
        like = observed[name]
        coords = {"chain": some["chain"], "draw": some["draw"], **like.coords}
        replicated[name] = xr.DataArray(values, coords, ("chain", "draw", *like.dims), attrs=like.attrs)
    found = {"observed_data": observed, "posterior_predictive": replicated}
    if likelihood := _log_likelihood(posterior, draws):
        found["log_likelihood"] = likelihood
    return {group: xr.Dataset(content) for group, content in found.items()}


def _replicate(posterior: Posterior, draws: xr.Dataset, names: list[str], seed: int) -> dict[str, np.ndarray]:
    """What each draw would have observed, (chain, draw, …) by observation."""
    key = jax.random.key(seed)

    def forward(draw: dict[str, AnyArray], data: Any) -> dict[str, AnyArray]:
        of_draw = jax.random.fold_in(key, draw.pop("number").astype(int))
        state = _state(posterior, data, draw)
        keys = jax.random.split(of_draw, len(names))
        return {name: _observe(data.terms[name], state, one) for name, one in zip(names, keys, strict=True)}

    every = _all(posterior, draws)
    chains, count = every["u_boundary"].shape[:2]
    every["number"] = np.arange(chains * count, dtype=float).reshape(chains, count)
    blocks = list(push_forward(forward, every, posterior.data))
    return {name: np.concatenate([block[name] for block in blocks], axis=1) for name in names}


def _observe(term: ComparedImages | ComparedPoints, state: State, key: AnyArray) -> AnyArray:
    """One replication of an observation."""
    if isinstance(term, ComparedPoints):
        mean = term.predicted(state)
        return mean + term.sd(state.values)[:, None] * jax.random.normal(key, mean.shape)
    # The part of f that noise explains gives way to another.
    scale = jnp.sqrt(term.temperature(state.values) / (2 * term.quadrature.weights))
    noise = scale * term.standardised_noise(key, state.u, state.values)
    replicated = term.fixed_values - term.residuals(state.u, state.values) + noise
    return replicated[evenly_spaced(len(term.positions), MOST_POINTS)]


def _log_likelihood(posterior: Posterior, draws: xr.Dataset) -> Variables:
    """The log likelihood of every landmark by every draw."""
    names = [name for name, term in posterior.data.terms.items() if isinstance(term, ComparedPoints)]
    if not names:
        return {}

    def forward(draw: dict[str, AnyArray], data: Any) -> dict[str, Float[AnyArray, "points"]]:
        state = _state(posterior, data, draw)
        terms = {name: data.terms[name] for name in names}
        return {
            name: norm.logpdf(term.shift, term.predicted(state), term.sd(state.values)[:, None]).sum(axis=1)
            for name, term in terms.items()
        }

    blocks = list(push_forward(forward, _all(posterior, draws), posterior.data))
    coords = {"chain": draws["chain"].to_numpy(), "draw": draws["draw"].to_numpy()}
    return {
        name: xr.DataArray(
            np.concatenate([block[name] for block in blocks], axis=1),
            {**coords, f"{name}_point": list(posterior.observations[name].labels)},
            ("chain", "draw", f"{name}_point"),
        )
        for name in names
    }


def _state(posterior: Posterior, data: Any, draw: dict[str, AnyArray]) -> State:
    return state_of(data.body, data.blocks, coordinates.fill(data.blocks, draw))


def _all(posterior: Posterior, draws: xr.Dataset) -> dict[str, np.ndarray]:
    names = [name for name in posterior.reference() if name in draws]
    return thin(draws, names, draws.sizes["draw"] * draws.sizes["chain"])
