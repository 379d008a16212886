"""The cost of a sampler's draws: effective draws per second and per evaluation within one budget."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from bayesreg.inference.chains.beginning import first_checkpoint
from bayesreg.inference.chains.checkpoint import Checkpoint
from bayesreg.inference.chains.initialise import Start
from bayesreg.inference.chains.run import HasTarget, Samples, sample
from bayesreg.inference.chains.stopping import StopRule
from bayesreg.inference.draws.blocks import Block
from bayesreg.types import InputError


class Efficiency(NamedTuple):
    """The efficiency of one sampler on one posterior within one budget; None stands for an unknown value.

    Attributes
    ----------
    sampler : str
    exact : bool or None
    note : str
        The reason why the sampler did not run; empty if it ran.
    draws : int
        The number of kept draws of all chains together.
    rhat : float or None
        The greatest rank-normalised split R̂ of all estimands.
    ess_bulk, ess_tail : float or None
        The least effective sample size of all estimands.
    ess_per_second, ess_per_second_in_all : float or None
        The smaller of `ess_bulk` and `ess_tail` over `sampling_seconds`, and over `seconds`.
    ess_per_evaluation : float or None
        The smaller of `ess_bulk` and `ess_tail` over the sum of `gradients` and `densities`.
    gradients, densities : int
        Evaluations with gradient and without, of all chains together, after the warm-up.
    acceptance : float or None
    preparing_seconds : float
        The time of the search for the mode and of the warm-up; it includes their compilation.
    sampling_seconds : float or None
        The time of drawing without compilation. The first block compiles, and is assumed to take as long as the others.
        It is None if there is only one block.
    seconds : float
        The time of everything.
    seconds_to_rule : float or None
        The time of everything until the stop rule was met; None if it was not met.
    """

    sampler: str
    exact: bool | None = None
    note: str = ""
    draws: int = 0
    rhat: float | None = None
    ess_bulk: float | None = None
    ess_tail: float | None = None
    ess_per_second: float | None = None
    ess_per_second_in_all: float | None = None
    ess_per_evaluation: float | None = None
    gradients: int = 0
    densities: int = 0
    acceptance: float | None = None
    preparing_seconds: float = 0.0
    sampling_seconds: float | None = None
    seconds: float = 0.0
    seconds_to_rule: float | None = None


class Budget(NamedTuple):
    """The budget of every sampler.

    Attributes
    ----------
    chains : int
    draws : int
        The greatest number of kept draws of each chain.
    stop : StopRule
        The stop rule, with the greatest number of seconds.
    """

    chains: int
    draws: int
    stop: StopRule


def measure_efficiency(
    posterior: HasTarget,
    sampler: str,
    budget: Budget,
    seed: int = 0,
    *,
    thin: int = 1,
    block: int = 20,
    start: Start | None = None,
    progress: bool = False,
    **settings: Any,
) -> Efficiency:
    """Sample within a budget, and measure the efficiency.

    `bayesreg.inference.chains.run.sample` explains the options. If the sampler cannot run on this posterior, the result
    has a `note` with the reason, and no error is raised.
    """
    ends: list[tuple[int, float]] = []

    def keep(_index: int, _block: Block, checkpoint: Checkpoint) -> None:
        ends.append((int(checkpoint.draws), float(checkpoint.seconds)))

    try:
        first = first_checkpoint(posterior.target, sampler, budget.chains, seed, start, **settings)
        samples = sample(
            posterior, sampler, budget.chains, budget.draws, seed, thin=thin, block=block, stop=budget.stop,
            progress=progress, resume=(first, []), on_block=keep, **settings,
        )  # fmt: skip
    except InputError as error:
        return Efficiency(sampler, note=str(error))
    return _reckon(sampler, samples, float(first.seconds), ends)


def _reckon(sampler: str, samples: Samples, preparing: float, ends: list[tuple[int, float]]) -> Efficiency:
    judged = samples.convergence
    bulk, tail = (_extreme(ess, np.nanmin) for ess in (judged.ess_bulk, judged.ess_tail))
    least = None if bulk is None or tail is None else min(bulk, tail)
    steps, gradients, densities = (
        int(getattr(samples.tally, name).sum()) for name in ("steps", "gradients", "densities")
    )
    sampling = sampling_seconds(ends)
    return Efficiency(
        sampler=sampler,
        exact=samples.exact,
        draws=ends[-1][0] * len(samples.tally.steps),
        rhat=_extreme(judged.rhat, np.nanmax),
        ess_bulk=bulk,
        ess_tail=tail,
        ess_per_second=_ratio(least, sampling),
        ess_per_second_in_all=_ratio(least, samples.seconds),
        ess_per_evaluation=_ratio(least, gradients + densities),
        gradients=gradients,
        densities=densities,
        acceptance=float(samples.tally.acceptance.sum()) / steps,
        preparing_seconds=preparing,
        sampling_seconds=sampling,
        seconds=samples.seconds,
        seconds_to_rule=samples.seconds if samples.converged else None,
    )


def sampling_seconds(ends: list[tuple[int, float]]) -> float | None:
    """Seconds of drawing without compilation.

    `ends` holds the number of draws and the seconds, from the start, at the end of every block.
    """
    (first, compiled), (last, finished) = ends[0], ends[-1]
    return None if last == first else (finished - compiled) * last / (last - first)


def _ratio(value: float | None, cost: float | int | None) -> float | None:
    return value / cost if value is not None and cost else None


def _extreme(figures: Any, choose: Callable[[np.ndarray], float]) -> float | None:
    values = np.concatenate([np.ravel(figures[name]) for name in figures])
    return float(choose(values)) if np.isfinite(values).any() else None
