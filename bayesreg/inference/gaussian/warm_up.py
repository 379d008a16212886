"""Warm-up: the step size that meets an acceptance, by dual averaging; what it settles on is then kept."""

from __future__ import annotations

import logging
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from blackjax.adaptation.step_size import dual_averaging_adaptation

from bayesreg.inference.kernel import Info
from bayesreg.inference.target import Estimands
from bayesreg.types import AnyArray

_log = logging.getLogger(__name__)

# The tuning of the step starts here, and is drawn to ten times as much.
FIRST_STEP = 0.05
# Steps of a trajectory while chains are tuned apart: it ends when the slowest of them does.
FEW_STEPS = 8


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
    quarter_turns : bool
        Whether a transition has as many steps as make a quarter turn of the Gaussian, of one size no greater than what
        the acceptance allows.
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
        """See `Sampler`."""

    def step(self, data: Any, setup: Any, key: AnyArray, state: Any) -> tuple[Any, Info]:
        """See `Sampler`."""

    def estimands(self, data: Any, setup: Any, state: Any) -> dict[str, AnyArray]:
        """Where a chain is."""


def tune(
    data: Any, walk: Walking, setup: Any, starts: Any, key: AnyArray, tuning: Tuning, apart: bool = False
) -> tuple[Any, Any]:  # fmt: skip
    """The setup with its step size, and where the chains then are.

    Parameters
    ----------
    data : pytree
    walk : Walking
    setup : Setup
    starts : pytree
        Estimands, chains as the leading axis.
    key : PRNG key
    tuning : Tuning
    apart : bool
        Tune each chain's step by itself, and let no trajectory have more than `FEW_STEPS`. A chain that starts where
        the density is steep takes short steps until it is back; with one step for all it would stand still for as long
        as the others take longer ones, or shorten theirs.
    """
    keys = jax.random.split(key, tuning.warm_up)
    first = jax.vmap(partial(walk.init, data, setup))(starts)
    points, sizes, rates = _run(walk, tuning, data, setup, first, keys, jnp.asarray(apart))
    setup, late = _with_step_size(tuning, setup, jnp.median(sizes)), float(rates[len(rates) // 2 :].mean())
    trajectory = f", {int(setup.steps)} to a quarter turn" if tuning.quarter_turns else ""
    _log.info("warm-up: step %.2g%s, acceptance %.0f%%", float(setup.step_size), trajectory, 100 * late)
    return setup, points


@partial(jax.jit, static_argnums=(0, 1))
def _run(
    walk: Walking,
    tuning: Tuning,
    data: Any,
    setup: Any,
    first: Any,
    keys: AnyArray,
    apart: AnyArray,
) -> tuple[Any, AnyArray, AnyArray]:
    """Estimands and step size by chain, and the acceptance of every transition."""
    begin, update, final = dual_averaging_adaptation(tuning.acceptance)
    chains = len(jax.tree.leaves(first)[0])

    def moved(state: Any, size: AnyArray, key: AnyArray) -> Any:
        now = _with_step_size(tuning, setup, size)
        few = jnp.minimum(now.steps, FEW_STEPS)
        return walk.step(data, now._replace(steps=jnp.where(apart, few, now.steps)), key, state)

    def one(carry: Any, key: AnyArray) -> Any:
        states, averaging = carry
        states, info = jax.vmap(moved)(states, jnp.exp(averaging.log_step_size), jax.random.split(key, chains))
        rates = jnp.nan_to_num(info.acceptance_rate)
        averaging = jax.vmap(update)(averaging, jnp.where(apart, rates, rates.mean()))
        return (states, averaging), rates.mean()

    averaging = jax.vmap(begin)(jnp.full(chains, setup.step_size))
    (states, averaging), rates = jax.lax.scan(one, (first, averaging), keys)
    return jax.vmap(partial(walk.estimands, data, setup))(states), jax.vmap(final)(averaging), rates


def _with_step_size(tuning: Tuning, setup: Any, size: AnyArray) -> Any:
    size = jnp.clip(size, tuning.least, tuning.greatest)
    if not tuning.quarter_turns:
        return setup._replace(step_size=size)
    # Less leaves what is not refused correlated with where it came from, and much more its square.
    steps = jnp.maximum(jnp.ceil(jnp.pi / 2 / size), 1).astype(int)
    return setup._replace(step_size=jnp.pi / 2 / steps, steps=steps)
