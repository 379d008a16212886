"""Geweke's joint-distribution test of a transition kernel ("Getting it right", JASA 2004).

There are two simulators of the joint distribution of parameters, displacements and data: the model itself, and the
"successive-conditional" one, which alternates a step of the kernel, given the data, with new data given the parameters.
The second starts from draws of the first, so that it is stationary from its first step if the kernel is right, and
drifts away if it is not. The mean of each chain is compared with its start. Chains are independent, so that the scatter
of the differences gives the standard error for any correlation along a chain. The differences of a reversible kernel
are symmetric about zero, even if the moments are skew.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy import stats

import bayesreg as br
from bayesreg.inference.gaussian.delayed_acceptance import chain_data
from bayesreg.inference.kernel import Sampler
from bayesreg.inference.samplers.registry import choose_sampler
from bayesreg.model.target import PosteriorTarget
from studies.calibration.chains import (
    BATCH,
    condition,
    of_posterior,
    prior_reference,
    quantities,
    quantity_names,
    setups_about,
)
from studies.calibration.simulator import Simulator, draw_data, observing, require_treatment

SIGNIFICANCE = 0.01
# The trajectories are in whitened coordinates about a reference that is independent of the data.
STEP_SIZE, STEPS = 0.4, 4
# The steps of the plain random walk, whose space is not whitened: mm, and the unit of λ and μ.
RANDOM_WALK = {"sigma_u": 0.03, "sigma_lam": 0.15, "sigma_mu": 0.15}


class Comparison(NamedTuple):
    """A comparison of first and second moments under both simulators.

    Attributes
    ----------
    names : tuple of str
    z : (statistics,) array
        The mean difference of the chains from their starts, over its standard error.
    p : (statistics,) array
        Two-sided p-values of Student's t; the degrees of freedom are one less than the chains.
    acceptance : float
    moved : float
        The root mean square change of the quantities from the start to the last step, in standard deviations.
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
    chains: int = 200,
    steps: int = 10,
    seed: int = 0,
    step_size: float = STEP_SIZE,
) -> Comparison:
    """Compare the moments of a kernel's chains with those of their starts.

    `posterior` defaults to that of the simulator; any other posterior is a planted error.
    """
    posterior = simulator.posterior if posterior is None else posterior
    require_treatment(simulator.variant, posterior)
    first = of_posterior(posterior, simulator.draw_prior(np.random.default_rng(seed), chains))
    kernel = choose_sampler(sampler, posterior.target, **(RANDOM_WALK if sampler == "rwmh" else {})).sampler
    setup, data = None, condition(posterior)
    if sampler != "rwmh":
        reference = prior_reference(simulator, posterior)
        centre = np.asarray(reference.centre)[None]
        shared = setups_about(posterior, [reference], centre, step_size, STEPS)
        setup = jax.tree.map(lambda x: x[0], shared)
    run = partial(_successive, kernel, posterior.target, simulator.posterior, steps)
    outputs = run(simulator.posterior.data, data, setup, jax.random.key(seed), first)
    start, successive, acceptance = (np.asarray(x) for x in outputs)
    names = quantity_names(posterior)
    difference = _moments(successive).mean(axis=1) - _moments(start)
    z = difference.mean(axis=0) / (difference.std(axis=0, ddof=1) / np.sqrt(chains))
    moved = np.sqrt(np.mean(((successive[:, -1] - start) / start.std(axis=0)) ** 2))
    names_of_moments = (*names, *(f"{name} squared" for name in names))
    return Comparison(names_of_moments, z, 2 * stats.t.sf(abs(z), chains - 1), float(acceptance.mean()), float(moved))


def _moments(values: np.ndarray) -> np.ndarray:
    """Append the squares of the values along the last axis."""
    return np.concatenate([values, values**2], axis=-1)


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _successive(
    kernel: Sampler,
    target: PosteriorTarget,
    model: br.Posterior,
    steps: int,
    truth: Any,
    data: Any,
    setup: Any,
    key: Any,
    first: Any,
) -> Any:
    """Return the quantities before the first step (chain, k) and after each step (chain, step, k), and acceptances."""

    def observed(key: Any, estimands: Any) -> Any:
        return observing(data, draw_data(model, truth, key, estimands))

    def chain(key_and_start: Any) -> Any:
        key, first = key_and_start
        evaluation = model.target.evaluate_estimands(observed(jax.random.fold_in(key, 0), first), first)

        def transition(estimands: Any, key: Any) -> Any:
            key_data, key_step = jax.random.split(key)
            here = chain_data(target, observed(key_data, estimands))
            state, info = kernel.step(here, setup, key_step, kernel.init(here, setup, estimands))
            drawn = kernel.observe(here, setup, state)
            return drawn.estimands, (quantities(drawn.estimands, drawn.evaluation), info.acceptance_rate)

        return quantities(first, evaluation), *jax.lax.scan(transition, first, jax.random.split(key, steps))[1]

    keys = jax.random.split(key, len(first["u_boundary"]))
    return jax.lax.map(chain, (keys, first), batch_size=BATCH)
