"""The paper's kernel: random-walk Metropolis in the constrained space of the estimands."""

from __future__ import annotations

from typing import Any, NamedTuple

import blackjax
import jax
import jax.numpy as jnp

from bayesreg.inference.kernel import Draw, Info, Sampler
from bayesreg.inference.samplers.settings import RandomWalk
from bayesreg.inference.target import Estimands, Target
from bayesreg.types import AnyArray, InputError


class State(NamedTuple):
    """The state of a chain: BlackJAX's state, and the evaluation of the density at its position."""

    kernel: Any
    evaluation: Any


def rwmh(target: Target, settings: RandomWalk) -> Sampler:
    """Make a random-walk Metropolis sampler with the paper's three Normal kernels (eqs. 13 and 14).

    One proposal changes all estimands.

    Raises
    ------
    InputError
        If a temperature is sampled: the paper has no step for it.
    """
    sigma = {"u_boundary": settings.sigma_u, "lam": settings.sigma_lam, "mu": settings.sigma_mu}
    warm = [name for name in target.coordinates.reference() if name not in sigma]
    if warm:
        raise InputError(
            f"rwmh has no step for {', '.join(sorted(warm))}; use the sampler hmc, or model.preset: paper with known "
            "temperatures"
        )

    def init(data: Any, _: Any, estimands: Estimands) -> State:
        evaluation = target.evaluate_estimands(data, estimands)
        kernel = blackjax.additive_step_random_walk(lambda _: evaluation.logdensity, lambda *_: estimands)
        return State(kernel.init(estimands), evaluation)

    def proposed(data: Any, key: AnyArray, position: Estimands) -> tuple[Estimands, Estimands, AnyArray]:
        """Draw a move; return it, the proposal, and whether the proposal lies in the support."""
        move = _normal_step(key, position, sigma)
        proposal = jax.tree.map(jnp.add, position, move)
        return move, proposal, target.supports(data, proposal)

    def outside(data: Any, _: Any, key: AnyArray, state: State) -> AnyArray:
        return ~proposed(data, jax.random.split(key)[0], state.kernel.position)[-1]

    def step(data: Any, _: Any, key: AnyArray, state: State) -> tuple[State, Info]:
        # The proposal is drawn and evaluated here, once, because BlackJAX does not return its energies and its solve.
        # BlackJAX takes both and accepts or rejects.
        key_proposal, key_accept = jax.random.split(key)
        position, current = state.kernel.position, state.evaluation
        move, proposal, inside = proposed(data, key_proposal, position)
        # A proposal outside the support needs no solve. The current position is evaluated in its place; with its own u
        # as the guess that takes no iteration.
        feasible = jax.tree.map(lambda new, old: jnp.where(inside, new, old), proposal, position)
        evaluation = target.evaluate_estimands(data, feasible, guess=current.u)
        logdensity = jnp.where(inside, evaluation.logdensity, -jnp.inf)
        kernel = blackjax.additive_step_random_walk(lambda _: logdensity, lambda *_: move)
        kernel_state, kernel_info = kernel.step(key_accept, state.kernel)
        next_evaluation = jax.tree.map(
            lambda new, old: jnp.where(kernel_info.is_accepted, new, old), evaluation, state.evaluation
        )
        info = Info(
            acceptance_rate=kernel_info.acceptance_rate,
            outside_support=~inside,
            solver_failed=inside & evaluation.solver_failed,
            solver_iterations=evaluation.solver_iterations,
            diverging=jnp.zeros((), bool),
            gradients=jnp.zeros((), int),
            densities=inside.astype(int),
        )
        return State(kernel_state, next_evaluation), info

    return Sampler(
        # The setup is the mean of the start points: the data are prepared for their neighbourhood.
        prepare=lambda points, _key, _deadline, _on_mode: (jax.tree.map(lambda x: x.mean(axis=0), points), points),
        data=lambda start: target.condition(start),
        blank=lambda: target.coordinates.reference(),
        init=init,
        step=step,
        observe=lambda _data, _setup, state: Draw(state.kernel.position, state.evaluation),
        exact=True,
        outside=outside,
    )


def _normal_step(key: AnyArray, position: Estimands, sigma: dict[str, float]) -> dict[str, AnyArray]:
    keys = jax.random.split(key, len(sigma))
    draws = {name: subkey for name, subkey in zip(sigma, keys, strict=True) if name in position}
    return {name: sigma[name] * jax.random.normal(subkey, position[name].shape) for name, subkey in draws.items()}
