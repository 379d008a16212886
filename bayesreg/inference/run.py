"""Running chains: vmap over chains, scan over draws, in blocks whose draws go to the host."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.inference.diagnostics import to_inference_data
from bayesreg.inference.initialise import Start, require_density, starting_points
from bayesreg.inference.moments import Moments, pooled, scale_reduction, updated, zero_moments
from bayesreg.inference.progress import NoProgress, Progress, SamplingProgress
from bayesreg.inference.samplers import SAMPLERS, Info, Sampler, State
from bayesreg.inference.target import Target
from bayesreg.types import AnyArray, InputError


class StopRule(NamedTuple):
    """When to stop: converged, or out of budget.

    Attributes
    ----------
    rhat : float, optional
        Stop when R̂ = √(var⁺/W), unsplit, is below this for every estimand; None never stops early.
    max_seconds : float, optional
        Of sampling, compilation included.
    min_draws : int
        Kept draws per chain before R̂ is believed.
    """

    rhat: float | None = None
    max_seconds: float | None = None
    min_draws: int = 100


class Tally(NamedTuple):
    """Sums over steps, for each chain."""

    steps: AnyArray
    acceptance: AnyArray
    outside_support: AnyArray
    solver_failed: AnyArray
    solver_iterations: AnyArray
    diverging: AnyArray


class Checkpoint(NamedTuple):
    """All that the next block needs (a pytree of arrays with chains as the leading axis).

    Attributes
    ----------
    draws : int
        Kept draws per chain so far.
    state : State
    moments : Moments
        Of the estimands and of u at every node.
    tally : Tally
        Summed over all steps so far.
    seconds : float
        Spent sampling so far.
    """

    draws: AnyArray
    state: State
    moments: Moments
    tally: Tally
    seconds: AnyArray


class Samples(NamedTuple):
    """What sampling found.

    Attributes
    ----------
    idata : arviz.InferenceData or xarray.DataTree
        What ArviZ opens: posterior and sample_stats.
    u_mean, u_sd : (n, 3) arrays
        Posterior mean and standard deviation of the displacement of every node, mm, over all kept draws.
    rhat : mapping
        R̂ = √(var⁺/W), unsplit, of every estimand (NaN with one chain).
    tally : Tally
    converged : bool or None
        Whether the stop rule's R̂ was met; None where none was asked for.
    reason : str
        Why sampling stopped, in words.
    seconds : float
        Spent sampling, compilation included.
    exact : bool
        Whether the sampler leaves the posterior unchanged.
    """

    idata: Any
    u_mean: np.ndarray
    u_sd: np.ndarray
    rhat: dict[str, np.ndarray]
    tally: Tally
    converged: bool | None
    reason: str
    seconds: float
    exact: bool


Block = dict[str, np.ndarray]


def sample(
    posterior: Target,
    sampler: str = "rwmh",
    chains: int = 4,
    draws: int = 1000,
    seed: int = 0,
    *,
    thin: int = 1,
    block: int = 50,
    start: Start | None = None,
    stop: StopRule | None = None,
    progress: bool = True,
    resume: tuple[Checkpoint, list[Block]] | None = None,
    on_block: Callable[[int, Block, Checkpoint], None] | None = None,
    **settings: float,
) -> Samples:
    """Draw from a posterior with parallel chains.

    Parameters
    ----------
    posterior : Posterior
    sampler : str
        A name in `bayesreg.inference.samplers.SAMPLERS`.
    chains : int
        Run side by side under `vmap`.
    draws : int
        Most draws to keep for each chain.
    seed : int
        Same seed, posterior and options: same draws, however they are cut into blocks.
    thin : int
        Steps per kept draw.
    block : int
        Kept draws between two looks at the stop rule; only one block's draws are ever on the device.
    start : Start, optional
        The default starts all chains at rest, the parameters spread by 10 %.
    stop : StopRule, optional
    progress : bool
        Show a progress bar.
    resume : (Checkpoint, list of blocks), optional
        Continue from there instead of from `start`.
    on_block : callable, optional
        Called with the block's number, its draws and the checkpoint after it.
    **settings
        Of the sampler: for "rwmh" sigma_u, sigma_lam, sigma_mu.

    Returns
    -------
    Samples

    Raises
    ------
    InputError
        If an option is out of range or a chain cannot start.
    """
    if sampler not in SAMPLERS:
        raise InputError(f"unknown sampler {sampler!r}; there are {', '.join(SAMPLERS)}")
    for name, value in {"chains": chains, "draws": draws, "thin": thin, "block": block}.items():
        if value < 1:
            raise InputError(f"{name} must be at least 1, got {value}")
    stop = stop or StopRule()
    kernel = SAMPLERS[sampler](posterior, **settings)
    began = time.perf_counter()
    _, key_chains = jax.random.split(jax.random.key(seed))
    if resume is None:
        checkpoint, blocks = first_checkpoint(posterior, sampler, chains, seed, start, **settings), []
    else:
        checkpoint, blocks = resume[0], list(resume[1])
    chain_keys = jax.vmap(partial(jax.random.fold_in, key_chains))(jnp.arange(chains))
    with (SamplingProgress if progress else NoProgress)(draws, stop.max_seconds, stop.rhat) as bar:
        advance = _advance(kernel, posterior, chain_keys, thin, block, draws, checkpoint, began)
        for found, reached in _until(stop, advance, checkpoint, bar):
            blocks.append(found)
            checkpoint = reached
            if on_block is not None:
                on_block(len(blocks) - 1, found, checkpoint)
    return _samples(posterior, kernel, blocks, checkpoint, stop, draws)


def first_checkpoint(
    posterior: Target, sampler: str, chains: int, seed: int, start: Start | None = None, **settings: float
) -> Checkpoint:
    """The checkpoint before any draw: where `sample` starts its chains, unless it resumes.

    Raises
    ------
    InputError
        If a chain cannot start there.
    """
    key_start, _ = jax.random.split(jax.random.key(seed))
    points = starting_points(posterior, start or Start(), chains, key_start)
    checkpoint = _first(SAMPLERS[sampler](posterior, **settings), posterior, points)
    require_density(checkpoint.state.evaluation)
    return checkpoint


def checkpoint_to_arrays(checkpoint: Checkpoint) -> dict[str, np.ndarray]:
    """A checkpoint as named arrays, for a file."""
    return {f"leaf_{i:03d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(checkpoint))}


def checkpoint_from_arrays(
    arrays: dict[str, np.ndarray], posterior: Target, sampler: str, chains: int, **settings: float
) -> Checkpoint:
    """The inverse of `checkpoint_to_arrays`, for the same posterior, sampler and number of chains.

    Raises
    ------
    InputError
        If the arrays belong to another problem.
    """
    kernel = SAMPLERS[sampler](posterior, **settings)
    points = jax.tree.map(lambda x: jnp.zeros((chains, *x.shape)), posterior.estimands(posterior.reference()))
    expected = jax.eval_shape(lambda p: _first(kernel, posterior, p), points)
    leaves = [arrays[name] for name in sorted(arrays)]
    wanted, structure = jax.tree.flatten(expected)
    if [np.shape(leaf) for leaf in leaves] != [leaf.shape for leaf in wanted]:
        raise InputError("the stored state belongs to another problem: other nodes, parameters or number of chains")
    return jax.tree.unflatten(structure, leaves)


def _first(kernel: Sampler, posterior: Target, points: Any) -> Checkpoint:
    state = jax.jit(jax.vmap(kernel.init, in_axes=(None, 0)))(posterior.data, points)
    chains = len(state.evaluation.logdensity)
    moments = jax.vmap(lambda s: zero_moments(_watched(s)))(state)
    zeros = jnp.zeros(chains)
    return Checkpoint(np.array(0), state, moments, Tally(*(zeros,) * len(Tally._fields)), np.array(0.0))


def _watched(state: State) -> dict[str, Any]:
    return {"estimands": state.kernel.position, "u": state.evaluation.u}


def _advance(
    kernel: Sampler,
    posterior: Target,
    chain_keys: AnyArray,
    thin: int,
    block: int,
    draws: int,
    checkpoint: Checkpoint,
    began: float,
) -> Iterator[tuple[Block, Checkpoint]]:
    """Blocks of draws, until there are `draws` of them."""
    spent = float(checkpoint.seconds)
    while int(checkpoint.draws) < draws:
        length = min(block, draws - int(checkpoint.draws))
        state, moments, tally, found = _run_block(
            kernel.step, length, thin, posterior.data, chain_keys, int(checkpoint.draws), *checkpoint[1:4]
        )
        found = {name: np.asarray(value) for name, value in found.items()}
        seconds = np.array(spent + time.perf_counter() - began)
        checkpoint = Checkpoint(np.array(int(checkpoint.draws) + length), state, moments, tally, seconds)
        yield found, checkpoint


@partial(jax.jit, static_argnums=(0, 1, 2))
def _run_block(  # type: ignore[no-untyped-def]
    step,
    length: int,
    thin: int,
    data: Any,
    chain_keys: AnyArray,
    first: AnyArray | int,
    state: State,
    moments: Moments,
    tally: Tally,
):
    def chain(key: AnyArray, state: State, moments: Moments, tally: Tally):  # type: ignore[no-untyped-def]
        def one_draw(carry, draw):  # type: ignore[no-untyped-def]
            state, moments, tally = carry

            def one_step(i, carry):  # type: ignore[no-untyped-def]
                state, window = carry
                state, info = step(data, jax.random.fold_in(key, draw * thin + i), state)
                return state, _counted(window, info)

            nothing = Tally(*(jnp.zeros(()),) * len(Tally._fields))
            state, window = jax.lax.fori_loop(0, thin, one_step, (state, nothing))
            moments = updated(moments, _watched(state))
            return (state, moments, jax.tree.map(jnp.add, tally, window)), _kept(state, window)

        carry, kept = jax.lax.scan(one_draw, (state, moments, tally), first + jnp.arange(length))
        return *carry, kept

    return jax.vmap(chain)(chain_keys, state, moments, tally)


def _counted(window: Tally, info: Info) -> Tally:
    return Tally(
        steps=window.steps + 1,
        acceptance=window.acceptance + info.acceptance_rate,
        outside_support=window.outside_support + info.outside_support,
        solver_failed=window.solver_failed + info.solver_failed,
        solver_iterations=window.solver_iterations + info.solver_iterations,
        diverging=window.diverging + info.diverging,
    )


def _kept(state: State, window: Tally) -> dict[str, AnyArray]:
    """One kept draw; rates and counts are over the steps since the draw before it."""
    evaluation = state.evaluation
    return {
        **state.kernel.position,
        "lp": evaluation.logdensity,
        "similarity_energy": evaluation.similarity_energy,
        "strain_energy": evaluation.strain_energy,
        "acceptance_rate": window.acceptance / window.steps,
        "solver_iterations": window.solver_iterations / window.steps,
        "solver_failed": window.solver_failed.astype(int),
        "outside_support": window.outside_support.astype(int),
        "diverging": window.diverging.astype(int),
    }


def _until(
    stop: StopRule, advance: Iterator[tuple[Block, Checkpoint]], checkpoint: Checkpoint, bar: Progress
) -> Iterator[tuple[Block, Checkpoint]]:
    """The blocks up to the one at which the stop rule holds."""
    bar.show(checkpoint, scale_reduction(checkpoint.moments))
    while not (_converged(stop, checkpoint) or _out_of_time(stop, checkpoint)):
        found = next(advance, None)
        if found is None:
            return
        checkpoint = found[1]
        bar.show(checkpoint, scale_reduction(checkpoint.moments))
        yield found


def greatest_rhat(rhat: dict[str, np.ndarray]) -> float:
    """The worst of all estimands; NaN where it cannot be told."""
    return float(max((np.max(value, initial=0.0) for value in rhat.values()), default=np.nan))


def _converged(stop: StopRule, checkpoint: Checkpoint) -> bool:
    if stop.rhat is None or int(checkpoint.draws) < stop.min_draws:
        return False
    return greatest_rhat(scale_reduction(checkpoint.moments)["estimands"]) < stop.rhat


def _out_of_time(stop: StopRule, checkpoint: Checkpoint) -> bool:
    return stop.max_seconds is not None and float(checkpoint.seconds) >= stop.max_seconds


def _samples(
    posterior: Target, kernel: Sampler, blocks: list[Block], checkpoint: Checkpoint, stop: StopRule, draws: int
) -> Samples:
    mean, sd = pooled(checkpoint.moments)
    rhat = scale_reduction(checkpoint.moments)["estimands"]
    converged = None if stop.rhat is None else _converged(stop, checkpoint)
    return Samples(
        idata=to_inference_data(posterior, blocks),
        u_mean=mean["u"],
        u_sd=sd["u"],
        rhat=rhat,
        tally=jax.tree.map(np.asarray, checkpoint.tally),
        converged=converged,
        reason=_reason(stop, checkpoint, rhat, draws),
        seconds=float(checkpoint.seconds),
        exact=kernel.exact,
    )


def _reason(stop: StopRule, checkpoint: Checkpoint, rhat: dict[str, np.ndarray], draws: int) -> str:
    worst = greatest_rhat(rhat)
    if _converged(stop, checkpoint):
        return f"R̂ (unsplit) is below {stop.rhat:g} for every estimand; the greatest is {worst:.3f}"
    limit = f"{draws} draws per chain"
    if _out_of_time(stop, checkpoint):
        limit = f"{stop.max_seconds:g} s of sampling"
    if stop.rhat is None:
        return f"the budget of {limit} is spent; no convergence rule was set (greatest unsplit R̂ {worst:.3f})"
    return (
        f"the budget of {limit} is spent before convergence: the greatest unsplit R̂ is {worst:.3f}, "
        f"not below {stop.rhat:g}"
    )
