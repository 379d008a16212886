"""Samplers about a Gaussian, in the coordinates in which it is N(0, I).

A transition there is all that such a sampler needs to bring; the search for the mode, the starts, the warm-up and the
way back to the estimands are the same for all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any

import blackjax
import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.inference.gaussian.density import height_and_slope, log_normaliser_at
from bayesreg.inference.gaussian.laplace import Gaussian, average_gaussian, recentre, slope_at
from bayesreg.inference.gaussian.loose import find_slowest, move_alone, place_loose_nodes, search_places
from bayesreg.inference.gaussian.modes import search_modes
from bayesreg.inference.gaussian.normaliser import Delayed, delay_acceptance, make_stand_in
from bayesreg.inference.gaussian.reflection import rotate
from bayesreg.inference.gaussian.warm_up import Tuning, tune
from bayesreg.inference.gaussian.whitened import (
    Density,
    Setup,
    Transition,
    clearance_of,
    setup_about,
    stand_in_at,
    whiten,
    whitened_density,
    whitened_position,
)
from bayesreg.inference.kernel import Draw, Info, Sampler, Say
from bayesreg.inference.layout import dimension, displacements, flat_position, node_count, unravel
from bayesreg.inference.target import (
    Estimands,
    Target,
    estimands_of,
    has_costly_normaliser,
    without_normaliser,
)
from bayesreg.types import AnyArray, InputError

# Chains start that much wider than Laplace's approximation.
OVERDISPERSION = 1.5
# But, where it can, no chain starts where the log density is less than at the mode by more than this for each unknown;
# of a Gaussian it is half the square of the above. Where tetrahedra are squeezed at the mode, wide draws turn some
# inside out, and behind the barrier no step is short enough to lead out.
DEEPEST = 10.0

# A Gaussian is averaged over the mode and the places of so many chains at most: each costs a curvature.
AVERAGED = 16

# Laplace's approximation and the reflections keep eight dense matrices of the square of this: 9 GB.
MOST_UNKNOWNS = 12_000


@dataclass(frozen=True)
class Walk:
    """Chains of whitened coordinates by a transition, as pure functions of (data, setup, …), see `Sampler`.

    Two are equal if their targets are and their functions are the same: what is compiled for one serves the other.
    """

    target: Target
    transition: Transition
    begin: Callable[[AnyArray, Callable], Any]
    density: Density

    # Compiled by itself: the warm-up and the chains begin with the same program.
    @partial(jax.jit, static_argnums=0)
    def init(self, data: Any, setup: Setup, estimands: Estimands) -> Any:
        """The state of a chain there."""
        flat = flat_position(self.target, data, estimands)
        return self.begin(whiten(setup.gaussian, flat), self.density(self.target, data, setup))

    def step(self, data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Info]:
        """The state after a transition."""
        state, moved = self.transition(self.target, data, setup, key, state)
        info = Info(
            acceptance_rate=moved.acceptance_rate,
            outside_support=jnp.asarray(moved.outside_support),
            solver_failed=jnp.zeros((), bool),
            solver_iterations=jnp.zeros((), int),
            diverging=jnp.asarray(moved.diverging),
            gradients=jnp.asarray(moved.gradients),
            densities=jnp.asarray(moved.densities),
        )
        return state, info

    def estimands(self, data: Any, setup: Setup, state: Any) -> dict[str, AnyArray]:
        """Where a chain is."""
        return estimands_of(self.target, data, whitened_position(self.target, setup.gaussian, state.position))

    def observe(self, data: Any, setup: Setup, state: Any) -> Draw:
        """Where a chain is, and the evaluation of the density there."""
        estimands = self.estimands(data, setup, state)
        return Draw(estimands, self.target.evaluate_estimands(data, estimands))


def about_gaussian(
    target: Target,
    transition: Transition,
    tuning: Tuning | None = None,
    begin: Callable[[AnyArray, Callable], Any] = blackjax.mcmc.hmc.init,
    density: Density = whitened_density,
    mode_search: str = "once",
    exact: bool = True,
    alone: int = 0,
) -> Sampler:
    """A sampler of the whitened coordinates.

    Parameters
    ----------
    target : Target
    transition : callable
        (target, data, setup, key, state) → (state, Moved).
    tuning : Tuning, optional
        How the step size is tuned; without it there is no warm-up.
    begin : callable
        (position, log density) → the state that the transition takes, with a field `position`, and with
        `logdensity` where nodes are moved alone.
    density : callable
        (target, data, setup) → the log density of a whitened position that `begin` is given.
    mode_search : str
        "once": one mode, from the mean of the start points; "per_chain": one from each, see `modes`.
    exact : bool
    alone : int
        Number of nodes, those that were the slowest in the warm-up, that are moved each alone after a transition. Their
        moves are tested with `density`, which must then be the target's own.

    Raises
    ------
    InputError
        If the target has more than `MOST_UNKNOWNS` unknowns.
    """
    alone = 0 if target.single_nodes is None else min(alone, node_count(target))
    unknowns = dimension(target)
    if unknowns > MOST_UNKNOWNS:
        raise InputError(
            f"the posterior has {unknowns} unknowns; samplers about the mode keep dense matrices of their square and "
            f"take up to {MOST_UNKNOWNS}: use a coarser mesh (mesh.edge_length), sample fewer nodes (model.sampled), "
            "or sampler.name: rwmh"
        )

    walk = Walk(target, transition, begin, density)
    # Made here and not while something is traced, where it would leave the target's own arrays in the program.
    unravel(target)

    def prepare(points: Any, key: AnyArray, say: Say) -> tuple[Setup, Any]:
        found = search_modes(target, points, mode_search == "per_chain", say)
        key_start, key_tune = jax.random.split(key)
        keys = jax.random.split(key_start, len(found.chains))
        modes = [np.asarray(gaussian.centre) for gaussian in found.gaussians]
        about = [recentre(target, gaussian, [mode]) for gaussian, mode in zip(found.gaussians, modes, strict=True)]
        setups = [setup_about(target, gaussian, mode) for gaussian, mode in zip(about, modes, strict=True)]
        points = _scatter_all(target, setups, modes, np.asarray(found.chains), keys)
        if tuning is None:
            return setups[0]._replace(stand_in=make_stand_in(target, about[0], modes[0])), points
        return _warm_up(walk, tuning, alone, modes[0], points, key_tune, say)

    def blank() -> Setup:
        nothing = jnp.zeros(unknowns)
        return setup_about(target, Gaussian(nothing, jnp.eye(unknowns)), nothing, np.zeros(alone, int))

    data = partial(_condition, target)
    sampler = Sampler(prepare, data, blank, walk.init, walk.step, walk.observe, exact, many_solves=True)
    # A sampler that is approximate anyway does without the normaliser's own value.
    if has_costly_normaliser(target) and exact:
        sampler = _with_normaliser(target, sampler)
    return _with_loose_nodes(target, sampler, begin, density) if alone else sampler


def _condition(target: Target, setup: Setup) -> Any:
    """The target's data, prepared for chains about the middle."""
    return target.condition(estimands_of(target, target.data, unravel(target)(setup.middle)), setup.loose.nodes)


def _warm_up(
    walk: Walk, tuning: Tuning, alone: int, mode: AnyArray, points: Any, key: AnyArray, say: Say
) -> tuple[Setup, Any]:
    """The setup that the chains go on with, and where they then are.

    Two stages of one length, compiled once: the first leads the chains to where the second is whitened. Already the
    first is whitened by the curvature where they start: that at the mode alone can be so much less that no step is
    short enough for a chain to leave.
    """
    target, stage = walk.target, tuning._replace(warm_up=(tuning.warm_up + 1) // 2, watched=alone > 0)
    key_settle, key_tune, key_search = jax.random.split(key, 3)
    begun = _setup_on_average(target, mode, points, alone)
    begun = begun._replace(stand_in=make_stand_in(target, begun.gaussian, begun.middle))
    _, points, settling = tune(_condition(target, begun), walk, begun, points, key_settle, stage, apart=True)
    # The stand-in reaches far about both middles.
    setup = _setup_on_average(target, mode, points, alone)._replace(stand_in=begun.stand_in)
    setup, points, path = tune(_condition(target, setup), walk, setup, points, key_tune, stage, say=say)
    if settling is None or path is None:
        return setup, points
    # The slowest nodes are those of the second stage, whose trajectories are whole from the first: before, they are
    # short, and chains are on their way.
    nodes = find_slowest(np.asarray(path), alone)
    say(f"nodes that are moved alone, too: {', '.join(map(str, np.asarray(target.variables.coords['node'])[nodes]))}")
    late = np.concatenate([np.asarray(part[len(part) // 4 :, :, nodes]) for part in (settling, path)])
    seen = np.moveaxis(late.reshape(-1, alone, 3), 1, 0)
    setup = setup._replace(loose=place_loose_nodes(setup.gaussian, displacements(target).start, nodes, seen))
    beyond = search_places(target, _condition(target, setup), setup.loose, points, key_search)
    seen = np.concatenate([seen, beyond], axis=1)
    return setup._replace(loose=place_loose_nodes(setup.gaussian, displacements(target).start, nodes, seen)), points


def _with_loose_nodes(target: Target, sampler: Sampler, begin: Callable, density: Density) -> Sampler:
    """A sampler that after each step moves some nodes alone.

    The normaliser, the same wherever they are, has no part in that. Nor would the move have a place in the step that
    the normaliser's test sees: one after the other, two reversible kernels are not.
    """

    def step(data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Info]:
        key_step, key_move = jax.random.split(key)
        state, info = sampler.step(data, setup, key_step, state)
        if not len(setup.loose.nodes):
            return state, info
        kernel = state.kernel if isinstance(state, Delayed) else state

        def beginning(xi: AnyArray) -> Any:
            return begin(xi, density(target, data, setup))

        kernel = move_alone(target, beginning, data, setup.gaussian, setup.loose, key_move, kernel)
        state = state._replace(kernel=kernel) if isinstance(state, Delayed) else kernel
        return state, info._replace(gradients=info.gradients + 1)

    return sampler._replace(step=step)


def _with_normaliser(target: Target, sampler: Sampler) -> Sampler:
    """A sampler of the density with the stand-in made one of the density with the normaliser."""

    assert target.normaliser is not None
    normaliser = target.normaliser

    def init(data: Any, setup: Setup, estimands: Estimands) -> Delayed:
        return Delayed(sampler.init(data, setup, estimands), normaliser.log(data, estimands))

    def observe(data: Any, setup: Setup, state: Delayed) -> Draw:
        estimands, evaluation = sampler.observe(without_normaliser(target, data), setup, state.kernel)
        return Draw(estimands, evaluation._replace(logdensity=evaluation.logdensity + state.log_normaliser))

    def flat_of(setup: Setup, state: Any) -> AnyArray:
        return setup.gaussian.place(state.position)

    true, approximate = partial(log_normaliser_at, target), partial(stand_in_at, target)
    step = delay_acceptance(sampler.step, flat_of, true, approximate)
    return sampler._replace(init=init, step=step, observe=observe)


def _setup_on_average(target: Target, mode: AnyArray, points: Any, alone: int = 0) -> Setup:
    """The setup about the Gaussian averaged over the mode and where the chains are, if it has a slope there.

    It has no stand-in yet. Which nodes are moved alone is not known yet: the first stands for so many.
    """
    flats = np.asarray(jax.vmap(lambda point: flat_position(target, target.data, point))(points))
    sound = (flat for flat in flats if np.isfinite(flat).all() and np.isfinite(slope_at(target, flat)).all())
    places = [mode, *islice(sound, AVERAGED)]
    return setup_about(target, average_gaussian(target, places), np.mean(places, axis=0), np.zeros(alone, int))


def _scatter_all(
    target: Target, setups: list[Setup], modes: list[np.ndarray], chains: np.ndarray, keys: AnyArray
) -> Any:
    """Where each chain starts, about the mode of the number that `chains` has for it."""
    starts, order = [], []
    for number, (setup, mode) in enumerate(zip(setups, modes, strict=True)):
        own = np.flatnonzero(chains == number)
        if len(own):
            starts.append(_scatter(target, setup, jnp.asarray(mode), keys[own]))
            order.append(own)
    back = np.argsort(np.concatenate(order))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[back], *starts)


def _scatter(target: Target, setup: Setup, mode: AnyArray, keys: AnyArray) -> Any:
    """A quarter turn from the mode with too much momentum: a draw of a wider Gaussian, reflected into the support.

    Raises
    ------
    InputError
        If a chain finds no place in the support.
    """
    width, begin = np.full(len(keys), OVERDISPERSION), whiten(setup.gaussian, jnp.asarray(mode))
    plain = without_normaliser(target, target.data)
    lowest = height_and_slope(target, plain, np.asarray(mode))[0] - DEEPEST * dimension(target)
    best, heights = None, np.full(len(keys), -np.inf)
    for _ in range(10):
        points, done = jax.vmap(partial(_start, target, target.data, setup, begin))(keys, jnp.asarray(width))
        flats = np.asarray(jax.vmap(partial(flat_position, target, target.data))(points))
        found = np.array([height_and_slope(target, plain, flat)[0] for flat in flats])
        higher = np.asarray(done) & (np.nan_to_num(found, nan=-np.inf) > heights)
        heights = np.where(higher, found, heights)
        best = points if best is None else jax.tree.map(partial(_choose, higher), points, best)
        if (heights > lowest).all():
            return best
        # A flight that is caught in a corner of the skull does not end; a shorter one may, and leads less far down. Not
        # to the mode itself: where walls hold it, the Gaussian's centre lies beyond them.
        width = np.where(heights > lowest, width, width / 2)
    if np.isfinite(heights).all():
        return best
    lost = int((~np.isfinite(heights)).sum())
    raise InputError(f"{lost} of {len(keys)} chains find no start near the mode outside the skull")


def _choose(which: np.ndarray, one: AnyArray, other: AnyArray) -> AnyArray:
    """The first where it is marked, the other elsewhere, along the leading axis."""
    return jnp.where(which.reshape(-1, *[1] * (one.ndim - 1)), one, other)


@partial(jax.jit, static_argnums=0)
def _start(
    target: Target, data: Any, setup: Setup, begin: AnyArray, key: AnyArray, width: AnyArray
) -> tuple[Any, AnyArray]:
    """Estimands, and whether the flight there was over in time."""
    momentum = width * jax.random.normal(key, begin.shape)
    xi, _ = rotate(setup.walls, clearance_of(target, data, setup), begin, momentum, jnp.pi / 2)
    return estimands_of(target, data, whitened_position(target, setup.gaussian, xi)), jnp.isfinite(xi).all()
