"""Warm-up: the step size that meets an acceptance, by dual averaging; what it settles on is then kept."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from blackjax.adaptation.step_size import dual_averaging_adaptation

from bayesreg.inference.kernel import Say
from bayesreg.types import AnyArray, InputError, Scalar

# The tuning of the step starts here, and is drawn to ten times as much.
FIRST_STEP = 0.05


class Tuning(NamedTuple):
    """How the step size is found.

    Attributes
    ----------
    warm_up : int
        Transitions in which it is tuned and that are not kept.
    acceptance : float
        Between 0 and 1, averaged over chains.
    least, greatest : float
        Bounds of the step. Beyond a quarter turn, the default, there is nothing to gain.
    """

    warm_up: int
    acceptance: float
    least: float = 0.01
    greatest: float = float(jnp.pi / 2)


def require_sound(tuning: Tuning) -> None:
    """Raise InputError where an option is out of range."""
    if not 0 < tuning.acceptance < 1:
        raise InputError(f"target_acceptance must lie between 0 and 1, got {tuning.acceptance}")
    if tuning.warm_up < 1:
        raise InputError(f"warm_up must be at least 1, got {tuning.warm_up}")


def tuned(
    data: Any, kernel: tuple[Callable, Callable, Callable], setup: Any, starts: Any, key: AnyArray, tuning: Tuning,
    say: Say,
) -> tuple[Any, Any]:  # fmt: skip
    """The setup with its step size, and where the chains then are.

    Parameters
    ----------
    data : pytree
    kernel : (callable, callable, callable)
        `Sampler.init` and `Sampler.step`, and (data, setup, state) → estimands.
    setup : Setup
    starts : pytree
        Estimands, chains as the leading axis.
    key : PRNG key
    tuning : Tuning
    say : callable
        Told of what was found.
    """
    init, step, estimands_of = kernel
    begin, update, final = dual_averaging_adaptation(tuning.acceptance)

    def sized(setup: Any, size: Scalar) -> Any:
        size = jnp.clip(size, tuning.least, tuning.greatest)
        steps = jnp.maximum(jnp.round(jnp.pi / 2 / size), 1).astype(int)
        return setup._replace(step_size=size, steps=steps)

    @jax.jit
    def run(data: Any, setup: Any, starts: Any, key: AnyArray) -> Any:
        states = jax.vmap(partial(init, data, setup))(starts)

        def one(carry: Any, key: AnyArray) -> Any:
            states, averaging = carry
            keys = jax.random.split(key, len(next(iter(starts.values()))))
            states, info = jax.vmap(partial(step, data, sized(setup, jnp.exp(averaging.log_step_size))))(keys, states)
            rate = jnp.nan_to_num(info.acceptance_rate).mean()
            return (states, update(averaging, rate)), rate

        first = states, begin(setup.step_size)
        (states, averaging), rates = jax.lax.scan(one, first, jax.random.split(key, tuning.warm_up))
        return jax.vmap(partial(estimands_of, data, setup))(states), final(averaging), rates

    points, size, rates = run(data, setup, starts, key)
    setup, late = sized(setup, size), float(rates[tuning.warm_up // 2 :].mean())
    say(f"warm-up: step {float(setup.step_size):.2g}, {int(setup.steps)} to a quarter turn, acceptance {late:.0%}")
    return setup, points
