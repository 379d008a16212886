"""Running chains in blocks of draws; the draws of each block go to the host."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np

from bayesreg.ahead import ahead
from bayesreg.inference.chains.beginning import compile_programs, first_checkpoint, require_continuation, temper_target
from bayesreg.inference.chains.block import run_block
from bayesreg.inference.chains.checkpoint import Checkpoint, Tally
from bayesreg.inference.chains.devices import devices_for, share
from bayesreg.inference.chains.initialise import Start
from bayesreg.inference.chains.progress import NoProgress, Progress, SamplingProgress, Showing
from bayesreg.inference.chains.stopping import StopRule, Verdict, judge, judge_all, out_of_time, reason
from bayesreg.inference.deadline import Deadline
from bayesreg.inference.draws.blocks import Block, Blocks
from bayesreg.inference.draws.diagnostics import Convergence, Figures, figures, labelled
from bayesreg.inference.draws.inference_data import to_inference_data
from bayesreg.inference.draws.moments import pool, scale_reduction
from bayesreg.inference.samplers.registry import Chosen, choose_sampler
from bayesreg.inference.target import Target
from bayesreg.types import InputError

# The time of a call that draws a part of a block, s: signals and the budget act between two calls.
LONGEST_CALL = 10.0
# The number of steps of the first call, if a step has one elastic solve.
FIRST_STEPS = 300


@runtime_checkable
class HasTarget(Protocol):
    """A posterior that samplers can draw from, such as `bayesreg.Posterior`."""

    @property
    def target(self) -> Target:
        """The posterior as the samplers use it."""


@dataclass(frozen=True, eq=False)
class Samples:
    """The results of sampling.

    Attributes
    ----------
    target : Target
        The posterior of the draws as the sampler uses it, tempered if the options ask for it.
    blocks : Blocks
        The draws, as arrays (chain, draw, …) of the estimands and of their statistics.
    u_mean, u_sd : (n, 3) arrays
        Posterior mean and standard deviation of the displacement of every node, mm, over all kept draws.
    rhat : mapping
        R̂ = √(var⁺/W), unsplit, of every estimand (NaN with one chain).
    tally : Tally
    converged : bool or None
        Whether the stop rule was met; None if the rule has no R̂.
    reason : str
        A sentence that says why sampling stopped.
    seconds : float
        Seconds of sampling, including compilation.
    exact : bool
        Whether the sampler leaves the posterior unchanged.
    figures : Figures or None
        The figures of all estimands, if the stop rule needed them.
    """

    target: Target
    blocks: Blocks
    u_mean: np.ndarray
    u_sd: np.ndarray
    rhat: dict[str, np.ndarray]
    tally: Tally
    converged: bool | None
    reason: str
    seconds: float
    exact: bool
    figures: Figures | None = None

    @cached_property
    def idata(self) -> Any:
        """All draws in memory as ArviZ data (InferenceData or DataTree): posterior and sample_stats."""
        return to_inference_data(self.target, self.blocks)

    @cached_property
    def convergence(self) -> Convergence:
        """R̂ and effective sample sizes of every estimand."""
        return labelled(self.target, self.blocks, self.figures or figures(self.blocks))


def sample(
    posterior: HasTarget,
    sampler: str = "auto",
    chains: int = 4,
    draws: int = 1000,
    seed: int = 0,
    *,
    thin: int = 1,
    block: int = 50,
    start: Start | None = None,
    stop: StopRule | None = None,
    progress: Showing = True,
    resume: tuple[Checkpoint, Blocks] | None = None,
    on_block: Callable[[int, Block, Checkpoint], None] | None = None,
    **settings: Any,
) -> Samples:
    """Draw from a posterior with parallel chains.

    Parameters
    ----------
    posterior : Posterior
    sampler : str
        A name in `bayesreg.inference.samplers.registry.SAMPLERS`; "auto" is gibbs if the displacements can be
        integrated out, as with pairs of points alone, else hmc.
    chains : int
        The number of chains. They run in parallel under `vmap`, in equal shares on the most devices that divide it.
    draws : int
        The greatest number of draws to keep for each chain.
    seed : int
        The same seed, posterior and options give the same draws, whatever the length of a block.
    thin : int
        Steps per kept draw.
    block : int
        Kept draws between two checks of the stop rule; the device holds the draws of one block only. If a block would
        take more than `LONGEST_CALL` seconds, it is drawn and stored in parts, so that signals and the budget act soon.
    start : Start, optional
        The default starts all chains at rest, the parameters spread by 10 %.
    stop : StopRule, optional
    progress : bool or callable
        Whether to show a progress bar; or the maker of another display, (draws, greatest seconds, threshold of R̂) →
        Progress, such as `bayesreg.inference.chains.progress.SamplingProgress`.
    resume : (Checkpoint, Blocks), optional
        The run to continue, instead of a new one from `start`; every new block is appended to its blocks.
    on_block : callable, optional
        A function that is called after each block, or part of a block, with its number, its draws and the checkpoint
        after it.
    **settings
        Settings of the sampler, see `bayesreg.inference.samplers.settings`.

    Returns
    -------
    Samples

    Raises
    ------
    InputError
        If an option is out of range, a chain cannot start, or the run to resume belongs to another posterior or does
        not stand where its draws end.
    """
    for name, value in {"chains": chains, "draws": draws, "thin": thin, "block": block}.items():
        if value < 1:
            raise InputError(f"{name} must be at least 1, got {value}")
    stop = stop or StopRule()
    began = time.perf_counter()
    target = posterior.target
    deadline = Deadline.after(stop.max_seconds)
    if resume is None:
        with ahead(compile_programs(target, sampler, chains, block, thin, **settings)):
            target = temper_target(target, chains, seed, start, deadline)
            checkpoint = first_checkpoint(target, sampler, chains, seed, start, deadline, **settings)
        checkpoint = checkpoint._replace(seconds=np.array(time.perf_counter() - began))
        blocks: Blocks = []
        began = time.perf_counter()
    elif target.mode_search is not None and target.mode_search.tempering is not None:
        raise InputError("these draws are of a tempered posterior: resume them with the posterior of their samples")
    chosen = choose_sampler(sampler, target, **settings)
    if resume is not None:
        checkpoint, blocks = resume
        require_continuation(chosen, checkpoint, blocks)
    shown = progress if callable(progress) else SamplingProgress if progress else NoProgress
    with shown(draws, stop.max_seconds, stop.rhat) as bar:
        advance = _advance(chosen, chains, seed, thin, block, draws, checkpoint, began)
        verdict, ended = _judge(stop, checkpoint, blocks, block, draws, bar)
        while not ended and (block_and_checkpoint := next(advance, None)) is not None:
            drawn, checkpoint = block_and_checkpoint
            blocks.append(drawn)
            if on_block is not None:
                on_block(len(blocks) - 1, drawn, checkpoint)
            verdict, ended = _judge(stop, checkpoint, blocks, block, draws, bar)
    return _gather_samples(target, chosen.sampler.exact, blocks, checkpoint, stop, verdict, draws)


def _advance(
    chosen: Chosen,
    chains: int,
    seed: int,
    thin: int,
    block: int,
    draws: int,
    checkpoint: Checkpoint,
    began: float,
) -> Iterator[tuple[Block, Checkpoint]]:
    """Yield blocks of draws, or parts of blocks, until each chain has `draws` draws."""
    spent = float(checkpoint.seconds)
    # A step of many solves may take seconds.
    longest = 1 if chosen.sampler.many_solves else max(FIRST_STEPS // thin, 1)
    devices = devices_for(chains)
    data = chosen.sampler.data(checkpoint.setup)
    while int(checkpoint.draws) < draws:
        called = time.perf_counter()
        count = min(longest, block - int(checkpoint.draws) % block, draws - int(checkpoint.draws))
        state, moments, tally, block_draws = run_block(
            chosen,
            block,
            thin,
            devices,
            data,
            seed,
            np.arange(chains),
            int(checkpoint.draws),
            count,
            checkpoint.setup,
            *share(checkpoint[2:5], devices),
        )
        block_draws = {name: np.array(np.asarray(value)[:, :count]) for name, value in block_draws.items()}
        # The first call includes the compilation, so that the second one may be short, too.
        longest = int(np.clip(count * LONGEST_CALL / (time.perf_counter() - called), 1, block))
        seconds = np.array(spent + time.perf_counter() - began)
        drawn = np.array(int(checkpoint.draws) + count)
        checkpoint = Checkpoint(drawn, checkpoint.setup, state, moments, tally, seconds)
        yield block_draws, checkpoint


def _judge(
    stop: StopRule, checkpoint: Checkpoint, blocks: Blocks, block: int, draws: int, bar: Progress
) -> tuple[Verdict, bool]:
    """Show the progress and judge the draws so far; return the verdict and whether the run ends.

    Only whole blocks are judged, so that the number of draws does not depend on the speed of the machine.
    """
    bar.show(checkpoint, scale_reduction(checkpoint.moments))
    drawn = int(checkpoint.draws)
    is_whole = drawn % block == 0 or drawn == draws
    verdict = judge(stop, checkpoint, blocks, -(-drawn // block)) if is_whole else Verdict(holds=False)
    return verdict, verdict.holds or out_of_time(stop, checkpoint)


def _gather_samples(
    target: Target,
    exact: bool,
    blocks: Blocks,
    checkpoint: Checkpoint,
    stop: StopRule,
    verdict: Verdict,
    draws: int,
) -> Samples:
    if stop.ess is not None and verdict.figures is None:
        # The last check may have been some blocks ago.
        verdict = judge_all(stop, checkpoint, blocks)
    elif stop.ess is None and not verdict.holds:
        # The budget may have ended a run in the middle of a block.
        verdict = judge(stop, checkpoint, blocks, 1)
    mean, sd = pool(checkpoint.moments)
    rhat = scale_reduction(checkpoint.moments)["estimands"]
    return Samples(
        target=target,
        blocks=blocks,
        u_mean=mean["u"],
        u_sd=sd["u"],
        rhat=rhat,
        tally=jax.tree.map(np.asarray, checkpoint.tally),
        converged=None if stop.rhat is None else verdict.holds,
        reason=reason(stop, checkpoint, verdict, draws),
        seconds=float(checkpoint.seconds),
        exact=exact,
        figures=verdict.figures,
    )
