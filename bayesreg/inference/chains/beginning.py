"""The state of the chains before their first draw, new or stored."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.inference.chains.block import run_block, watched_values
from bayesreg.inference.chains.checkpoint import Checkpoint, no_steps
from bayesreg.inference.chains.devices import devices_for, share
from bayesreg.inference.chains.initialise import Start, require_density, require_numbers, starting_points
from bayesreg.inference.deadline import NEVER, Deadline
from bayesreg.inference.draws.blocks import Blocks
from bayesreg.inference.draws.moments import zero_moments
from bayesreg.inference.gaussian.modes import temper
from bayesreg.inference.kernel import Draw, OnMode
from bayesreg.inference.samplers.registry import Chosen, choose_sampler
from bayesreg.inference.target import Target
from bayesreg.types import AnyArray, InputError


def temper_target(
    target: Target,
    chains: int,
    seed: int,
    start: Start | None = None,
    deadline: Deadline = NEVER,
) -> Target:
    """Temper a target by its residuals if its options ask for it; `sample` draws from the result."""
    points = starting_points(target, start or Start(), chains, _start_key(seed))
    require_numbers(points)
    return temper(target, points, deadline)


def _start_key(seed: int) -> AnyArray:
    return jax.random.split(jax.random.key(seed))[0]


def first_checkpoint(
    target: Target,
    sampler: str,
    chains: int,
    seed: int,
    start: Start | None = None,
    deadline: Deadline = NEVER,
    on_mode: OnMode = lambda _estimands: None,
    **settings: Any,
) -> Checkpoint:
    """Make the checkpoint before the first draw; `sample` starts its chains there unless it resumes a run.

    At the deadline the search and the warm-up end with what they have. `on_mode` is called between the two, see
    `Sampler.prepare`.

    Raises
    ------
    InputError
        If a chain cannot start at its start point.
    """
    began = time.perf_counter()
    key_start = _start_key(seed)
    points = starting_points(target, start or Start(), chains, key_start)
    require_numbers(points)
    chosen = choose_sampler(sampler, target, **settings)
    setup, points = chosen.sampler.prepare(points, jax.random.fold_in(key_start, 1), deadline, on_mode)
    data = chosen.sampler.data(setup)
    checkpoint = _first(chosen, data, setup, points)
    require_density(_observe(chosen, data, setup, checkpoint.state).evaluation)
    return checkpoint._replace(seconds=np.array(time.perf_counter() - began))


def checkpoint_from_arrays(
    arrays: dict[str, np.ndarray], target: Target, sampler: str, chains: int, **settings: Any
) -> Checkpoint:
    """Convert named arrays to a checkpoint, for the same posterior, sampler and number of chains.

    This is the inverse of `checkpoint_to_arrays`.

    Raises
    ------
    InputError
        If the arrays belong to another problem.
    """
    chosen = choose_sampler(sampler, target, **settings)
    setup, points = _blank(chosen, chains)
    expected = jax.eval_shape(partial(_first, chosen), chosen.sampler.data(setup), setup, points)
    leaves = [arrays[name] for name in sorted(arrays)]
    wanted, structure = jax.tree.flatten(expected)
    if [np.shape(leaf) for leaf in leaves] != [leaf.shape for leaf in wanted]:
        raise InputError(
            "the stored state belongs to another problem: other nodes, parameters or number of chains, or a run that "
            "another version of bayesreg began"
        )
    return jax.tree.unflatten(structure, leaves)


def compile_programs(
    target: Target, sampler: str, chains: int, length: int, thin: int, **settings: Any
) -> Iterator[None]:
    """Compile the programs of the warm-up and of a block of draws, so that they are there when the search has ended.

    They are called at the reference: the warm-up for one transition, the block without draws.

    Yields
    ------
    None
        After each program.
    """
    chosen = choose_sampler(sampler, target, **settings)
    setup, points = _blank(chosen, chains)
    if chosen.sampler.compile is not None:
        chosen.sampler.compile(setup, points)
        yield
    data = chosen.sampler.data(setup)
    checkpoint, devices = _first(chosen, data, setup, points), devices_for(chains)
    numbers, shared = np.arange(chains), share(checkpoint[2:5], devices)
    run_block(chosen, length, thin, devices, data, 0, numbers, 0, 0, setup, *shared)
    yield


def _blank(chosen: Chosen, chains: int) -> tuple[Any, Any]:
    """Return a setup of a sampler and points of chains, of the right shapes."""
    reference = chosen.target.coordinates.reference()
    return chosen.sampler.blank(), jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * chains), reference)


def require_continuation(chosen: Chosen, checkpoint: Checkpoint, blocks: Blocks) -> None:
    """Raise InputError if the chains do not stand at their last draws: coordinates differ between versions."""
    if len(blocks) == 0:
        return
    last = blocks[len(blocks) - 1]
    estimands = _observe(chosen, chosen.sampler.data(checkpoint.setup), checkpoint.setup, checkpoint.state).estimands
    if not all(np.allclose(estimands[name], last[name][:, -1], rtol=1e-3, atol=1e-4) for name in estimands):
        raise InputError(
            "the chains do not stand where their last draws were: another version of bayesreg began this run; begin it "
            "anew in another folder"
        )


def _first(chosen: Chosen, data: Any, setup: Any, points: Any) -> Checkpoint:
    state = jax.vmap(partial(chosen.sampler.init, data, setup))(points)
    chains = len(next(iter(points.values())))
    shapes = jax.eval_shape(partial(_observe, chosen), data, setup, state)
    moments = jax.vmap(zero_moments)(jax.tree.map(lambda x: jnp.zeros(x.shape), watched_values(shapes)))
    return Checkpoint(np.array(0), setup, state, moments, no_steps((chains,)), np.array(0.0))


@partial(jax.jit, static_argnums=0)
def _observe(chosen: Chosen, data: Any, setup: Any, state: Any) -> Draw:
    return jax.vmap(partial(chosen.sampler.observe, data, setup))(state)
