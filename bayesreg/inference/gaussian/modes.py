"""The modes about which the chains start: one for all of them, or one that is found from the start of each."""

from __future__ import annotations

import logging
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayesreg.inference.deadline import NEVER, Deadline
from bayesreg.inference.gaussian.laplace import Gaussian, laplace
from bayesreg.inference.gaussian.mode_search import approach, find_mode, improve, settle
from bayesreg.inference.layout import flat_position, unravel
from bayesreg.inference.target import Target, estimands_of, logdensity

_log = logging.getLogger(__name__)

# Two modes count as one if no coordinate differs by more than this number of its standard deviations.
SAME = 1.0


class Modes(NamedTuple):
    """The modes of a posterior, and the mode of each chain.

    Attributes
    ----------
    gaussians : list of Gaussian
        Laplace's approximation about each mode; the mode of the highest density comes first.
    chains : (chains,) list of int
        The number of the mode of each chain.
    """

    gaussians: list[Gaussian]
    chains: list[int]


def search_modes(target: Target, points: Any, each: bool, deadline: Deadline = NEVER) -> Modes:
    """Search for modes from the start points (chains as the leading axis): one from their mean, or one from each.

    One search costs as much as a short run, and searches from other starts seldom end at another mode. At the deadline
    a search ends at the best point that it has.
    """
    chains = len(next(iter(points.values())))
    if not each:
        return Modes([laplace(target, find_mode(target, _middle(target, points), deadline=deadline))], [0] * chains)
    modes = []
    for chain in range(chains):
        _log.info("chain %d:", chain)
        start = _flat(target, jax.tree.map(lambda x, index=chain: x[index], points))
        modes.append(find_mode(target, start, deadline=deadline))
    return report_modes(target, tell_apart(target, np.stack(modes)))


def temper(target: Target, points: Any, deadline: Deadline = NEVER) -> Target:
    """Temper the target near the mode found from the mean of the start points, if it is not tempered yet."""
    if target.mode_search is None or target.mode_search.tempering is None:
        return target
    near = approach(target, _middle(target, points), deadline=deadline)
    # Residuals change little once the displacements have followed the first search for hyperparameters.
    near_mode = settle(target, near, repeats=1, deadline=deadline)
    if not deadline.has_passed:
        near_mode = improve(target, near_mode, deadline=deadline)
    return target.mode_search.tempering(estimands_of(target, target.data, unravel(target)(jnp.asarray(near_mode))))


def tell_apart(target: Target, flat_modes: Float[np.ndarray, "chains dimension"]) -> Modes:
    """Group the modes of all chains into distinct ones, by their distance in standard deviations (see `SAME`)."""
    heights = [_height(target, mode) for mode in flat_modes]
    gaussians: list[Gaussian] = []
    chains = [0] * len(flat_modes)
    for chain in np.argsort(heights)[::-1]:
        distances = [distance(gaussian, flat_modes[chain]) for gaussian in gaussians]
        if not distances or min(distances) > SAME:
            distances = [*distances, 0.0]
            gaussians.append(laplace(target, flat_modes[chain]))
        chains[chain] = int(np.argmin(distances))
    return Modes(gaussians, chains)


def distance(gaussian: Gaussian, flat: Float[np.ndarray, "dimension"]) -> float:
    """Compute the greatest distance of a coordinate from the centre of a Gaussian, in its standard deviations."""
    sd = np.linalg.norm(np.asarray(gaussian.factor), axis=1)
    return float(np.abs((flat - np.asarray(gaussian.centre)) / sd).max())


def report_modes(target: Target, modes: Modes) -> Modes:
    """Report the modes in the log, and return them."""
    if len(modes.gaussians) == 1:
        _log.info("modes: the searches of all chains ended at the same one")
        return modes
    _log.info("modes: %d; each chain starts about its own, and all are whitened at the first", len(modes.gaussians))
    for number, gaussian in enumerate(modes.gaussians):
        centre = np.asarray(gaussian.centre)
        chains = ", ".join(str(chain) for chain, mode in enumerate(modes.chains) if mode == number)
        separation = distance(modes.gaussians[0], centre)
        _log.info("  log density %.1f, %.1f sd from the first: chains %s", _height(target, centre), separation, chains)
    return modes


def _height(target: Target, flat: np.ndarray) -> float:
    return float(logdensity(target, target.data, unravel(target)(jnp.asarray(flat))))


def _middle(target: Target, points: Any) -> np.ndarray:
    return _flat(target, jax.tree.map(lambda x: jnp.asarray(x).mean(axis=0), points))


def _flat(target: Target, estimands: Any) -> np.ndarray:
    return np.asarray(flat_position(target, target.data, estimands))
