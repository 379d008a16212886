"""The cost of a sampler's draws: effective draws per second and per evaluation, and how far a budget led."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from bayesreg.inference.chains.checkpoint import Checkpoint
from bayesreg.inference.chains.initialise import Start
from bayesreg.inference.chains.run import HasTarget, Samples, first_checkpoint, sample
from bayesreg.inference.chains.stopping import StopRule
from bayesreg.inference.draws.blocks import Block
from bayesreg.types import InputError


class Efficiency(NamedTuple):
    """How one sampler did on one posterior within one budget; None is what could not be found.

    Attributes
    ----------
    sampler : str
    exact : bool or None
    note : str
        Why it did not run; empty where it did.
    draws : int
        Kept, of all chains together.
    rhat : float or None
        The greatest rank-normalised split R̂ of all estimands.
    ess_bulk, ess_tail : float or None
        The least of all estimands.
    ess_per_second, ess_per_second_in_all : float or None
        The smaller of the two least, over `sampling_seconds`, and over `seconds`.
    ess_per_evaluation : float or None
        Over gradients and densities, those of the warm-up left out.
    gradients, densities : int
        Evaluations with gradient and without, of all chains together, after the warm-up.
    acceptance : float or None
    preparing_seconds : float
        Search for the mode and warm-up, the compilation of both included.
    sampling_seconds : float or None
        Drawing without compilation: the first block, which compiles, is taken to cost what the others do. None where
        there is no second one.
    seconds : float
        All of it.
    seconds_to_rule : float or None
        When the stop rule was met, all included; None where it was not.
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
        Most kept draws of each chain.
    stop : StopRule
        With the seconds that it may take, and the rule whose time is asked for.
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
    """Sample within a budget and reckon; see `bayesreg.inference.chains.run.sample` for the options.

    A sampler that cannot run on this posterior is no error: its `note` says why.
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
    """Seconds of drawing without compilation, from draws so far and seconds at the end of every block."""
    (first, compiled), (last, finished) = ends[0], ends[-1]
    return None if last == first else (finished - compiled) * last / (last - first)


def _ratio(value: float | None, cost: float | int | None) -> float | None:
    return value / cost if value is not None and cost else None


def _extreme(figures: Any, choose: Callable[[np.ndarray], float]) -> float | None:
    values = np.concatenate([np.ravel(figures[name]) for name in figures])
    return float(choose(values)) if np.isfinite(values).any() else None
