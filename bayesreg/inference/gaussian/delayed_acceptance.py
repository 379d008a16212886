"""Exact draws from kernels for a surrogate density (delayed acceptance).

The kernels are reversible for the surrogate π̃, which is cheap and close to the density π. Their result is a proposal,
which is accepted with the ratio π / π̃ at the proposal, divided by the same ratio at the current state. The draws are
those of π (the surrogate transition method, Liu 2001; delayed acceptance, Christen and Fox 2005). Reversible kernels in
a palindromic order are reversible together, so that one evaluation of π tests several transitions at once. It is also
the record of the draw.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bayesreg.inference.gaussian.warm_up import Walking
from bayesreg.inference.gaussian.whitened import Setup, whitened_position
from bayesreg.inference.kernel import Draw, Info, Sampler, joined
from bayesreg.inference.target import Estimands, Target
from bayesreg.types import AnyArray, Scalar

# The number of transitions that are tested at once: the exact density costs about as much as one transition, and the
# test seldom rejects a good surrogate.
TOGETHER = 2


class ChainData(NamedTuple):
    """The data of a target that has a surrogate, and those of the surrogate (a pytree)."""

    exact: Any
    surrogate: Any


class Exact(NamedTuple):
    """The evaluation of the density π at the state of a kernel.

    Attributes
    ----------
    evaluation : Evaluation
    log_ratio : scalar
        log(π / π̃), up to a constant.
    """

    evaluation: Any
    log_ratio: Scalar


class Delayed(NamedTuple):
    """The state of a chain: the state of the kernels for the surrogate, and the density there."""

    kernel: Any
    exact: Exact


def delay_acceptance(
    step: Callable[[AnyArray, Any], tuple[Any, Info]],
    move: Callable[[AnyArray, Any], Any],
    evaluate: Callable[[Any], Exact],
    key: AnyArray,
    state: Delayed,
) -> tuple[Delayed, Info]:
    """Make one transition for π by kernels for π̃: `TOGETHER` steps, with a move between each two of them.

    Parameters
    ----------
    step : callable
        (key, state of the kernels) → (state, info); reversible.
    move : callable
        (key, state of the kernels) → state; reversible.
    evaluate : callable
        (state of the kernels) → the exact density there. It is the record of a draw, and not counted in `Info`.
    key : PRNG key
    state : Delayed

    Returns
    -------
    Delayed
        The proposal if it is accepted, else the given state.
    Info
        The sum over the steps; the acceptance rate is their mean times the probability to accept the proposal.
    """
    key_steps, key_moves, key_accept = jax.random.split(key, 3)

    def one_step(k: AnyArray, kernel_and_info: tuple[Any, Info]) -> tuple[Any, Info]:
        kernel, info = step(jax.random.fold_in(key_steps, k), kernel_and_info[0])
        key_move = jax.random.fold_in(key_moves, k)
        kernel = jax.lax.cond(k < TOGETHER - 1, lambda kernel: move(key_move, kernel), lambda kernel: kernel, kernel)
        return kernel, joined(kernel_and_info[1], info)

    blank = jax.eval_shape(lambda key: step(key, state.kernel)[1], key)
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), blank)
    kernel, info = jax.lax.fori_loop(0, TOGETHER, one_step, (state.kernel, nothing))
    candidate = Delayed(kernel, evaluate(kernel))
    gain = candidate.exact.log_ratio - state.exact.log_ratio
    probability = jnp.exp(jnp.minimum(jnp.nan_to_num(gain, nan=-jnp.inf), 0.0))
    accepted = jax.random.uniform(key_accept) < probability
    next_state = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), candidate, state)
    return next_state, info._replace(acceptance_rate=info.acceptance_rate / TOGETHER * probability)


def chain_data(target: Target, data: Any) -> Any:
    """Return the data that the samplers of a target take: `ChainData` if the target has a surrogate."""
    return data if target.surrogate is None else ChainData(data, target.surrogate(data))


def with_delayed_acceptance(target: Target, sampler: Sampler, walk: Walking) -> Sampler:
    """Turn a sampler into one whose kernels see the surrogate of the target."""

    def evaluate(data: ChainData, setup: Setup, kernel: Any) -> Exact:
        position = whitened_position(target, setup.gaussian, kernel.position)
        estimands, log_jacobian = target.coordinates.constrain(data.exact, position)
        evaluation = target.evaluate_estimands(data.exact, estimands)
        log_jacobian += setup.gaussian.log_jacobian(kernel.position)
        return Exact(evaluation, evaluation.logdensity + log_jacobian - kernel.logdensity)

    def init(data: ChainData, setup: Setup, estimands: Estimands) -> Delayed:
        kernel = walk.init(data.surrogate, setup, estimands)
        return Delayed(kernel, evaluate(data, setup, kernel))

    def step(data: ChainData, setup: Setup, key: AnyArray, state: Delayed) -> tuple[Delayed, Info]:
        shared = data.surrogate, setup
        kernels = partial(walk.step, *shared), partial(walk.move_hyperparameters, *shared)
        return delay_acceptance(*kernels, partial(evaluate, data, setup), key, state)

    def observe(data: ChainData, setup: Setup, state: Delayed) -> Draw:
        return Draw(walk.estimands(data.exact, setup, state.kernel), state.exact.evaluation)

    def data_of(setup: Setup) -> ChainData:
        return chain_data(target, sampler.data(setup))

    return sampler._replace(data=data_of, init=init, step=step, observe=observe)
