"""BlackJAX samplers behind one small adapter, and their registry.

A sampler here is a handful of pure functions. `State` holds what the next step needs, `Info` what a person wants to
know. The paper's kernel moves in the constrained space of the estimands; the others in the coordinates in which
Laplace's approximation is N(0, I), with trajectories that the skull reflects (`bayesreg.inference.reflection`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
from blackjax.adaptation.step_size import dual_averaging_adaptation
from jax.flatten_util import ravel_pytree

from bayesreg.inference.laplace import Reference, find_mode, laplace, unravel
from bayesreg.inference.reflection import Walls, reflective_rotation, rotated, walls
from bayesreg.inference.target import Estimands, SmoothTarget, Target
from bayesreg.types import AnyArray, InputError, Scalar

Say = Callable[[str], None]

# Chains start that much wider than Laplace's approximation.
OVERDISPERSION = 1.5

# The tuning of the step starts here, and is drawn to ten times as much.
FIRST_STEP = 0.05


class State(NamedTuple):
    """One chain of the paper's kernel: BlackJAX's state, and the evaluation of the density at its position."""

    kernel: Any
    evaluation: Any


class Info(NamedTuple):
    """One transition: what the proposal met, and the probability with which it was accepted."""

    acceptance_rate: AnyArray
    outside_support: AnyArray
    solver_failed: AnyArray
    solver_iterations: AnyArray
    diverging: AnyArray
    gradients: AnyArray


class Draw(NamedTuple):
    """Where a chain stands: estimands, and the `Evaluation` there."""

    estimands: dict[str, AnyArray]
    evaluation: Any


class Sampler(NamedTuple):
    """A transition kernel.

    Attributes
    ----------
    prepare : callable
        (points, key, say) → (setup, points): start points (chains as the leading axis) to what the kernel needs
        besides the data, a pytree that is found once, and the points from which chains then start.
    data : callable
        (setup) → the target's data as the functions below take them.
    blank : callable
        () → a setup of the same structure, for reading one back.
    init : callable
        (data, setup, estimands) → state.
    step : callable
        (data, setup, key, state) → (state, Info).
    observe : callable
        (data, setup, state) → Draw.
    exact : bool
        Whether the posterior is its stationary distribution.
    """

    prepare: Callable[[Any, AnyArray, Say], tuple[Any, Any]]
    data: Callable[[Any], Any]
    blank: Callable[[], Any]
    init: Callable[[Any, Any, Estimands], Any]
    step: Callable[[Any, Any, AnyArray, Any], tuple[Any, Info]]
    observe: Callable[[Any, Any, Any], Draw]
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
        If a standard deviation is not positive, or a temperature is to be sampled: the paper has no step for it.
    """
    sigma = {"u_boundary": sigma_u, "lam": sigma_lam, "mu": sigma_mu}
    for name, value in sigma.items():
        if not value > 0:
            raise InputError(f"the step of {name} must be positive, got {value}")
    warm = [name for name in target.estimands(target.reference()) if name not in sigma]
    if warm:
        raise InputError(f"rwmh has no step for {', '.join(warm)}; use the sampler hmc where a temperature has a prior")

    def init(data: Any, _: None, estimands: Estimands) -> State:
        evaluation = target.evaluate_estimands(data, estimands)
        kernel = blackjax.additive_step_random_walk(lambda _: evaluation.logdensity, lambda *_: estimands)
        return State(kernel.init(estimands), evaluation)

    def step(data: Any, _: None, key: AnyArray, state: State) -> tuple[State, Info]:
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
            gradients=jnp.zeros((), int),
        )
        return State(kernel_state, kept), info

    return Sampler(
        prepare=lambda points, _key, _say: (None, points),
        data=lambda _: target.data,
        blank=lambda: None,
        init=init,
        step=step,
        observe=lambda _data, _setup, state: Draw(state.kernel.position, state.evaluation),
        exact=True,
    )


def _normal_step(key: AnyArray, position: Estimands, sigma: dict[str, float]) -> dict[str, AnyArray]:
    keys = jax.random.split(key, len(sigma))
    draws = {name: subkey for name, subkey in zip(sigma, keys, strict=True) if name in position}
    return {name: sigma[name] * jax.random.normal(subkey, position[name].shape) for name, subkey in draws.items()}


class Setup(NamedTuple):
    """What the samplers about a Gaussian reference find once (a pytree).

    Attributes
    ----------
    reference : Reference
    walls : Walls
        Of every sampled node.
    step_size : scalar
        In whitened coordinates; π/2 is a quarter turn of the reference's motion.
    steps : scalar integer
        Steps of a trajectory of fixed length.
    """

    reference: Reference
    walls: Walls
    step_size: Scalar
    steps: AnyArray


def hmc(target: SmoothTarget, warm_up: int = 60, target_acceptance: float = 0.75) -> Sampler:
    """Hamiltonian Monte Carlo: a quarter turn about the Gaussian reference, in as many steps as acceptance asks for.

    Parameters
    ----------
    target : SmoothTarget
    warm_up : int
        Transitions in which the step size is tuned and that are not kept.
    target_acceptance : float
        Between 0 and 1.
    """

    def transition(data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Any]:
        key_step, key_move = jax.random.split(key)
        # Trajectories of one length may be periodic.
        size = setup.step_size * jax.random.uniform(key_step, minval=0.8, maxval=1.2)
        kernel = blackjax.mcmc.hmc.build_kernel(integrator=_integrator(target, data, setup))
        density = _whitened_density(target, data, setup.reference)
        unit = jnp.ones_like(state.position)
        return kernel(key_move, state, density, size, unit, setup.steps)

    return _about_reference(target, transition, warm_up, target_acceptance)


def nuts(target: SmoothTarget, warm_up: int = 60, target_acceptance: float = 0.8) -> Sampler:
    """The No-U-Turn sampler about the Gaussian reference; its settings are those of `hmc`."""

    def transition(data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Any]:
        kernel = blackjax.mcmc.nuts.build_kernel(integrator=_integrator(target, data, setup))
        density = _whitened_density(target, data, setup.reference)
        return kernel(key, state, density, setup.step_size, jnp.ones_like(state.position), max_num_doublings=6)

    return _about_reference(target, transition, warm_up, target_acceptance)


def laplace_sampler(target: SmoothTarget) -> Sampler:
    """Independent draws from Laplace's approximation, cut off by the skull: a quick look, not the posterior."""

    def transition(data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Any]:
        momentum = jax.random.normal(key, state.position.shape)
        position, _ = rotated(setup.walls, _clearance(target, data, setup), state.position, momentum, jnp.pi / 2)
        # A turn that was not over in time is refused, as everywhere.
        done = jnp.isfinite(position).all()
        moved = state._replace(position=jnp.where(done, position, state.position))
        return moved, _HamiltonianInfo(done.astype(float), ~done, jnp.zeros((), int))

    return _about_reference(target, transition, 0, 1.0)._replace(exact=False)


class _HamiltonianInfo(NamedTuple):
    acceptance_rate: AnyArray
    is_divergent: AnyArray
    num_integration_steps: AnyArray


def _about_reference(target: SmoothTarget, transition: Callable, warm_up: int, acceptance: float) -> Sampler:
    """A sampler of the whitened coordinates from its transition."""
    if not 0 < acceptance <= 1:
        raise InputError(f"target_acceptance must lie between 0 and 1, got {acceptance}")

    def init(data: Any, setup: Setup, estimands: Estimands) -> Any:
        flat = ravel_pytree(target.unconstrain_of(data, estimands))[0]
        xi = jax.scipy.linalg.solve_triangular(setup.reference.factor, flat - setup.reference.centre, lower=False)
        return blackjax.mcmc.hmc.init(xi, _whitened_density(target, data, setup.reference))

    def step(data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Info]:
        state, info = transition(data, setup, key, state)
        no = jnp.zeros((), bool)
        steps = jnp.asarray(info.num_integration_steps)
        return state, Info(info.acceptance_rate, no, no, jnp.zeros((), int), info.is_divergent, steps)

    def observe(data: Any, setup: Setup, state: Any) -> Draw:
        estimands = target.constrain_of(data, _whitened_position(target, setup.reference, state.position))
        return Draw(estimands, target.evaluate_estimands(data, estimands))

    def prepare(points: Any, key: AnyArray, say: Say) -> tuple[Setup, Any]:
        middle = jax.tree.map(lambda x: jnp.asarray(x).mean(axis=0), points)
        mode = find_mode(target, np.asarray(ravel_pytree(target.unconstrain_of(target.data, middle))[0]), say)
        reference = laplace(target, mode)
        setup = Setup(reference, _walls(target, reference), jnp.asarray(FIRST_STEP), jnp.asarray(1))
        chains = len(next(iter(points.values())))
        key_start, key_tune = jax.random.split(key)
        starts = _overdispersed(target, target.data, setup, jax.random.split(key_start, chains))
        if not warm_up:
            return setup, starts
        return _tuned(target, conditioned(setup), init, step, setup, starts, key_tune, warm_up, acceptance, say)

    def conditioned(setup: Setup) -> Any:
        return target.conditioned(target.constrain_of(target.data, unravel(target)(setup.reference.centre)))

    def blank() -> Setup:
        flat = ravel_pytree(target.unconstrain(target.reference()))[0]
        d = len(flat)
        reference = Reference(jnp.zeros(d), jnp.zeros((d, d)))
        return Setup(reference, _walls(target, reference), jnp.zeros(()), jnp.zeros((), int))

    return Sampler(prepare, conditioned, blank, init, step, observe, exact=True)


def _tuned(
    target: SmoothTarget,
    data: Any,
    init: Callable,
    step: Callable,
    setup: Setup,
    starts: Any,
    key: AnyArray,
    warm_up: int,
    acceptance: float,
    say: Say,
) -> tuple[Setup, Any]:
    """The step size that meets an acceptance averaged over chains (dual averaging), and where the chains then are."""
    begin, update, final = dual_averaging_adaptation(acceptance)

    def sized(size: Scalar) -> Setup:
        # Beyond a quarter turn there is nothing to gain.
        size = jnp.clip(size, 0.01, jnp.pi / 2)
        steps = jnp.maximum(jnp.round(jnp.pi / 2 / size), 1).astype(int)
        return setup._replace(step_size=size, steps=steps)

    @jax.jit
    def run(data: Any, setup: Setup, starts: Any, key: AnyArray) -> Any:
        states = jax.vmap(partial(init, data, setup))(starts)

        def one(carry: Any, key: AnyArray) -> Any:
            states, tuning = carry
            keys = jax.random.split(key, len(states.logdensity))
            states, info = jax.vmap(partial(step, data, sized(jnp.exp(tuning.log_step_size))))(keys, states)
            rate = jnp.nan_to_num(info.acceptance_rate).mean()
            return (states, update(tuning, rate)), rate

        (states, tuning), rates = jax.lax.scan(one, (states, begin(setup.step_size)), jax.random.split(key, warm_up))
        return (
            jax.vmap(lambda s: target.constrain_of(data, _whitened_position(target, setup.reference, s.position)))(
                states
            ),
            final(tuning),
            rates,
        )

    points, size, rates = run(data, setup, starts, key)
    tuned = sized(size)
    late = float(rates[warm_up // 2 :].mean())
    say(f"warm-up: step {float(tuned.step_size):.2f}, {int(tuned.steps)} steps a trajectory, acceptance {late:.0%}")
    return tuned, points


def _overdispersed(target: SmoothTarget, data: Any, setup: Setup, keys: AnyArray) -> Any:
    """A quarter turn from the mode with too much momentum: a draw of a wider Gaussian, reflected into the support.

    Raises
    ------
    InputError
        If a chain finds no place in the support.
    """

    @jax.jit
    def start(data: Any, setup: Setup, key: AnyArray, width: AnyArray) -> Any:
        d = len(setup.reference.centre)
        momentum = width * jax.random.normal(key, (d,))
        xi, _ = rotated(setup.walls, _clearance(target, data, setup), jnp.zeros(d), momentum, jnp.pi / 2)
        return target.constrain_of(data, _whitened_position(target, setup.reference, xi)), jnp.isfinite(xi).all()

    width = np.full(len(keys), OVERDISPERSION)
    for _ in range(10):
        points, done = jax.vmap(partial(start, data, setup))(keys, jnp.asarray(width))
        if done.all():
            return points
        # A flight that is caught in a corner of the skull does not end; a shorter one may.
        width = np.where(done, width, width / 2)
    raise InputError(f"{int((~done).sum())} of {len(keys)} chains find no start near the mode outside the skull")


def _walls(target: SmoothTarget, reference: Reference) -> Walls:
    nodes = len(target.sampled)
    centre = reference.centre[-3 * nodes :].reshape(nodes, 3)
    rows = reference.factor[-3 * nodes :].reshape(nodes, 3, -1)
    return walls(centre, rows, jnp.arange(nodes))


def _integrator(target: SmoothTarget, data: Any, setup: Setup) -> Callable:
    return reflective_rotation(setup.walls, _clearance(target, data, setup))


def _clearance(target: SmoothTarget, data: Any, setup: Setup) -> Callable[[AnyArray], AnyArray]:
    return lambda u: target.clearance(data, u, setup.walls.nodes)


def _whitened_position(target: SmoothTarget, reference: Reference, xi: AnyArray) -> dict[str, AnyArray]:
    return unravel(target)(reference.centre + reference.factor @ xi)


def _whitened_density(target: SmoothTarget, data: Any, reference: Reference) -> Callable[[AnyArray], AnyArray]:
    return lambda xi: target.logdensity_of(data, _whitened_position(target, reference, xi))


SAMPLERS: dict[str, Callable[..., Sampler]] = {"rwmh": rwmh, "hmc": hmc, "nuts": nuts, "laplace": laplace_sampler}
