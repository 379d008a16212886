"""BlackJAX samplers behind one small adapter, and their registry.

A sampler here is a pair of pure functions, `init` and `step`, in the constrained space of the estimands.
`State` holds what the next step needs, `Info` what a person wants to know.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import blackjax
import jax
import jax.numpy as jnp

from bayesreg.inference.target import Estimands, Target
from bayesreg.types import AnyArray, InputError


class State(NamedTuple):
    """One chain: BlackJAX's state, and the evaluation of the density at its position."""

    kernel: Any
    evaluation: Any


class Info(NamedTuple):
    """One transition: what the proposal met, and the probability with which it was accepted."""

    acceptance_rate: AnyArray
    outside_support: AnyArray
    solver_failed: AnyArray
    solver_iterations: AnyArray
    diverging: AnyArray


class Sampler(NamedTuple):
    """A transition kernel.

    Attributes
    ----------
    init : callable
        (data, estimands) → State.
    step : callable
        (data, key, state) → (State, Info).
    exact : bool
        Whether the posterior is its stationary distribution.
    """

    init: Callable[[Any, Estimands], State]
    step: Callable[[Any, AnyArray, State], tuple[State, Info]]
    exact: bool


def rwmh(target: Target, sigma_u: float = 0.008, sigma_lam: float = 0.03, sigma_mu: float = 0.003) -> Sampler:
    """Random-walk Metropolis with the paper's three Normal kernels (eqs. 13 and 14), all proposed at once.

    Parameters
    ----------
    target : Target
    sigma_u, sigma_lam, sigma_mu : float
        Standard deviations of the steps, positive: mm, and the unit of λ and μ.

    Raises
    ------
    InputError
        If a standard deviation is not positive.
    """
    sigma = {"u_boundary": sigma_u, "lam": sigma_lam, "mu": sigma_mu}
    for name, value in sigma.items():
        if not value > 0:
            raise InputError(f"the step of {name} must be positive, got {value}")

    def init(data: Any, estimands: Estimands) -> State:
        evaluation = target.evaluate_estimands(data, estimands)
        kernel = blackjax.additive_step_random_walk(lambda _: evaluation.logdensity, lambda *_: estimands)
        return State(kernel.init(estimands), evaluation)

    def step(data: Any, key: AnyArray, state: State) -> tuple[State, Info]:
        # The proposal is drawn and evaluated here, once, so that its energies and its solve are seen;
        # BlackJAX is handed both and decides.
        key_proposal, key_accept = jax.random.split(key)
        position, current = state.kernel.position, state.evaluation
        move = _normal_step(key_proposal, position, sigma)
        proposal = jax.tree.map(jnp.add, position, move)
        # A proposal outside the support needs no solve: the chain evaluates where it stands, at no iteration.
        inside = target.supports(data, proposal)
        place = jax.tree.map(lambda new, old: jnp.where(inside, new, old), proposal, position)
        evaluation = target.evaluate_estimands(data, place, guess=current.u)
        logdensity = jnp.where(inside, evaluation.logdensity, -jnp.inf)
        kernel = blackjax.additive_step_random_walk(lambda _: logdensity, lambda *_: move)
        kernel_state, kernel_info = kernel.step(key_accept, state.kernel)
        kept = jax.tree.map(lambda new, old: jnp.where(kernel_info.is_accepted, new, old), evaluation, state.evaluation)
        info = Info(
            acceptance_rate=kernel_info.acceptance_rate,
            outside_support=~inside,
            solver_failed=inside & evaluation.solver_failed,
            solver_iterations=evaluation.solver_iterations,
            diverging=jnp.zeros((), bool),
        )
        return State(kernel_state, kept), info

    return Sampler(init, step, exact=True)


def _normal_step(key: AnyArray, position: Estimands, sigma: dict[str, float]) -> dict[str, AnyArray]:
    keys = jax.random.split(key, len(sigma))
    draws = {name: subkey for name, subkey in zip(sigma, keys, strict=True) if name in position}
    return {name: sigma[name] * jax.random.normal(subkey, position[name].shape) for name, subkey in draws.items()}


SAMPLERS: dict[str, Callable[..., Sampler]] = {"rwmh": rwmh}
