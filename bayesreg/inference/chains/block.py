"""A block of draws of every chain: vmap over chains, a loop over steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from bayesreg.inference.chains.checkpoint import Tally, count_step, no_steps, with_passed_over, with_solve
from bayesreg.inference.chains.devices import side_by_side
from bayesreg.inference.draws.moments import Moments, update
from bayesreg.inference.kernel import Draw, Info
from bayesreg.inference.samplers.registry import Chosen
from bayesreg.types import AnyArray

# (number of a step in the block, state) → (state, Info)
Step = Callable[[AnyArray, Any], tuple[Any, Info]]

# (number of a step in the block, state) → whether that step proposes a point outside the support
Outside = Callable[[AnyArray, Any], AnyArray]


class _Drawn(NamedTuple):
    """The results of a block for one chain.

    Attributes
    ----------
    state : pytree
        The state after the last step.
    moments : Moments
    places : dict of (draw, ...) arrays
        The estimands and energies of each draw, see `_place`.
    windows : Tally of (draw,) arrays
        The tally of the steps between each draw and the draw before it.
    """

    state: Any
    moments: Moments
    places: dict[str, AnyArray]
    windows: Tally


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def run_block(
    chosen: Chosen,
    length: int,
    thin: int,
    devices: Mesh | None,
    data: Any,
    seed: AnyArray | int,
    numbers: AnyArray,
    first: AnyArray | int,
    count: AnyArray | int,
    setup: Any,
    state: Any,
    moments: Moments,
    tally: Tally,
) -> tuple[Any, Moments, Tally, dict[str, AnyArray]]:
    """Draw a block from every chain: `count` draws of `thin` steps each.

    Parameters
    ----------
    chosen : Chosen
    length, thin : int
        `length` is the greatest number of draws; the code is compiled once for all counts up to it.
    devices : Mesh or None
        The devices that share the chains.
    data : pytree
        The data that the sampler takes.
    seed, numbers, first : int, (c,) int array, int
        The seed, the number of each chain, and the number of draws before this block. They determine the random keys.
    count : int
    setup, state, moments, tally : pytrees
        As in a `Checkpoint`, before the block.

    Returns
    -------
    state, moments, tally
        As in a `Checkpoint`, after the block.
    draws : dict of (c, length, ...) arrays
        The draws; those after the first `count` have no meaning. Rates and counts cover the steps between each draw and
        the draw before it.
    """
    kernel = chosen.sampler
    _, key_chains = jax.random.split(jax.random.key(seed))

    def chain(
        number: AnyArray, state: Any, moments: Moments, tally: Tally
    ) -> tuple[Any, Moments, Tally, dict[str, AnyArray]]:
        key_chain = jax.random.fold_in(key_chains, number)

        def key(i: AnyArray) -> AnyArray:
            return jax.random.fold_in(key_chain, first * thin + i)

        def step(i: AnyArray, state: Any) -> tuple[Any, Info]:
            return kernel.step(data, setup, key(i), state)

        def outside(i: AnyArray, state: Any) -> AnyArray:
            assert kernel.outside is not None
            return kernel.outside(data, setup, key(i), state)

        observe = partial(kernel.observe, data, setup)
        if kernel.outside is None:
            drawn = _in_step(step, observe, kernel.many_solves, length, count, thin, state, moments)
        else:
            drawn = _at_own_pace(step, outside, observe, length, count, thin, state, moments)
        tally = jax.tree.map(lambda before, window: before + window.sum(), tally, drawn.windows)
        return drawn.state, drawn.moments, tally, drawn.places | _statistics(drawn.windows)

    return side_by_side(chain, devices)(numbers, state, moments, tally)


def watched_values(draw: Draw) -> dict[str, Any]:
    """Take the values whose moments are computed."""
    return {"estimands": draw.estimands, "u": draw.evaluation.u}


def _in_step(
    step: Step,
    observe: Callable[[Any], Draw],
    many_solves: bool,
    length: int,
    count: AnyArray | int,
    thin: int,
    state: Any,
    moments: Moments,
) -> _Drawn:
    """Run a block in which all chains take each step at the same time."""

    def one_draw(draw: AnyArray, drawn: _Drawn) -> _Drawn:
        def one_step(i: AnyArray | int, state_and_tally: tuple[Any, Tally]) -> tuple[Any, Tally]:
            state, info = step(draw * thin + i, state_and_tally[0])
            return state, count_step(state_and_tally[1], info)

        state, window = jax.lax.fori_loop(0, thin, one_step, (drawn.state, no_steps()))
        observed = observe(state)
        if many_solves:
            window = with_solve(window, observed.evaluation, thin)
        places, windows = (
            jax.tree.map(lambda rows, x: rows.at[draw].set(x), rows, row)
            for rows, row in ((drawn.places, _place(observed)), (drawn.windows, window))
        )
        return _Drawn(state, update(drawn.moments, watched_values(observed)), places, windows)

    shapes = jax.eval_shape(lambda state: _place(observe(state)), state)
    places = jax.tree.map(lambda x: jnp.zeros((length, *x.shape), x.dtype), shapes)
    return jax.lax.fori_loop(0, count, one_draw, _Drawn(state, moments, places, no_steps((length,))))


def _at_own_pace(
    step: Step,
    outside: Outside,
    observe: Callable[[Any], Draw],
    length: int,
    count: AnyArray | int,
    thin: int,
    state: Any,
    moments: Moments,
) -> _Drawn:
    """Run a block in which each chain skips the steps whose proposals lie outside the support.

    All chains evaluate the density at the same time, but each at its own step and its own draw. Chains wait for each
    other only at the end of the block. The state of a chain does not change between two steps that it takes, and all
    draws that end between them are equal.
    """

    def next_taken(i: AnyArray, state: Any) -> AnyArray:
        return jax.lax.while_loop(lambda i: (i < count * thin) & outside(i, state), lambda i: i + 1, i)

    def one_step(carry: tuple[AnyArray, _Drawn]) -> tuple[AnyArray, _Drawn]:
        i, (state, moments, places, windows) = carry
        state, info = step(i, state)
        following = next_taken(i + 1, state)
        drawn, draw = observe(state), i // thin
        moments = update(moments, watched_values(drawn), following // thin - draw)
        places = jax.tree.map(lambda rows, x: rows.at[draw + 1].set(x), places, _place(drawn))
        windows = jax.tree.map(lambda rows, x: rows.at[draw].add(x), windows, count_step(no_steps(), info))
        return following, _Drawn(state, moments, places, windows)

    begun = observe(state)
    # Row 0 is the state before the block, row d + 1 the state after the last step that was taken for draw d.
    places = jax.tree.map(lambda x: jnp.zeros((length + 1, *jnp.shape(x)), x.dtype).at[0].set(x), _place(begun))
    first = next_taken(jnp.zeros((), int), state)
    moments = update(moments, watched_values(begun), first // thin)
    carry = first, _Drawn(state, moments, places, no_steps((length,)))
    _, (state, moments, places, windows) = jax.lax.while_loop(lambda carry: carry[0] < count * thin, one_step, carry)
    latest = jax.lax.cummax(jnp.where(windows.steps > 0, jnp.arange(1, length + 1), 0))
    places = jax.tree.map(lambda rows: rows[latest], places)
    passed_over = jnp.where(jnp.arange(length) < count, thin - windows.steps, 0)
    return _Drawn(state, moments, places, with_passed_over(windows, passed_over))


def _place(drawn: Draw) -> dict[str, AnyArray]:
    evaluation = drawn.evaluation
    return {
        **drawn.estimands,
        "lp": evaluation.logdensity,
        "similarity_energy": evaluation.similarity_energy,
        "strain_energy": evaluation.strain_energy,
    }


def _statistics(windows: Tally) -> dict[str, AnyArray]:
    """Compute rates and counts over the steps between each draw and the draw before it."""
    return {
        "acceptance_rate": windows.acceptance / windows.steps,
        "solver_iterations": windows.solver_iterations / windows.steps,
        "solver_failed": windows.solver_failed.astype(int),
        "outside_support": windows.outside_support.astype(int),
        "diverging": windows.diverging > 0,
        "n_steps": windows.gradients.astype(int),
    }
