"""Geweke's joint-distribution test of a transition kernel ("Getting it right", JASA 2004).

Two simulators of the joint distribution of parameters, displacements and data: the model itself, and one that
alternates a step of the kernel, given the data, with new data given the parameters ("successive-conditional"). The
second starts from draws of the first, so that it is stationary from its first step if the kernel is right, and drifts
away if it is not. Its chains are independent: their scatter is the standard error, whatever their correlation.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy import stats

import bayesreg as br
from bayesreg.inference.samplers import SAMPLERS, Sampler
from tests.calibration.chains import (
    BATCH,
    of_posterior,
    prior_reference,
    quantities,
    quantities_at,
    quantity_names,
    setups_about,
    simulated,
)
from tests.calibration.simulator import Simulator, draw_data

SIGNIFICANCE = 0.01
# Of the plain random walk, whose space is not whitened: mm, and the unit of λ and μ.
RANDOM_WALK = {"sigma_u": 0.03, "sigma_lam": 0.15, "sigma_mu": 0.15}


class Comparison(NamedTuple):
    """First and second moments under both simulators.

    Attributes
    ----------
    names : tuple of str
    z : (statistics,) array
        Difference of the two means over its standard error.
    p : (statistics,) array
        Two-sided, of Student's t with as many degrees of freedom as chains less one.
    acceptance : float
    moved : float
        Root mean square of the change of the estimands from the first step to the last, in their own deviations.
    """

    names: tuple[str, ...]
    z: np.ndarray
    p: np.ndarray
    acceptance: float
    moved: float

    @property
    def passes(self) -> bool:
        """Whether no statistic differs, at a significance shared out over all of them (Bonferroni)."""
        return bool(self.p.min() > SIGNIFICANCE / len(self.p))


def compare(
    simulator: Simulator,
    sampler: str,
    posterior: br.Posterior | None = None,
    chains: int = 60,
    steps: int = 40,
    draws: int = 2000,
    seed: int = 0,
) -> Comparison:
    """Both simulators' moments; a posterior other than the simulator's own is a planted error."""
    posterior = simulator.posterior if posterior is None else posterior
    rng = np.random.default_rng(seed)
    first, direct = (of_posterior(posterior, simulator.draw_prior(rng, count)) for count in (chains, draws))
    key_data, key_chains = jax.random.split(jax.random.key(seed))
    observed = simulated(simulator.posterior, simulator.posterior.data, direct, key_data)
    at_direct = jax.jit(
        partial(jax.lax.map, lambda both: quantities_at(posterior, posterior.data, *both), batch_size=BATCH)
    )
    marginal = np.asarray(at_direct((observed, direct)))
    kernel = SAMPLERS[sampler](posterior, **(RANDOM_WALK if sampler == "rwmh" else {}))
    setup = None
    if sampler != "rwmh":
        shared = setups_about(posterior, [prior_reference(simulator, posterior)], 0.4, 4)
        setup = jax.tree.map(lambda x: x[0], shared)
    run = partial(_successive, kernel, simulator.posterior, steps)
    successive, acceptance = (
        np.asarray(x) for x in run(simulator.posterior.data, posterior.data, setup, key_chains, first)
    )
    names = quantity_names(posterior)
    z = _scores(_moments(marginal), _moments(successive).mean(axis=1))
    spread = marginal.std(axis=0)
    moved = np.sqrt(np.mean(((successive[:, -1] - successive[:, 0]) / spread) ** 2))
    both = (*names, *(f"{name} squared" for name in names))
    return Comparison(both, z, 2 * stats.t.sf(abs(z), chains - 1), float(acceptance.mean()), float(moved))


def _moments(values: np.ndarray) -> np.ndarray:
    """Values and their squares about a common centre (last axis)."""
    return np.concatenate([values, values**2], axis=-1)


def _scores(marginal: np.ndarray, by_chain: np.ndarray) -> np.ndarray:
    variance = marginal.var(axis=0, ddof=1) / len(marginal) + by_chain.var(axis=0, ddof=1) / len(by_chain)
    return (by_chain.mean(axis=0) - marginal.mean(axis=0)) / np.sqrt(variance)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _successive(
    kernel: Sampler, model: br.Posterior, steps: int, truth: Any, data: Any, setup: Any, key: Any, first: Any
) -> Any:
    """Quantities (chain, step, k) after each step of the kernel, and its acceptance."""

    def chain(given: Any) -> Any:
        key, first = given

        def one(estimands: Any, key: Any) -> Any:
            key_data, key_step = jax.random.split(key)
            here = data._replace(fixed_values=draw_data(model, truth, key_data, estimands))
            state, info = kernel.step(here, setup, key_step, kernel.init(here, setup, estimands))
            drawn = kernel.observe(here, setup, state)
            return drawn.estimands, (quantities(drawn.estimands, drawn.evaluation), info.acceptance_rate)

        return jax.lax.scan(one, first, jax.random.split(key, steps))[1]

    keys = jax.random.split(key, len(first["u_boundary"]))
    return jax.lax.map(chain, (keys, first), batch_size=BATCH)
