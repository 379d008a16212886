"""The definition of a sampler: a handful of pure functions behind one small adapter."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from bayesreg.inference.target import Estimands
from bayesreg.types import AnyArray


class Info(NamedTuple):
    """One transition: what the proposal met, the probability with which it was accepted, and what it cost.

    Attributes
    ----------
    acceptance_rate : scalar
    outside_support, diverging : scalar bool
    solver_failed, solver_iterations : scalar bool, scalar
        Figures of the proposal's solve; zero where a transition has many (`Sampler.many_solves`).
    gradients, densities : scalar integer
        Evaluations of the density with its gradient, and without.
    """

    acceptance_rate: AnyArray
    outside_support: AnyArray
    solver_failed: AnyArray
    solver_iterations: AnyArray
    diverging: AnyArray
    gradients: AnyArray
    densities: AnyArray


def together(infos: Info) -> Info:
    """One report of several transitions, stacked: rates are averaged, costs are added, and what befell one counts."""
    return Info(
        acceptance_rate=infos.acceptance_rate.mean(),
        outside_support=infos.outside_support.any(),
        solver_failed=infos.solver_failed.any(),
        solver_iterations=infos.solver_iterations.sum(),
        diverging=infos.diverging.any(),
        gradients=infos.gradients.sum(),
        densities=infos.densities.sum(),
    )


class Draw(NamedTuple):
    """Where a chain stands: estimands, and the `Evaluation` there."""

    estimands: dict[str, AnyArray]
    evaluation: Any


class Sampler(NamedTuple):
    """A transition kernel.

    Attributes
    ----------
    prepare : callable
        (points, key) → (setup, points): start points (chains as the leading axis) to what the kernel needs
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
    outside : callable, optional
        (data, setup, key, state) → whether the step with this key proposes what lies outside the support, and so leaves
        the state as it is. For samplers that can tell at a fraction of the price of a step: such steps are passed over,
        and counted as outside the support and nothing else.
    many_solves : bool
        Whether a step has many solves, of which it does not tell: that of the draw is counted in their place.
    """

    prepare: Callable[[Any, AnyArray], tuple[Any, Any]]
    data: Callable[[Any], Any]
    blank: Callable[[], Any]
    init: Callable[[Any, Any, Estimands], Any]
    step: Callable[[Any, Any, AnyArray, Any], tuple[Any, Info]]
    observe: Callable[[Any, Any, Any], Draw]
    exact: bool
    outside: Callable[[Any, Any, AnyArray, Any], AnyArray] | None = None
    many_solves: bool = False
