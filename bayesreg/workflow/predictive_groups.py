"""Compute ArviZ's groups of the observations: observed_data, posterior_predictive and log_likelihood."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import xarray as xr
from jaxtyping import Float

from bayesreg.inference.draws.predictive import evenly_spaced, push_forward, thin
from bayesreg.model import coordinates
from bayesreg.model.observations.observation import Recordable, Recorded
from bayesreg.model.posterior import Posterior
from bayesreg.model.state import State, state_of
from bayesreg.types import AnyArray

# The largest number of draws, of all chains together, that have replicated observations.
MOST_DRAWS = 400

Groups = dict[str, xr.Dataset]
Variables = dict[str, xr.DataArray]


def predictive_groups(posterior: Posterior, draws: xr.Dataset, seed: int) -> Groups:
    """Compute the observations and their replicates by the draws, in the groups that ArviZ names.

    Parameters
    ----------
    posterior : Posterior
    draws : xarray.Dataset
        The group `posterior` of the run.
    seed : int
        The seed of the replicated noise.

    Returns
    -------
    dict
        One Dataset per group, with one variable per observation. Landmarks: displacements (…, point, axis), mm. Images:
        intensities, as they are compared, at up to 1,000 evenly spaced quadrature points. `posterior_predictive` has up
        to 400 evenly spaced draws. `log_likelihood` (chain, draw, point) has all draws and only landmarks, with its
        normaliser, as leave-one-out needs it. It has no images, because their voxels depend on one another: the
        neighbours of a voxel that is left out predict it.
    """
    recorded = {
        name: observation.recorded(posterior.data.terms[name])
        for name, observation in posterior.observations.items()
        if isinstance(observation, Recordable)
    }
    if not recorded:
        return {}
    chosen = evenly_spaced(draws.sizes["draw"], max(MOST_DRAWS // draws.sizes["chain"], 1))
    thinned = draws.isel(draw=chosen)
    replicated = {}
    for name, values in _replicate(posterior, thinned, recorded, seed).items():
        like = recorded[name].values
        coords = {"chain": thinned["chain"], "draw": thinned["draw"], **like.coords}
        replicated[name] = xr.DataArray(
            values.astype(np.float32), coords, ("chain", "draw", *like.dims), attrs=like.attrs
        )
    groups: dict[str, Variables] = {
        "observed_data": {name: record.values for name, record in recorded.items()},
        "posterior_predictive": replicated,
        "log_likelihood": _log_likelihood(posterior, draws, recorded),
    }
    return {group: xr.Dataset(content) for group, content in groups.items() if content}


def _replicate(
    posterior: Posterior, draws: xr.Dataset, recorded: Mapping[str, Recorded], seed: int
) -> dict[str, np.ndarray]:
    """Replicate the observations by each draw, (chain, draw, …) by observation."""
    key = jax.random.key(seed)

    def forward(draw: dict[str, AnyArray], data: Any) -> dict[str, AnyArray]:
        of_draw = jax.random.fold_in(key, draw.pop("number").astype(int))
        state = _state(posterior, data, draw)
        keys = jax.random.split(of_draw, len(recorded))
        return {
            name: data.terms[name].likelihood(state).sample(key)[record.chosen]
            for (name, record), key in zip(recorded.items(), keys, strict=True)
        }

    all_draws = _all(posterior, draws)
    chains, count = all_draws["u_boundary"].shape[:2]
    all_draws["number"] = np.arange(chains * count, dtype=float).reshape(chains, count)
    blocks = list(push_forward(forward, all_draws, posterior.data))
    return {name: np.concatenate([block[name] for block in blocks], axis=1) for name in recorded}


def _log_likelihood(posterior: Posterior, draws: xr.Dataset, recorded: Mapping[str, Recorded]) -> Variables:
    """Compute the log likelihood of every value by every draw, for observations with independent values."""
    terms = posterior.data.terms
    names = [name for name in recorded if hasattr(terms[name], "pointwise_log_likelihood")]
    if not names:
        return {}

    def forward(draw: dict[str, AnyArray], data: Any) -> dict[str, Float[AnyArray, "points"]]:
        state = _state(posterior, data, draw)
        return {name: data.terms[name].pointwise_log_likelihood(state) for name in names}

    blocks = list(push_forward(forward, _all(posterior, draws), posterior.data))
    coords = {"chain": draws["chain"].to_numpy(), "draw": draws["draw"].to_numpy()}
    log_likelihoods = {}
    for name in names:
        dim = recorded[name].values.dims[0]
        values = np.concatenate([block[name] for block in blocks], axis=1)
        labels = recorded[name].values[dim].to_numpy()
        log_likelihoods[name] = xr.DataArray(values, {**coords, str(dim): labels}, ("chain", "draw", dim))
    return log_likelihoods


def _state(posterior: Posterior, data: Any, draw: dict[str, AnyArray]) -> State:
    return state_of(data.body, data.blocks, coordinates.fill(data.blocks, draw))


def _all(posterior: Posterior, draws: xr.Dataset) -> dict[str, np.ndarray]:
    names = [name for name in posterior.reference() if name in draws]
    return thin(draws, names, draws.sizes["draw"] * draws.sizes["chain"])
