"""A Gibbs sampler for posteriors whose displacements can be integrated out, such as those of pairs of points.

The displacements u, the weights τ of the points and all other unknowns θ are drawn in turn: τ given u and θ, then θ
given τ, with u integrated out, and u given both. Random-walk Metropolis moves θ. Without the integration, u and the
scales of its prior would move each other in small steps only. This is a partially collapsed Gibbs sampler (van Dyk and
Park 2008).

What is not Gaussian in u, such as the barrier, is left out of these conditionals. The moves of θ are reversible, and u
is independent of its last value. The proposal of both is therefore reversible with respect to the posterior without
these terms, and Metropolis' rule for them alone makes it exact. Surfaces would seldom pass this test: the few unknowns
that they touch have a trajectory of their own (`_move_with_touched`).
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
from jaxtyping import Float

from bayesreg.inference.deadline import Deadline
from bayesreg.inference.kernel import Draw, Info, OnMode, Sampler
from bayesreg.inference.samplers.settings import Gibbs
from bayesreg.inference.target import Estimands, Target
from bayesreg.types import AnyArray, InputError

# The number of steps of θ in one transition. Some go along one direction of its unit by a random multiple, spread
# evenly on a logarithmic axis, so that also tails and narrow parts of its posterior are visited.
STEPS, NARROWEST, WIDEST = 6, 0.5, 4.0
# The same in each half of a transition with touched unknowns, and the number of turns of their trajectory, each by an
# angle: a quarter of a circle in all leads to a place that is nearly independent.
HALF_STEPS, TURNS, ANGLE = 2, 5, 0.35
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
    """Draw weights and displacements twice, the second time with θ between them, which costs more.

    Where some factors are functions of the touched unknowns v, this happens once, with a trajectory of v.
    """
    walk, densities = partial(_walk, target, marginal, setup), 1 + STEPS
    if not len(marginal.touched_nodes):
        key_first, key_second = jax.random.split(key)
        drawn, first_rate = _sweep(marginal, _stay, key_first, estimands, is_tested)
        drawn, second_rate = _sweep(marginal, walk, key_second, drawn, is_tested)
        rate = (first_rate + second_rate) / 2
    elif is_tested:
        drawn, rate = _move_with_touched(target, marginal, setup, key, estimands)
        densities = 1 + 2 * HALF_STEPS
    else:
        drawn, rate = _sweep(marginal, walk, key, estimands, is_tested)
    nothing, no = jnp.zeros((), int), jnp.zeros((), bool)
    return drawn, Info(rate, no, no, nothing, no, gradients=nothing, densities=jnp.full((), densities))


def _stay(_key: AnyArray, estimands: Estimands, _weights: AnyArray) -> dict[str, AnyArray]:
    return dict(estimands)


def _sweep(
    marginal: Any,
    move: Callable[[AnyArray, Estimands, AnyArray], dict[str, AnyArray]],
    key: AnyArray,
    estimands: Estimands,
    is_tested: bool,
) -> tuple[dict[str, AnyArray], AnyArray]:
    """Draw the weights, move θ, and draw the displacements; return the probability that the other terms accept them."""
    key_weights, key_move, key_draw, key_accept = jax.random.split(key, 4)
    weights, estimands = marginal.draw_weights(key_weights, estimands)
    parameters = move(key_move, estimands, weights)
    proposal = {**parameters, "u_boundary": marginal.draw_displacements(key_draw, parameters, weights)}
    if not is_tested:
        return proposal, jnp.ones(())
    gain = marginal.log_others(proposal) - marginal.log_others(estimands)
    return _accept(key_accept, gain, proposal, dict(estimands))


def _move_with_touched(
    target: Target, marginal: Any, setup: Setup, key: AnyArray, estimands: Estimands
) -> tuple[dict[str, AnyArray], AnyArray]:
    """Draw the weights, move θ and v with the other unknowns integrated out, and draw the displacements given both.

    v = m + L ζ with the mean and the Cholesky factor of its Gaussian, which θ determines. θ moves at a fixed ζ, so that
    v stays where its Gaussian is (Murray and Adams 2010), and ζ moves at a fixed θ. The walks before and after the
    trajectory of ζ make the whole reversible. v has all factors of the posterior but the barrier, and the micrometre by
    which it differs from the displacements: Metropolis' rule for these makes it exact.
    """
    keys = jax.random.split(key, 7)
    weights, present = marginal.draw_weights(keys[0], estimands)
    v = marginal.draw_touched(keys[1], present)
    flat, _, estimands_of = _walked_position(target, marginal, present)

    def log_factors(gaussian: Any, zeta: AnyArray) -> AnyArray:
        """Return the log of the surfaces over that of the Gaussians that stand for them."""
        at = gaussian.mean + gaussian.root @ zeta
        return marginal.log_surfaces(present, at) - marginal.log_approximations(at)

    def touched(flat: AnyArray) -> Any:
        estimands, log_jacobian = estimands_of(flat)
        gaussian = marginal.touched(estimands, weights)
        return gaussian._replace(log=gaussian.log + log_jacobian)

    def walk(key: AnyArray, flat: AnyArray, gaussian: Any, zeta: AnyArray) -> tuple[AnyArray, Any]:
        if not flat.size:
            return flat, gaussian

        def step(now: tuple[AnyArray, Any, AnyArray], key: AnyArray) -> tuple[Any, None]:
            flat, gaussian, factors = now
            key_move, key_accept = jax.random.split(key)
            candidate, balance = _propose(setup, key_move, flat, 0)
            new = touched(candidate)
            new_factors = log_factors(new, zeta)
            gain = new.log + new_factors - gaussian.log - factors + balance
            return _accept(key_accept, gain, (candidate, new, new_factors), now)[0], None

        start = flat, gaussian, log_factors(gaussian, zeta)
        return jax.lax.scan(step, start, jax.random.split(key, HALF_STEPS))[0][:2]

    gaussian = touched(flat)
    zeta = solve_triangular(gaussian.root, v - gaussian.mean, lower=True)
    flat, gaussian = walk(keys[2], flat, gaussian, zeta)
    zeta, rate = _rotate(partial(log_factors, gaussian), keys[3], zeta)
    flat, gaussian = walk(keys[4], flat, gaussian, zeta)
    moved, new_v = estimands_of(flat)[0], gaussian.mean + gaussian.root @ zeta
    proposal = {**moved, "u_boundary": marginal.draw_displacements(keys[5], moved, weights, new_v)}
    gain = marginal.log_others(proposal) - marginal.log_surfaces(present, new_v)
    gain -= marginal.log_others(present) - marginal.log_surfaces(present, v)
    drawn, accepted = _accept(keys[6], gain, proposal, dict(present))
    return drawn, accepted * rate


def _rotate(log_factors: Callable[[AnyArray], AnyArray], key: AnyArray, zeta: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Move ζ, Normal but for some factors, by a Hamiltonian trajectory (Beskos et al. 2011).

    The Normal part alone turns ζ and its momentum around the origin, exactly; the factors change the momentum.
    """
    key_momentum, key_angle, key_accept = jax.random.split(key, 3)
    momentum = jax.random.normal(key_momentum, zeta.shape)
    angle = ANGLE * jax.random.uniform(key_angle, minval=0.7, maxval=1.3)
    value_and_force = jax.value_and_grad(log_factors)

    def turn(now: tuple[AnyArray, ...], _: None) -> tuple[tuple[AnyArray, ...], None]:
        zeta, momentum, _, force = now
        momentum = momentum + angle / 2 * force
        zeta, momentum = (
            jnp.cos(angle) * zeta + jnp.sin(angle) * momentum,
            jnp.cos(angle) * momentum - jnp.sin(angle) * zeta,
        )
        value, force = value_and_force(zeta)
        return (zeta, momentum + angle / 2 * force, value, force), None

    start = (zeta, momentum, *value_and_force(zeta))
    end, _ = jax.lax.scan(turn, start, None, length=TURNS)
    energies = [(x**2).sum() / 2 + (p**2).sum() / 2 - value for x, p, value, _ in (start, end)]
    return _accept(key_accept, energies[0] - energies[1], end[0], zeta)


def _accept(key: AnyArray, gain: AnyArray, proposal: Any, present: Any) -> tuple[Any, AnyArray]:
    """Return one of both by Metropolis' rule, and the probability of the proposal."""
    acceptance = jnp.minimum(1.0, jnp.exp(jnp.nan_to_num(gain, nan=-jnp.inf)))
    is_accepted = jax.random.uniform(key) < acceptance
    return jax.tree.map(partial(jnp.where, is_accepted), proposal, present), acceptance


def _walk(
    target: Target, marginal: Any, setup: Setup, key: AnyArray, estimands: Estimands, weights: AnyArray
) -> dict[str, AnyArray]:
    """Move θ by steps of Metropolis with the displacements integrated out.

    Where some parameters are costly, all but the first step leave them where they are.
    """
    start, costly, estimands_of = _walked_position(target, marginal, estimands)
    if not start.size:
        return dict(estimands)

    def density(flat: AnyArray) -> AnyArray:
        estimands, log_jacobian = estimands_of(flat)
        return marginal.log(estimands, weights) + log_jacobian

    def step(now: tuple[AnyArray, AnyArray], key_and_number: tuple[AnyArray, AnyArray]) -> tuple[Any, None]:
        (flat, height), (key, number) = now, key_and_number
        key_move, key_accept = jax.random.split(key)
        # The first step only evaluates the density at the start, so that the density is compiled once.
        is_first, is_cheap = number == 0, (number > 1) & (0 < costly < len(start))
        candidate, balance = _propose(setup, key_move, flat, jnp.where(is_cheap, costly, 0))
        candidate = jnp.where(is_first, flat, candidate)
        candidate_height = density(candidate)
        gain = jnp.where(is_first, jnp.inf, candidate_height - height + balance)
        return _accept(key_accept, gain, (candidate, candidate_height), now)[0], None

    keys = jax.random.split(key, 1 + STEPS)
    (end, _), _ = jax.lax.scan(step, (start, jnp.zeros(())), (keys, jnp.arange(1 + STEPS)))
    return estimands_of(end)[0]


def _walked_position(
    target: Target, marginal: Any, estimands: Estimands
) -> tuple[AnyArray, int, Callable[[AnyArray], tuple[dict[str, AnyArray], AnyArray]]]:
    """Return the position of θ, costly parameters first, their number, and its map to estimands and the Jacobian."""
    position = target.coordinates.unconstrain(marginal.problem, estimands)
    names, costly = _walked(marginal, position)
    others = {name: value for name, value in position.items() if name not in names}
    flat, unravel = ravel_pytree([position[name] for name in names])

    def estimands_of(flat: AnyArray) -> tuple[dict[str, AnyArray], AnyArray]:
        walked = dict(zip(names, unravel(flat), strict=True))
        return target.coordinates.constrain(marginal.problem, {**others, **walked})

    return flat, sum(position[name].size for name in costly), estimands_of


def _propose(setup: Setup, key: AnyArray, flat: AnyArray, first: AnyArray | int) -> tuple[AnyArray, AnyArray]:
    """Propose another θ; return it and the log of the backward over the forward density of the proposal.

    The unit of a step is triangular: directions from `first` on, if it is above zero, leave the parameters before it
    alone.
    """
    key_kind, key_width, key_which, key_move = jax.random.split(key, 4)
    is_independent = jax.random.bernoulli(key_kind, INDEPENDENT) & (first == 0)
    width = NARROWEST * (WIDEST / NARROWEST) ** jax.random.uniform(key_width)
    move = jax.random.t(key_move, FREEDOM, flat.shape)
    along = setup.unit @ (move * jax.nn.one_hot(jax.random.randint(key_which, (), first, len(flat)), len(flat)))
    candidate = jnp.where(is_independent, setup.centre + setup.unit @ move, flat + width * along)
    return candidate, jnp.where(is_independent, _log_tail(setup, flat) - _log_tail(setup, candidate), 0.0)


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
