"""The state of a run between two blocks of draws."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.inference.draws.moments import Moments
from bayesreg.inference.kernel import Info
from bayesreg.inference.target import Evaluation
from bayesreg.types import AnyArray


class Tally(NamedTuple):
    """The number of steps of each chain, and the sums of the fields of `Info` over them, in the order of `Info`."""

    steps: AnyArray
    acceptance: AnyArray
    outside_support: AnyArray
    solver_failed: AnyArray
    solver_iterations: AnyArray
    diverging: AnyArray
    gradients: AnyArray
    densities: AnyArray


class Checkpoint(NamedTuple):
    """The state that the next block starts from (a pytree of arrays with chains as the leading axis).

    Attributes
    ----------
    draws : int
        Kept draws per chain so far.
    setup : pytree
        The setup that the sampler computed before its first step.
    state : pytree
    moments : Moments
        Moments of the estimands and of u at every node.
    tally : Tally
        The tally of all steps so far.
    seconds : float
        Seconds of sampling so far.
    """

    draws: AnyArray
    setup: Any
    state: Any
    moments: Moments
    tally: Tally
    seconds: AnyArray


def no_steps(shape: tuple[int, ...] = ()) -> Tally:
    """Make the tally before the first step."""
    return Tally(*(jnp.zeros(shape),) * len(Tally._fields))


def count_step(tally: Tally, info: Info) -> Tally:
    """Add one step to a tally."""
    return jax.tree.map(jnp.add, tally, Tally(jnp.ones(()), *info))


def with_passed_over(tally: Tally, steps: AnyArray) -> Tally:
    """Add a number of skipped steps to a tally; their proposals lay outside the support and cost nothing."""
    return tally._replace(steps=tally.steps + steps, outside_support=tally.outside_support + steps)


def with_solve(tally: Tally, evaluation: Evaluation, steps: int) -> Tally:
    """Add the solve of a draw to the tally of its steps, which do not report their solves.

    The iterations of the draw count for each of the steps, and its failure counts once.
    """
    return tally._replace(
        solver_failed=tally.solver_failed + evaluation.solver_failed,
        solver_iterations=tally.solver_iterations + steps * evaluation.solver_iterations,
    )


def checkpoint_to_arrays(checkpoint: Checkpoint) -> dict[str, np.ndarray]:
    """Convert a checkpoint to named arrays, for a file."""
    return {f"leaf_{i:03d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(checkpoint))}
