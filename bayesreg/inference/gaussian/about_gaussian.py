"""Samplers about a Gaussian, in the coordinates in which it is N(0, I).

Such a sampler defines only a transition in these coordinates. The search for the mode, the start points, the warm-up
and the map back to the estimands are common to all of them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any

import blackjax
import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.inference.deadline import Deadline
from bayesreg.inference.gaussian.delayed_acceptance import with_delayed_acceptance
from bayesreg.inference.gaussian.density import height_and_slope
from bayesreg.inference.gaussian.hyperparameters import move_hyperparameters
from bayesreg.inference.gaussian.laplace import Gaussian, average_gaussian, blank_gaussian, laplace, slope_at
from bayesreg.inference.gaussian.modes import Modes, search_modes
from bayesreg.inference.gaussian.normaliser import make_stand_in
from bayesreg.inference.gaussian.warm_up import FIRST_STEP, Tuning, compile_transition, tune, with_step_size
from bayesreg.inference.gaussian.whitened import (
    Setup,
    Transition,
    setup_about,
    whitened_density,
    whitened_position,
)
from bayesreg.inference.kernel import Draw, Info, OnMode, Sampler
from bayesreg.inference.layout import dimension, flat_position, unravel
from bayesreg.inference.target import (
    Estimands,
    Target,
    estimands_of,
    require_soft_wall,
    without_normaliser,
)
from bayesreg.types import AnyArray, InputError

_log = logging.getLogger(__name__)

# Start points have standard deviations larger than those of Laplace's approximation by this factor.
OVERDISPERSION = 1.5
# The greatest difference, for each unknown, between the log density at the mode and at a start point, if such a point
# is found. For a Gaussian the difference is OVERDISPERSION² / 2. If tetrahedra are squeezed at the mode, wide draws
# turn some of them inside out, and beyond the barrier no step is short enough to bring a chain back.
DEEPEST = 10.0
# The greatest number of attempts for a start point; each attempt is half as far from the mode as the one before.
ATTEMPTS = 10

# The number of independent draws from Laplace's approximation for a first answer.
FIRST_DRAWS = 400

# A Gaussian is averaged over the mode and the points of at most this number of chains, because each costs a curvature.
AVERAGED = 16

# Laplace's approximation keeps several dense matrices with this number of rows, of 1.2 GB each.
MOST_UNKNOWNS = 12_000


@dataclass(frozen=True)
class Walk:
    """A transition in whitened coordinates, as pure functions of (data, setup, …), see `Sampler`.

    Two are equal if their targets are equal and their functions are the same. Code that is compiled for one then serves
    the other.
    """

    target: Target
    transition: Transition
    begin: Callable[[AnyArray, Callable], Any]

    # This function is compiled separately, because the warm-up and the chains begin with the same program.
    @partial(jax.jit, static_argnums=0)
    def init(self, data: Any, setup: Setup, estimands: Estimands) -> Any:
        """Make the state of a chain at estimands."""
        flat = flat_position(self.target, data, estimands)
        return self.begin(setup.gaussian.whiten(flat), whitened_density(self.target, data, setup))

    def step(self, data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Info]:
        """Move a chain by one transition of the kernel in whitened coordinates; return its state and what it cost."""
        state, kernel_info = self.transition(self.target, data, setup, key, state)
        info = Info(
            acceptance_rate=kernel_info.acceptance_rate,
            outside_support=jnp.zeros((), bool),
            solver_failed=jnp.zeros((), bool),
            solver_iterations=jnp.zeros((), int),
            diverging=jnp.asarray(kernel_info.diverging),
            gradients=jnp.asarray(kernel_info.gradients),
            densities=jnp.zeros((), int),
        )
        return state, info

    def step_and_move(self, data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Info]:
        """Move a chain by one transition, and then its hyperparameters."""
        key_step, key_move = jax.random.split(key)
        state, info = self.step(data, setup, key_step, state)
        return self.move_hyperparameters(data, setup, key_move, state), info

    def move_hyperparameters(self, data: Any, setup: Setup, key: AnyArray, state: Any) -> Any:
        """Move hyperparameters with the displacements fixed."""
        return move_hyperparameters(self.target, data, setup, key, state)

    def estimands(self, data: Any, setup: Setup, state: Any) -> dict[str, AnyArray]:
        """Compute the current estimands of a chain."""
        return estimands_of(self.target, data, whitened_position(self.target, setup.gaussian, state.position))

    def observe(self, data: Any, setup: Setup, state: Any) -> Draw:
        """Compute the current estimands of a chain, and evaluate the density at them."""
        estimands = self.estimands(data, setup, state)
        return Draw(estimands, self.target.evaluate_estimands(data, estimands))


def about_gaussian(
    target: Target,
    transition: Transition,
    tuning: Tuning | None = None,
    begin: Callable[[AnyArray, Callable], Any] = blackjax.mcmc.hmc.init,
    mode_search: str = "once",
    exact: bool = True,
) -> Sampler:
    """Make a sampler of the whitened coordinates.

    Parameters
    ----------
    target : Target
    transition : callable
        (target, data, setup, key, state) → (state, Moved).
    tuning : Tuning, optional
        The options of the warm-up that tunes the step size; None if there is no warm-up.
    begin : callable
        (whitened coordinates, log density) → the state that the transition takes, with a field `position`.
    mode_search : str
        "once" searches for one mode from the mean of the start points, "per_chain" for one from each; see `modes`.
    exact : bool

    Raises
    ------
    InputError
        If the target has a hard wall, or more than `MOST_UNKNOWNS` unknowns.
    """
    require_soft_wall(target)
    unknowns = dimension(target)
    if unknowns > MOST_UNKNOWNS:
        raise InputError(
            f"the posterior has {unknowns} unknowns; samplers about the mode keep dense matrices of their square and "
            f"take up to {MOST_UNKNOWNS}: use a coarser mesh (mesh.edge_length), sample fewer nodes "
            "(model.elastic_prior: {kind: boltzmann, nodes: boundary}), or sampler.name: rwmh"
        )

    walk = Walk(target, transition, begin)
    # The first call must be outside of a trace: inside, the target's own arrays would become constants of the program.
    unravel(target)

    def prepare(points: Any, key: AnyArray, deadline: Deadline, on_mode: OnMode) -> tuple[Setup, Any]:
        key_answer, key_start, key_tune = jax.random.fold_in(key, 2), *jax.random.split(key)
        near_mode = None if target.mode_search is None else target.mode_search.search_start
        if exact and near_mode is not None and not deadline.has_passed:
            flat = np.asarray(flat_position(target, target.data, near_mode))
            on_mode(_draw_independently(target, target.data, laplace(target, flat), key_answer))
        modes = search_modes(target, points, mode_search == "per_chain", deadline)
        gaussian = modes.gaussians[0]
        if exact and near_mode is None and not deadline.has_passed:
            on_mode(_draw_independently(target, target.data, gaussian, key_answer))
        starts = _scatter_all(target, modes, jax.random.split(key_start, len(modes.chains)))
        if tuning is None:
            return setup_about(target, gaussian, gaussian.centre), starts
        return _warm_up(walk, tuning, gaussian, starts, key_tune, deadline)

    def compile_warm_up(setup: Setup, points: Any) -> None:
        if tuning is not None:
            compile_transition(surrogate_data(target, setup), walk, setup, points, _half(tuning))

    def blank() -> Setup:
        nothing = jnp.zeros(unknowns)
        return setup_about(target, blank_gaussian(target), nothing)

    data = partial(_condition, target)
    sampler = Sampler(
        prepare, data, blank, walk.init, walk.step, walk.observe, exact, many_solves=True, compile=compile_warm_up
    )
    # The kernel of an approximate sampler sees no density: it needs neither a surrogate nor other moves.
    if not exact:
        return sampler
    if target.surrogate is None:
        return sampler._replace(step=walk.step_and_move)
    return with_delayed_acceptance(target, sampler, walk)


def _warm_up(
    walk: Walk, tuning: Tuning, gaussian: Gaussian, points: Any, key: AnyArray, deadline: Deadline
) -> tuple[Setup, Any]:
    """Warm the chains up; return their setup and their estimands at the end.

    Two stages have the same length, so that they are compiled once. The second stage is whitened at the points that the
    chains reach in the first one. The first stage is whitened by the curvature at the start points, too: the curvature
    at the mode can be so much smaller that no step is short enough for a chain to leave its start. At the deadline, the
    stages that have not begun are left out.
    """
    if deadline.has_passed:
        _log.warning("warm-up: left out, because the time is spent")
        return with_step_size(tuning, setup_about(walk.target, gaussian, gaussian.centre), FIRST_STEP), points
    mode = np.asarray(gaussian.centre)
    target, stage = walk.target, _half(tuning)
    key_settle, key_tune = jax.random.split(key)
    first = _setup_on_average(target, gaussian, mode, points)
    first = first._replace(stand_in=make_stand_in(target, first.gaussian, first.middle))
    data = surrogate_data(target, first)
    settled = tune(data, walk, first, points, key_settle, stage, per_chain=True, deadline=deadline)
    if deadline.has_passed:
        return settled
    points = settled[1]
    # The stand-in is accurate far about both middles.
    second = _setup_on_average(target, settled[0].gaussian, mode, points)._replace(stand_in=first.stand_in)
    return tune(surrogate_data(target, second), walk, second, points, key_tune, stage, deadline=deadline)


def _half(tuning: Tuning) -> Tuning:
    """Return the options of one of two equal stages of a warm-up."""
    return tuning._replace(warm_up=(tuning.warm_up + 1) // 2)


def _condition(target: Target, setup: Setup) -> Any:
    """Prepare the data of the target for chains about the middle."""
    return target.condition(estimands_of(target, target.data, unravel(target)(setup.middle)))


def surrogate_data(target: Target, setup: Setup) -> Any:
    """Prepare the data of the target's surrogate, or its own if it has none, for chains about the middle."""
    data = _condition(target, setup)
    return data if target.surrogate is None else target.surrogate(data)


def _setup_on_average(target: Target, gaussian: Gaussian, mode: AnyArray, points: Any) -> Setup:
    """Make the setup, without a stand-in, about the Gaussian averaged over the mode and the points of the chains.

    The displacements of the points follow the hyperparameters to the mode, as the given Gaussian has it. Points at
    which the density has no finite slope are left out.
    """
    flats = np.asarray(jax.vmap(lambda point: flat_position(target, target.data, point))(points))
    centred = (_at_centre(gaussian, flat) for flat in flats)
    sound = (flat for flat in centred if np.isfinite(flat).all() and np.isfinite(slope_at(target, flat)).all())
    places = [mode, *islice(sound, AVERAGED)]
    return setup_about(target, average_gaussian(target, places), np.mean(places, axis=0))


def _at_centre(gaussian: Gaussian, flat: AnyArray) -> AnyArray:
    """Move the hyperparameters that displacements follow to their values at the centre; the displacements follow."""
    if gaussian.following is None:
        return flat
    return np.asarray(gaussian.place(gaussian.whiten(flat).at[gaussian.following.entries].set(0.0)))


@partial(jax.jit, static_argnums=0)
def _draw_independently(target: Target, data: Any, gaussian: Gaussian, key: AnyArray) -> dict[str, AnyArray]:
    """Draw estimands from a Gaussian, with draws as the leading axis."""
    xi = jax.random.normal(key, (FIRST_DRAWS, len(gaussian.centre)))
    return jax.lax.map(lambda xi: estimands_of(target, data, unravel(target)(gaussian.place(xi))), xi, batch_size=50)


def _scatter_all(target: Target, modes: Modes, keys: AnyArray) -> Any:
    """Draw the estimands at which each chain starts, about the mode of the chain."""
    starts = [_scatter(target, modes.gaussians[mode], key) for mode, key in zip(modes.chains, keys, strict=True)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)


def _scatter(target: Target, gaussian: Gaussian, key: AnyArray) -> Any:
    """Draw estimands from a Gaussian wider than Laplace's; move them nearer to the mode if the density is too low.

    Raises
    ------
    InputError
        If the density is zero or NaN at every point that was tried.
    """
    plain = without_normaliser(target, target.data)
    lowest = height_and_slope(target, plain, np.asarray(gaussian.centre))[0] - DEEPEST * dimension(target)
    direction, best, highest = jax.random.normal(key, gaussian.centre.shape), None, -np.inf
    for attempt in range(ATTEMPTS):
        flat = np.asarray(gaussian.place(OVERDISPERSION / 2**attempt * direction))
        height = np.nan_to_num(height_and_slope(target, plain, flat)[0], nan=-np.inf)
        if height > highest:
            best, highest = flat, height
        if height > lowest:
            break
    if best is None:
        raise InputError("a chain finds no start near the mode: the density is zero all about it")
    return estimands_of(target, target.data, unravel(target)(jnp.asarray(best)))
