"""The warm-up: dual averaging finds the step size for an acceptance; the step size is then fixed."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from blackjax.adaptation.step_size import dual_averaging_adaptation

from bayesreg.inference.deadline import NEVER, Deadline
from bayesreg.inference.kernel import Info
from bayesreg.inference.target import Estimands
from bayesreg.types import AnyArray, InputError

_log = logging.getLogger(__name__)

# The tuning starts at this step size; dual averaging pulls it towards ten times as much.
FIRST_STEP = 0.05
# The greatest number of steps of a trajectory while each chain has a step size of its own: all chains wait for the
# slowest one.
FEW_STEPS = 8
# The tuning fails if the acceptance is lower than this share after this number of transitions.
LEAST_ACCEPTANCE, ENOUGH = 0.01, 20


class Tuning(NamedTuple):
    """The options for the tuning of the step size.

    Attributes
    ----------
    warm_up : int
        The number of transitions that tune the step size and are not kept.
    acceptance : float
        The desired acceptance, between 0 and 1, averaged over chains.
    least, greatest : float
        The bounds of the step size. A step longer than a quarter turn, the default, has no advantage.
    quarter_turns : bool
        Whether a transition is a quarter turn of the Gaussian, in equal steps that are no longer than the acceptance
        allows.
    """

    warm_up: int
    acceptance: float
    least: float = 0.01
    greatest: float = float(jnp.pi / 2)
    quarter_turns: bool = False


@runtime_checkable
class Walking(Protocol):
    """A hashable object that moves the chains (`bayesreg.inference.gaussian.about_gaussian.Walk`)."""

    def init(self, data: Any, setup: Any, estimands: Estimands) -> Any:
        """Make the state of a chain, as in `Sampler`."""

    def step(self, data: Any, setup: Any, key: AnyArray, state: Any) -> tuple[Any, Info]:
        """Make one transition, as in `Sampler`."""

    def move_hyperparameters(self, data: Any, setup: Any, key: AnyArray, state: Any) -> Any:
        """Move hyperparameters with the displacements fixed."""

    def estimands(self, data: Any, setup: Any, state: Any) -> dict[str, AnyArray]:
        """Compute the current estimands of a chain."""


def tune(
    data: Any,
    walk: Walking,
    setup: Any,
    starts: Any,
    key: AnyArray,
    tuning: Tuning,
    per_chain: bool = False,
    deadline: Deadline = NEVER,
) -> tuple[Any, Any]:
    """Tune the step size; return the setup with it, and the estimands of the chains at the end.

    Parameters
    ----------
    data : pytree
    walk : Walking
    setup : Setup
    starts : pytree
        The estimands at which chains start, with chains as the leading axis.
    key : PRNG key
    tuning : Tuning
    per_chain : bool
        Whether each chain has a step size of its own, and trajectories have at most `FEW_STEPS` steps. A chain that
        starts where the density is steep then takes short steps until it has left that region. With one step size for
        all chains, it would not move, or would shorten the steps of the others.
    deadline : Deadline
        The tuning ends then, with the step size so far.

    Raises
    ------
    InputError
        If the chains accept (nearly) no transition.
    """
    states, averaging = _begin(walk, tuning, data, setup, starts)
    rates: list[float] = []
    for key_transition in jax.random.split(key, tuning.warm_up):
        if deadline.has_passed:
            _log.warning("warm-up: the time is spent after %d of %d transitions", len(rates), tuning.warm_up)
            break
        arguments = data, setup, states, averaging, key_transition, jnp.asarray(per_chain)
        states, averaging, rate = _transition(walk, tuning, *arguments)
        rates.append(float(rate))
    if not rates:
        return setup, starts
    points, sizes = _end(walk, tuning, data, setup, states, averaging)
    setup, late = with_step_size(tuning, setup, jnp.median(sizes)), float(np.mean(rates[len(rates) // 2 :]))
    if len(rates) >= ENOUGH and late < LEAST_ACCEPTANCE and not per_chain:
        raise InputError(
            f"the warm-up accepts {late:.1%} of its transitions, even with steps of {float(setup.step_size):.2g} "
            "standard deviations: the search has not ended at a mode, or the density is rough about it. Most often the "
            "images do not fit: check the pose and the mask (bayesreg check), or start from a displacement field "
            "(start.field)"
        )
    trajectory = f", {int(setup.steps)} to a quarter turn" if tuning.quarter_turns else ""
    _log.info("warm-up: step %.2g%s, acceptance %.0f%%", float(setup.step_size), trajectory, 100 * late)
    return setup, points


def compile_transition(data: Any, walk: Walking, setup: Any, starts: Any, tuning: Tuning) -> None:
    """Compile the program of `tune` for arguments of these shapes, by a call of it."""
    states, averaging = _begin(walk, tuning, data, setup, starts)
    _transition(walk, tuning, data, setup, states, averaging, jax.random.key(0), jnp.asarray(True))


def _begin(walk: Walking, tuning: Tuning, data: Any, setup: Any, starts: Any) -> tuple[Any, Any]:
    """Make the states of the chains and of their dual averaging."""
    states = jax.vmap(partial(walk.init, data, setup))(starts)
    averaging = jax.vmap(_averaging(tuning)[0])(jnp.full(len(jax.tree.leaves(states)[0]), setup.step_size))
    return _with_strong_types((states, averaging))


def _with_strong_types(tree: Any) -> Any:
    """Make the types of all arrays strong: one call's result then has the types of its arguments."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), tree)


def _averaging(tuning: Tuning) -> tuple[Callable, Callable, Callable]:
    """Return the functions of dual averaging: begin, update and final."""
    return dual_averaging_adaptation(tuning.acceptance)


# One transition is one call, so that a signal and the deadline are noticed between two of them.
@partial(jax.jit, static_argnums=(0, 1))
def _transition(
    walk: Walking,
    tuning: Tuning,
    data: Any,
    setup: Any,
    states: Any,
    averaging: Any,
    key: AnyArray,
    per_chain: AnyArray,
) -> tuple[Any, Any, AnyArray]:
    """Make one transition of every chain; return states, averages and the mean acceptance."""
    update = _averaging(tuning)[1]

    def step_chain(state: Any, size: AnyArray, key: AnyArray) -> Any:
        now = with_step_size(tuning, setup, size)
        few = jnp.minimum(now.steps, FEW_STEPS)
        key_step, key_scales = jax.random.split(key)
        state, info = walk.step(data, now._replace(steps=jnp.where(per_chain, few, now.steps)), key_step, state)
        return walk.move_hyperparameters(data, setup, key_scales, state), info

    sizes = jnp.exp(averaging.log_step_size)
    states, info = jax.vmap(step_chain)(states, sizes, jax.random.split(key, len(sizes)))
    rates = jnp.nan_to_num(info.acceptance_rate)
    averaging = jax.vmap(update)(averaging, jnp.where(per_chain, rates, rates.mean()))
    return *_with_strong_types((states, averaging)), rates.mean()


@partial(jax.jit, static_argnums=(0, 1))
def _end(walk: Walking, tuning: Tuning, data: Any, setup: Any, states: Any, averaging: Any) -> tuple[Any, AnyArray]:
    """Return the estimands and the step size of each chain after its last transition."""
    return jax.vmap(partial(walk.estimands, data, setup))(states), jax.vmap(_averaging(tuning)[2])(averaging)


def with_step_size(tuning: Tuning, setup: Any, size: AnyArray | float) -> Any:
    """Return the setup with a step size within the bounds and, for quarter turns, the number of steps."""
    size = jnp.clip(size, tuning.least, tuning.greatest)
    if not tuning.quarter_turns:
        return setup._replace(step_size=size)
    # After less than a quarter turn, the new position is correlated with the old one; after much more, its square is.
    steps = jnp.maximum(jnp.ceil(jnp.pi / 2 / size), 1).astype(int)
    return setup._replace(step_size=jnp.pi / 2 / steps, steps=steps)
