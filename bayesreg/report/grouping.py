"""Groups of chains that sample the same region of the posterior."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components

from bayesreg.inference.draws.inference_data import DERIVED
from bayesreg.report.estimands import MOST_VALUES
from bayesreg.types import AnyArray

# Chains belong to different groups if this many of their standard deviations separate them in several estimands.
SEPARATION_SD = 3.0
MIN_SEPARATED_ESTIMANDS = 3


class Grouping(NamedTuple):
    """The groups of chains with similar means.

    Attributes
    ----------
    label : (chains,) int array
        Group of each chain, numbered from 0 in the order of their first chains.
    drifting : (chains,) bool array
        Whether the halves of a chain differ, as in a chain that has not converged yet.
    """

    label: Int[np.ndarray, "chains"]
    drifting: Bool[np.ndarray, "chains"]

    @property
    def groups(self) -> int:
        """The number of groups."""
        return int(self.label.max()) + 1

    def chains(self, group: int) -> np.ndarray:
        """Return the chains of a group."""
        return np.flatnonzero(self.label == group)


def grouping(posterior: xr.Dataset) -> Grouping:
    """Group chains whose means lie close together, relative to the standard deviation within chains."""
    values = _values(posterior)
    means, variances = values.mean(axis=1), values.var(axis=1)
    distances = np.array(
        [[_distance(_separation(means, variances, i, j)) for j in range(len(means))] for i in range(len(means))]
    )
    _, label = connected_components(distances < SEPARATION_SD, directed=False)
    return Grouping(_renumber(label), np.array([_drifts(chain) for chain in values]))


def _renumber(label: np.ndarray) -> np.ndarray:
    _, first = np.unique(label, return_index=True)
    return np.argsort(np.argsort(first))[label]


def _values(posterior: xr.Dataset) -> Float[np.ndarray, "chains draws estimands"]:
    """Return all estimands as columns of one array."""
    posterior = thin(posterior)
    draws = [values.transpose("chain", "draw", ...) for name, values in posterior.items() if name not in DERIVED]
    flat = [values.to_numpy().reshape(*values.shape[:2], -1) for values in draws]
    return np.concatenate(flat, axis=-1).astype(float)


def thin(posterior: xr.Dataset) -> xr.Dataset:
    """Thin the draws evenly if they would need much memory."""
    numbers = sum(values.size for name, values in posterior.items() if name not in DERIVED)
    return posterior.isel(draw=slice(None, None, max(1, numbers // MOST_VALUES)))


def _separation(means: np.ndarray, variances: np.ndarray, i: int, j: int) -> Float[np.ndarray, "estimands"]:
    """Return the distance of two means in standard deviations; zero if both chains are constant and equal."""
    gap, within = np.abs(means[i] - means[j]), np.sqrt((variances[i] + variances[j]) / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(gap > 0, gap / within, 0.0)


def _distance(separation: np.ndarray) -> float:
    """Return the separation that several estimands reach: a single one may differ by chance or in a tail."""
    rank = min(MIN_SEPARATED_ESTIMANDS, len(separation))
    return float(np.partition(separation, -rank)[-rank])


def _drifts(chain: Float[np.ndarray, "draws estimands"]) -> bool:
    halves = np.array_split(chain, 2)
    if len(halves[0]) < 2 or len(halves[1]) < 2:
        return True
    means, variances = (np.stack([getattr(half, figure)(axis=0) for half in halves]) for figure in ("mean", "var"))
    return _distance(_separation(means, variances, 0, 1)) >= SEPARATION_SD


def group_means(chain_means: Float[AnyArray, "chains *shape"], groups: Grouping) -> Float[np.ndarray, "groups *shape"]:
    """Compute the mean over the chains of each group."""
    return np.stack([np.asarray(chain_means)[groups.chains(k)].mean(axis=0) for k in range(groups.groups)])
