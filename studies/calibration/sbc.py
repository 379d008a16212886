"""Simulation-based calibration: the rank of the truth among posterior draws is uniform over draws of the model.

The method is that of Talts et al., "Validating Bayesian inference algorithms with simulation-based calibration", 2018.
Test quantities that depend on the data, here E_s and log p, follow Modrák et al., Bayesian Analysis 2023. All
replications share one mesh, one moving image and the compiled programs, and run side by side. They differ in f at the
quadrature points, and in the Gaussian about which the sampler moves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from blackjax.adaptation.step_size import dual_averaging_adaptation
from jax.flatten_util import ravel_pytree
from numpyro.diagnostics import effective_sample_size, split_gelman_rubin
from scipy import stats

import bayesreg as br
from bayesreg.inference.gaussian.delayed_acceptance import chain_data
from bayesreg.inference.gaussian.laplace import average_gaussian
from bayesreg.inference.gaussian.mode_search import settle
from bayesreg.inference.gaussian.whitened import Setup, whitened_position
from bayesreg.inference.kernel import Sampler
from bayesreg.inference.samplers.registry import choose_sampler
from bayesreg.inference.target import estimands_of
from bayesreg.model.target import PosteriorTarget
from studies.calibration.chains import (
    BATCH,
    Estimands,
    condition,
    of_posterior,
    quantities,
    quantities_at,
    quantity_names,
    setups_about,
    simulated,
)
from studies.calibration.simulator import Simulator, observing, require_treatment

BINS = 10
LEVELS = (0.5, 0.9)
SIGNIFICANCE = 0.01

Progress = Callable[[str], None]


class Settings(NamedTuple):
    """The settings of the one chain that samples the posterior of each replication.

    Attributes
    ----------
    replications : int
    stages, approach : int
        A chain approaches the posterior in `stages` stages of `approach` transitions. The first stage moves about a
        Gaussian at the mode, each later stage about a Gaussian at the places that the chain has reached.
    warm_up, draws : int
        The numbers of discarded and of kept transitions in the last stage.
    step_size, steps : float, int
        The step size and the number of steps of a trajectory. The tuning of the step size starts here, and never goes
        beyond.
    target_acceptance : float
        The acceptance to which the step size of each chain is tuned in all transitions that are not kept.
    """

    replications: int = 400
    stages: int = 2
    approach: int = 20
    warm_up: int = 40
    draws: int = 150
    step_size: float = 0.3
    steps: int = 5
    target_acceptance: float = 0.8


SETTINGS = Settings()


class Ranks(NamedTuple):
    """The ranks and diagnostics of a calibration; the first axis of each array is the replication.

    Attributes
    ----------
    names : tuple of str
        The names of the k quantities.
    place : (r, k) array
        (rank of the truth + uniform) / (thinned draws + 1): uniform on (0, 1) if the posterior is right.
    ess : (r, k) array
        The numbers of effective draws, to which each posterior is thinned.
    rhat : (r, k) array
        The split R̂ of the chains.
    acceptance : (r,) array
    """

    names: tuple[str, ...]
    place: np.ndarray
    ess: np.ndarray
    rhat: np.ndarray
    acceptance: np.ndarray


class Sampled(NamedTuple):
    """Draws of the posteriors of all replications, after the warm-up.

    Attributes
    ----------
    quantities : (draw, r, k) array
    u : (draw, r, n, 3) array
        The displacement of every node, mm.
    acceptance : (r,) array
        The mean over the draws.
    """

    quantities: np.ndarray
    u: np.ndarray
    acceptance: np.ndarray


class Verdict(NamedTuple):
    """Tests of uniform ranks; the significance level is divided by the number of quantities (Bonferroni).

    Attributes
    ----------
    histogram : (k,) array
        The p-values of χ² over `BINS` bins.
    coverage : (levels, k) array
        The shares of the truths inside the central intervals.
    coverage_p : (levels, k) array
        The two-sided p-values of these shares under the binomial distribution.
    """

    histogram: np.ndarray
    coverage: np.ndarray
    coverage_p: np.ndarray

    @property
    def passes(self) -> bool:
        """Whether no quantity fails."""
        return bool(self.histogram.min() > self.threshold and self.coverage_p.min() > self.threshold)

    @property
    def threshold(self) -> float:
        """The least p-value with which a quantity passes."""
        return SIGNIFICANCE / len(self.histogram)


def verdict(place: np.ndarray) -> Verdict:
    """Test whether the ranks (r, k) are uniform."""
    counts = np.stack([np.histogram(column, BINS, (0, 1))[0] for column in place.T])
    inside = np.stack([(abs(place - 0.5) < level / 2).sum(axis=0) for level in LEVELS])
    p = [
        [stats.binomtest(int(n), len(place), level).pvalue for n in row]
        for row, level in zip(inside, LEVELS, strict=True)
    ]
    return Verdict(stats.chisquare(counts, axis=1).pvalue, inside / len(place), np.array(p))


def calibrate(
    simulator: Simulator,
    posterior: br.Posterior | None = None,
    settings: Settings = SETTINGS,
    seed: int = 0,
    sampler: str = "hmc",
    report_progress: Progress = lambda text: None,
) -> Ranks:
    """Rank truths from the simulator among draws of its posterior, or of another, wrong one."""
    posterior = simulator.posterior if posterior is None else posterior
    require_treatment(simulator.variant, posterior)
    rng = np.random.default_rng(seed)
    truths = simulator.draw_prior(rng, settings.replications)
    key_data, key_chains = jax.random.split(jax.random.key(seed))
    observed = simulated(simulator.posterior, simulator.posterior.data, truths, key_data)
    starts = of_posterior(posterior, simulator.draw_prior(rng, settings.replications))
    sampled = sample(posterior, observed, starts, key_chains, settings, sampler, report_progress)
    at_truth = jax.jit(jax.vmap(partial(quantities_at, posterior), in_axes=(None, 0, 0)))
    true = np.asarray(at_truth(posterior.data, observed, of_posterior(posterior, truths)))
    return _ranks(quantity_names(posterior), true, sampled.quantities, sampled.acceptance, rng)


def sample(
    posterior: br.Posterior,
    observed: Any,
    starts: Estimands,
    key: Any,
    settings: Settings = SETTINGS,
    sampler: str = "hmc",
    report_progress: Progress = lambda text: None,
) -> Sampled:
    """Sample the posterior of each of the data sets (r, q), one chain each, from draws of the prior."""
    kernel = choose_sampler(sampler, posterior.target).sampler
    report_progress("a mode for each replication")
    targets = [replace(posterior, data=observing(posterior.data, f)).target for f in observed]
    modes = _modes(targets, starts)
    visited = modes[:, None]
    key, key_flight = jax.random.split(key)
    for stage in range(settings.stages + 1):
        report_progress(f"a Gaussian for each replication, {stage + 1} of {settings.stages + 1}")
        about = visited[:, [0, -1]]
        references = [average_gaussian(*each) for each in zip(targets, about, strict=True)]
        setup = setups_about(posterior, references, about.mean(axis=1), settings.step_size, settings.steps)
        if stage == 0:
            states = _scattered(posterior, posterior.data, setup, observed, jax.random.split(key_flight, len(modes)))
        key_stage = jax.random.fold_in(key, stage)
        states, places, *outputs = _run(
            kernel, posterior, setup, observed, states, key_stage, settings, stage == settings.stages, report_progress
        )
        visited = np.concatenate([modes[:, None], np.moveaxis(places[len(places) // 2 :], 0, 1)], axis=1)
    quantities, u, acceptance = (each[settings.warm_up :] for each in outputs)
    return Sampled(quantities, u, acceptance.mean(axis=0))


def _modes(targets: list[PosteriorTarget], starts: Estimands) -> np.ndarray:
    """Flat positions (r, d) of the modes of all replications, from draws of the prior."""
    modes = []
    for k, target in enumerate(targets):
        start = target.coordinates.unconstrain(target.data, {name: x[k] for name, x in starts.items()})
        modes.append(settle(target, np.asarray(ravel_pytree(start)[0])))
    return np.stack(modes)


@partial(jax.jit, static_argnums=0)
def _scattered(posterior: br.Posterior, data: Any, setup: Setup, observed: Any, keys: Any) -> Estimands:
    """Draw from the Gaussian of each replication.

    The elastic energy at a mode is far less than at any draw, and T_r recovers slowly in a chain that starts there.
    """

    def draw(replication: Any) -> Estimands:
        setup, observed, key = replication
        xi = jax.random.normal(key, setup.middle.shape)
        return estimands_of(
            posterior.target, observing(data, observed), whitened_position(posterior.target, setup.gaussian, xi)
        )

    return jax.lax.map(draw, (setup, observed, keys), batch_size=BATCH)


@partial(jax.jit, static_argnums=(0, 1))
def _begin(kernel: Sampler, posterior: br.Posterior, data: Any, setup: Setup, observed: Any, starts: Estimands) -> Any:
    def initial_state(replication: Any) -> Any:
        setup, observed, start = replication
        return kernel.init(chain_data(posterior.target, observing(data, observed)), setup, start)

    return jax.lax.map(initial_state, (setup, observed, starts), batch_size=BATCH)


@partial(jax.jit, static_argnums=(0, 1))
def _advance(  # type: ignore[no-untyped-def]
    kernel: Sampler, posterior: br.Posterior, data: Any, setup: Setup, observed: Any, keys: Any, states: Any
):
    def transition(replication: Any) -> Any:
        setup, observed, key, state = replication
        here = chain_data(posterior.target, observing(data, observed))
        state, info = kernel.step(here, setup, key, state)
        drawn = kernel.observe(here, setup, state)
        place = ravel_pytree(posterior.target.coordinates.unconstrain(data, drawn.estimands))[0]
        recorded = quantities(drawn.estimands, drawn.evaluation), drawn.evaluation.u
        return state, drawn.estimands, place, *recorded, info.acceptance_rate

    return jax.lax.map(transition, (setup, observed, keys, states), batch_size=BATCH)


def _run(
    kernel: Sampler,
    posterior: br.Posterior,
    setup: Setup,
    observed: Any,
    starts: Estimands,
    key: Any,
    settings: Settings,
    last: bool,
    report_progress: Progress,
) -> tuple[Estimands, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the ends of the chains, and flat positions, quantities, u and acceptances, (step, replication, …).

    The step size of each chain is tuned separately, by dual averaging as in production: with one step size for all
    replications some chains did not move.
    """
    data = condition(posterior)
    tuned, steps = (settings.warm_up, settings.warm_up + settings.draws) if last else (settings.approach,) * 2
    begin, update, final = dual_averaging_adaptation(settings.target_acceptance)
    averaging = jax.vmap(begin)(setup.step_size)
    states = _begin(kernel, posterior, data, setup, observed, starts)
    history = []
    for step in range(steps):
        size = jnp.exp(averaging.log_step_size) if step < tuned else final(averaging)
        setup = setup._replace(step_size=jnp.minimum(size, settings.step_size))
        keys = jax.random.split(jax.random.fold_in(key, step), len(observed))
        states, ends, *outputs = _advance(kernel, posterior, data, setup, observed, keys, states)
        history.append([np.asarray(x) for x in outputs])
        if step < tuned:
            averaging = jax.vmap(update)(averaging, jnp.nan_to_num(outputs[-1]))
        if step % 20 == 0:
            size, rate = np.median(setup.step_size), history[-1][-1].mean()
            report_progress(f"transition {step} of {steps}, acceptance {rate:.0%}, step {size:.2g}")
    return ends, *(np.stack(x) for x in zip(*history, strict=True))


def _ranks(
    names: tuple[str, ...], true: np.ndarray, draws: np.ndarray, acceptance: np.ndarray, rng: np.random.Generator
) -> Ranks:
    """Rank each quantity of each replication among its draws, thinned to independent ones."""
    chain = draws[None]
    ess = effective_sample_size(chain)
    # Draws that alternate about their mean are worth more than independent ones, and may be estimated below zero.
    ess = np.where(ess > 0, np.clip(ess, 1, len(draws)), len(draws))
    place = np.empty_like(true)
    for r, k in np.ndindex(*true.shape):
        thinned = draws[np.linspace(0, len(draws) - 1, int(ess[r, k])).round().astype(int), r, k]
        place[r, k] = ((thinned < true[r, k]).sum() + rng.uniform()) / (len(thinned) + 1)
    return Ranks(names, place, ess, split_gelman_rubin(chain), acceptance)
