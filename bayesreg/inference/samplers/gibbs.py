"""A Gibbs sampler for posteriors whose displacements can be integrated out, such as those of pairs of points.

The displacements u, the weights τ of the points and all other unknowns θ are drawn in turn: τ given u and θ, then θ
given τ, with u integrated out, and u given both. Random-walk Metropolis moves θ. Without the integration, u and the
scales of its prior would move each other in small steps only. This is a partially collapsed Gibbs sampler (van Dyk and
Park 2008).

What is not Gaussian in u, such as the barrier, is left out of these conditionals. The moves of θ are reversible, and u
is independent of its last value. The proposal of both is therefore reversible with respect to the posterior without
these terms, and Metropolis' rule for them alone makes it exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import logsumexp
from jaxtyping import Float

from bayesreg.inference.deadline import Deadline
from bayesreg.inference.kernel import Draw, Info, OnMode, Sampler
from bayesreg.inference.samplers.settings import Gibbs
from bayesreg.inference.target import Estimands, Target
from bayesreg.types import AnyArray, InputError

# The number of steps of θ in one transition. Some go along one direction of its unit by a random multiple, spread
# evenly on a logarithmic axis, so that also tails and narrow parts of its posterior are visited.
STEPS, NARROWEST, WIDEST = 6, 0.5, 4.0
# The share of the other steps, which propose θ independently of where it is, and the degrees of freedom of Student's t,
# from which every component of both kinds is drawn.
INDEPENDENT, FREEDOM = 0.6, 5.0
# The shares of the warm-up after each of which the steps are tuned anew.
STAGES = 0.2, 0.3, 0.5
# The unit in which each parameter begins, in logarithms and Normal scores.
FIRST_UNIT = 0.3
# The least variance of θ, in logarithms and Normal scores, for the unit of its steps.
LEAST_VARIANCE = 1e-4


class Setup(NamedTuple):
    """The mean of θ in the warm-up, and a Cholesky factor of its covariance, the unit of a step."""

    centre: Float[AnyArray, "parameters"]
    unit: Float[AnyArray, "parameters parameters"]


def gibbs(target: Target, settings: Gibbs) -> Sampler:
    """Make a Gibbs sampler.

    Raises
    ------
    InputError
        If the displacements of the target cannot be integrated out.
    """
    prepare_marginal = target.prepare_marginal
    if prepare_marginal is None:
        raise InputError(
            "gibbs samples points and surfaces alone, with random loads, a λ and a μ for each tissue, and at most some "
            "hundred points; use the sampler hmc"
        )

    def prepare(points: Any, key: AnyArray, deadline: Deadline, _on_mode: OnMode) -> tuple[Setup, Any]:
        return _warm_up(target, settings.warm_up, points, key, deadline)

    return Sampler(
        prepare=prepare,
        data=lambda _setup: prepare_marginal(),
        blank=partial(_first_setup, target),
        init=lambda _marginal, _setup, estimands: dict(estimands),
        step=partial(_step, target, is_tested=True),
        observe=lambda marginal, _setup, estimands: Draw(
            estimands, target.evaluate_estimands(marginal.problem, estimands)
        ),
        exact=True,
    )


def _step(
    target: Target, marginal: Any, setup: Setup, key: AnyArray, estimands: Estimands, is_tested: bool
) -> tuple[dict[str, AnyArray], Info]:
    """Draw weights and displacements twice, the second time with θ between them, which costs more."""
    key_first, key_second = jax.random.split(key)
    drawn, first_rate = _sweep(marginal, _stay, key_first, estimands, is_tested)
    drawn, second_rate = _sweep(marginal, partial(_walk, target, marginal, setup), key_second, drawn, is_tested)
    rate = (first_rate + second_rate) / 2
    nothing, no = jnp.zeros((), int), jnp.zeros((), bool)
    return drawn, Info(rate, no, no, nothing, no, gradients=nothing, densities=jnp.full((), 1 + STEPS))


def _stay(_key: AnyArray, estimands: Estimands, _weights: AnyArray) -> dict[str, AnyArray]:
    return dict(estimands)


def _sweep(
    marginal: Any,
    move: Callable[[AnyArray, Estimands, AnyArray], dict[str, AnyArray]],
    key: AnyArray,
    estimands: Estimands,
    is_tested: bool,
) -> tuple[dict[str, AnyArray], AnyArray]:
    """Draw the weights, move θ, and draw the displacements; return the probability that the other terms accept them.

    Several displacements are tried at once (Liu, Liang and Wong 2000): one of those drawn at the new θ is chosen in
    proportion to the factors of the other terms, and accepted by the ratio of the sum of their factors to that of the
    present displacement and of others drawn at the present θ. With one try it is Metropolis' rule.
    """
    key_weights, key_move, key_new, key_old, key_choice, key_accept = jax.random.split(key, 6)
    weights, estimands = marginal.draw_weights(key_weights, estimands)
    parameters, tries = move(key_move, estimands, weights), marginal.tries
    candidates = marginal.draw_displacements(key_new, parameters, weights, tries)
    if not is_tested:
        return {**parameters, "u_boundary": candidates[0]}, jnp.ones(())

    def logs(parameters: Estimands, displacements: AnyArray) -> AnyArray:
        log_others = jax.vmap(lambda u: marginal.log_others({**parameters, "u_boundary": u}))(displacements)
        return jnp.nan_to_num(log_others, nan=-jnp.inf)

    present = estimands["u_boundary"][None]
    if tries > 1:
        others = marginal.draw_displacements(key_old, estimands, weights, tries - 1)
        present = jnp.concatenate([present, others])
    candidate_logs = logs(parameters, candidates)
    chosen = jax.random.categorical(key_choice, candidate_logs)
    acceptance = jnp.minimum(1.0, jnp.exp(logsumexp(candidate_logs) - logsumexp(logs(estimands, present))))
    is_accepted = jax.random.uniform(key_accept) < acceptance
    proposal = {**parameters, "u_boundary": candidates[chosen]}
    return jax.tree.map(partial(jnp.where, is_accepted), proposal, dict(estimands)), acceptance


def _walk(
    target: Target, marginal: Any, setup: Setup, key: AnyArray, estimands: Estimands, weights: AnyArray
) -> dict[str, AnyArray]:
    """Move θ by steps of Metropolis with the displacements integrated out.

    Where some parameters are costly, all but the first step leave them where they are.
    """
    position = target.coordinates.unconstrain(marginal.problem, estimands)
    names, costly = _walked(marginal, position)
    others = {name: value for name, value in position.items() if name not in names}
    start, unravel = ravel_pytree([position[name] for name in names])
    if not start.size:
        return dict(estimands)
    # The unit of a step is triangular: directions from here on leave the costly parameters alone.
    first_cheap = sum(position[name].size for name in costly)

    def estimands_of(flat: AnyArray) -> tuple[dict[str, AnyArray], AnyArray]:
        walked = dict(zip(names, unravel(flat), strict=True))
        return target.coordinates.constrain(marginal.problem, {**others, **walked})

    def density(flat: AnyArray) -> AnyArray:
        estimands, log_jacobian = estimands_of(flat)
        return marginal.log(estimands, weights) + log_jacobian

    def step(now: tuple[AnyArray, AnyArray], key_and_number: tuple[AnyArray, AnyArray]) -> tuple[Any, None]:
        (flat, height), (key, number) = now, key_and_number
        key_kind, key_width, key_which, key_move, key_accept = jax.random.split(key, 5)
        # The first step only evaluates the density at the start, so that the density is compiled once.
        is_first, is_cheap = number == 0, (number > 1) & (0 < first_cheap < len(start))
        is_independent = jax.random.bernoulli(key_kind, INDEPENDENT) & ~is_cheap
        width = NARROWEST * (WIDEST / NARROWEST) ** jax.random.uniform(key_width)
        move = jax.random.t(key_move, FREEDOM, start.shape)
        which = jax.random.randint(key_which, (), jnp.where(is_cheap, first_cheap, 0), len(start))
        along = setup.unit @ (move * jax.nn.one_hot(which, len(start)))
        candidate = jnp.where(is_independent, setup.centre + setup.unit @ move, flat + width * along)
        candidate = jnp.where(is_first, flat, candidate)
        candidate_height = density(candidate)
        balance = jnp.where(is_independent, _log_tail(setup, flat) - _log_tail(setup, candidate), 0.0)
        gain = candidate_height - height + balance
        is_accepted = is_first | (jnp.log(jax.random.uniform(key_accept)) < gain)
        return jax.tree.map(partial(jnp.where, is_accepted), (candidate, candidate_height), now), None

    keys = jax.random.split(key, 1 + STEPS)
    (end, _), _ = jax.lax.scan(step, (start, jnp.zeros(())), (keys, jnp.arange(1 + STEPS)))
    return estimands_of(end)[0]


def _log_tail(setup: Setup, flat: AnyArray) -> AnyArray:
    """Compute the log density of the independent proposal, up to a constant."""
    squares = solve_triangular(setup.unit, flat - setup.centre, lower=True) ** 2
    return -(FREEDOM + 1) / 2 * jnp.log1p(squares / FREEDOM).sum()


def _warm_up(target: Target, length: int, points: Any, key: AnyArray, deadline: Deadline) -> tuple[Setup, Any]:
    """Move the chains away from their start, and tune the steps of θ by the places that they visit."""
    assert target.prepare_marginal is not None
    marginal = target.prepare_marginal()
    states, setup = points, _first_setup(target)
    for number, share in enumerate(STAGES):
        places = []
        for key_draw in jax.random.split(jax.random.fold_in(key, number), math.ceil(share * length)):
            if deadline.has_passed:
                return setup, states
            states, flats = _transition(target, marginal, setup, key_draw, states)
            places.append(np.asarray(flats))
        late = np.concatenate(places[len(places) // 4 :])
        covariance = np.cov(late, rowvar=False).reshape(late.shape[1:] * 2) + LEAST_VARIANCE * np.eye(late.shape[1])
        setup = Setup(jnp.asarray(late.mean(axis=0)), jnp.asarray(np.linalg.cholesky(covariance)))
    return setup, states


# One transition is one call, so that a signal and the deadline are noticed between two of them.
@partial(jax.jit, static_argnums=0)
def _transition(
    target: Target, marginal: Any, setup: Setup, key: AnyArray, states: Estimands
) -> tuple[dict[str, AnyArray], Float[AnyArray, "chains parameters"]]:
    """Move every chain, out of places that the other terms forbid, too; return its state and θ."""
    keys = jax.random.split(key, len(states["u_boundary"]))
    states, _ = jax.vmap(partial(_step, target, marginal, setup, is_tested=False))(keys, states)
    return states, jax.vmap(partial(_flat_parameters, target, marginal))(states)


def _first_setup(target: Target) -> Setup:
    assert target.prepare_marginal is not None
    centre = _flat_parameters(target, target.prepare_marginal(), target.coordinates.reference())
    return Setup(centre, FIRST_UNIT * jnp.eye(len(centre)))


def _flat_parameters(target: Target, marginal: Any, estimands: Estimands) -> AnyArray:
    """Return the position of θ."""
    position = target.coordinates.unconstrain(marginal.problem, estimands)
    return ravel_pytree([position[name] for name in _walked(marginal, position)[0]])[0]


def _walked(marginal: Any, position: Estimands) -> tuple[list[str], list[str]]:
    """Return the names of θ, the costly parameters first, and those of the latter."""
    names = sorted(name for name in position if name != "u_boundary" and name not in marginal.drawn)
    costly = [name for name in names if name in marginal.costly]
    return costly + [name for name in names if name not in costly], costly
