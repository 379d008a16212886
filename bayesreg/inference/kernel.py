"""The definition of a sampler: a record of pure functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from bayesreg.inference.deadline import Deadline
from bayesreg.inference.target import Estimands
from bayesreg.types import AnyArray

OnMode = Callable[[Estimands], None]


class Info(NamedTuple):
    """The report of one transition: acceptance probability, failures and cost.

    Attributes
    ----------
    acceptance_rate : scalar
    outside_support, diverging : scalar bool
    solver_failed, solver_iterations : scalar bool, scalar
        Whether the elastic solve of the proposal failed, and its iterations; both are zero if a transition has many
        solves (`Sampler.many_solves`).
    gradients, densities : scalar integer
        The number of evaluations of the density with its gradient, and without it.
    """

    acceptance_rate: AnyArray
    outside_support: AnyArray
    solver_failed: AnyArray
    solver_iterations: AnyArray
    diverging: AnyArray
    gradients: AnyArray
    densities: AnyArray


def joined(first: Info, second: Info) -> Info:
    """Join the reports of two transitions: rates and costs are added, and a flag is set if one of both is set."""
    return jax.tree.map(lambda a, b: a | b if a.dtype == bool else a + b, first, second)


class Draw(NamedTuple):
    """The current estimands of a chain, and the `Evaluation` at them."""

    estimands: dict[str, AnyArray]
    evaluation: Any


class Sampler(NamedTuple):
    """A transition kernel, as pure functions.

    Attributes
    ----------
    prepare : callable
        (points, key, deadline, on_mode) → (setup, points). It takes start points (chains as the leading axis). It
        returns the setup, a pytree that the kernel needs besides the data and that is computed once, and the points at
        which chains start. At the `Deadline` it ends with what it has. An exact sampler that begins with a search for
        the mode calls `on_mode` with estimands drawn from Laplace's approximation (draws as the leading axis): when the
        search has ended or, if an earlier search led near the mode, before it.
    data : callable
        (setup) → the data of the target that the functions below take.
    blank : callable
        () → a setup of the same structure; the reader of a stored setup needs it.
    init : callable
        (data, setup, estimands) → state.
    step : callable
        (data, setup, key, state) → (state, Info).
    observe : callable
        (data, setup, state) → Draw.
    exact : bool
        Whether the posterior is the stationary distribution of the kernel.
    outside : callable, optional
        (data, setup, key, state) → whether the step with this key proposes a point outside the support, and so leaves
        the state as it is. A sampler has this function if the answer costs much less than a step. Such steps are
        skipped; only their number outside the support is counted.
    many_solves : bool
        Whether a step has many elastic solves and does not report them. The solve of the draw is counted instead.
    compile : callable, optional
        (setup, points) → None. It compiles the programs of `prepare` ahead, for arguments of these shapes.
    """

    prepare: Callable[[Any, AnyArray, Deadline, OnMode], tuple[Any, Any]]
    data: Callable[[Any], Any]
    blank: Callable[[], Any]
    init: Callable[[Any, Any, Estimands], Any]
    step: Callable[[Any, Any, AnyArray, Any], tuple[Any, Info]]
    observe: Callable[[Any, Any, Any], Draw]
    exact: bool
    outside: Callable[[Any, Any, AnyArray, Any], AnyArray] | None = None
    many_solves: bool = False
    compile: Callable[[Any, Any], None] | None = None
