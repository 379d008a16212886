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
    """Number of steps, and the sums over them of the fields of `Info`, in its order; for each chain."""

    steps: AnyArray
    acceptance: AnyArray
    outside_support: AnyArray
    solver_failed: AnyArray
    solver_iterations: AnyArray
    diverging: AnyArray
    gradients: AnyArray
    densities: AnyArray


class Checkpoint(NamedTuple):
    """All that the next block needs (a pytree of arrays with chains as the leading axis).

    Attributes
    ----------
    draws : int
        Kept draws per chain so far.
    setup : pytree
        What the sampler found before its first step.
    state : pytree
    moments : Moments
        Moments of the estimands and of u at every node.
    tally : Tally
        Summed over all steps so far.
    seconds : float
        Spent sampling so far.
    """

    draws: AnyArray
    setup: Any
    state: Any
    moments: Moments
    tally: Tally
    seconds: AnyArray


def no_steps(shape: tuple[int, ...] = ()) -> Tally:
    """The tally before the first step."""
    return Tally(*(jnp.zeros(shape),) * len(Tally._fields))


def count_step(tally: Tally, info: Info) -> Tally:
    """The tally with one step more."""
    return jax.tree.map(jnp.add, tally, Tally(jnp.ones(()), *info))


def with_passed_over(tally: Tally, steps: AnyArray) -> Tally:
    """The tally with so many steps more whose proposals lay outside the support, and cost nothing."""
    return tally._replace(steps=tally.steps + steps, outside_support=tally.outside_support + steps)


def with_solve(tally: Tally, evaluation: Evaluation, steps: int) -> Tally:
    """The tally of steps that do not tell of their solves: the draw's iterations for each of them, its failure once."""
    return tally._replace(
        solver_failed=tally.solver_failed + evaluation.solver_failed,
        solver_iterations=tally.solver_iterations + steps * evaluation.solver_iterations,
    )


def checkpoint_to_arrays(checkpoint: Checkpoint) -> dict[str, np.ndarray]:
    """A checkpoint as named arrays, for a file."""
    return {f"leaf_{i:03d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(checkpoint))}
