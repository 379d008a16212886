"""The posterior as the samplers see it: a small target, and objects that it may carry.

Functions of a target take its `data`, a pytree with all its arrays, as an argument: no array is baked into compiled
code, and the data of an easier or a prepared problem serve as well. A *target* is hashable, by all but the values in
its data; what is compiled for one serves its equals.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from bayesreg.types import AnyArray, InputError, Scalar

Estimands = Mapping[str, AnyArray]


@runtime_checkable
class Evaluation(Protocol):
    """The log density at one place, and what was found on the way."""

    logdensity: AnyArray
    u: AnyArray
    similarity_energy: AnyArray
    strain_energy: AnyArray
    solver_iterations: AnyArray
    solver_failed: AnyArray
    outside_support: AnyArray


@runtime_checkable
class Coordinates(Protocol):
    """The map between estimands and positions: a *position* holds the estimands mapped to the real line."""

    def reference(self) -> dict[str, AnyArray]:
        """Estimands at rest."""

    def constrain(self, data: Any, position: Estimands) -> tuple[dict[str, AnyArray], Scalar]:
        """Estimands of a position, and the logarithm of the Jacobian."""

    def unconstrain(self, data: Any, estimands: Estimands) -> dict[str, AnyArray]:
        """Position of estimands."""

    def least_curvature(self, data: Any, position: Estimands) -> dict[str, AnyArray]:
        """Curvature of −log density in every coordinate where next to nothing is known of it, positive."""


@runtime_checkable
class Variables(Protocol):
    """How draws are shown to a reader: named as in xarray, known entries included."""

    @property
    def dims(self) -> Mapping[str, Sequence[str]]:
        """The dimensions of each variable and constant, without chain and draw."""

    @property
    def coords(self) -> Mapping[str, Any]:
        """The labels along these dimensions; "node" are the node numbers of the rows of "u_boundary"."""

    @property
    def constants(self) -> Mapping[str, AnyArray]:
        """Arrays that a reader of the draws needs, such as the mesh."""

    @property
    def attributes(self) -> Mapping[str, Mapping[str, str]]:
        """What variables and constants mean, and their units: "long_name" and "units", as in xarray."""

    def values(self, estimands: Estimands) -> dict[str, Any]:
        """Variables of estimands whose arrays may have leading axes; on the host."""

    def estimands(self, values: Estimands) -> dict[str, Any]:
        """The sampled entries of variables; the inverse of `values`."""


@runtime_checkable
class Normaliser(Protocol):
    """A factor of the density that depends on estimands other than "u_boundary" alone."""

    @property
    def is_costly(self) -> bool:
        """Whether it costs much more than the rest of the density."""

    @property
    def depends_on(self) -> Sequence[str]:
        """Names of what it depends on; some may not be sampled."""

    def smooth_coordinates(self, data: Any, estimands: Estimands) -> AnyArray:
        """As many coordinates (k,) as it depends on, of which it is as smooth a function as can be."""

    def log(self, data: Any, estimands: Estimands) -> Scalar:
        """The logarithm of this factor, as part of the log density."""

    def without(self, data: Any) -> Any:
        """The data of the same problem without this factor."""


@runtime_checkable
class Curvature(Protocol):
    """The curvature of minus a log density: a positive semidefinite part, and what the exact one has besides."""

    @property
    def gauss_newton(self) -> AnyArray:
        """The positive semidefinite part."""

    @property
    def remainder(self) -> AnyArray:
        """The rest of the exact curvature."""


@runtime_checkable
class ModeSearch(Protocol):
    """The posterior as the search for a mode and Laplace's approximation there see it."""

    @property
    def hyperparameters(self) -> Sequence[str]:
        """Names of sampled parameters of the displacements' prior and noise, whose joint mode with these misleads."""

    @property
    def approached(self) -> Estimands | None:
        """Estimands near the mode, where the search begins; None: where the chains start."""

    @property
    def tempering(self) -> Callable[[Estimands], Target] | None:
        """Where the target has yet to be tempered: from estimands near the mode to the target that is to be sampled."""

    def continuation(self) -> Iterable[Any]:
        """Data of ever harder problems, in the displacements alone, that lead to the target's own."""

    def curvature(self, data: Any, estimands: Estimands) -> Curvature:
        """Curvature of minus the log density in "field" (k entries or none) and "u_boundary"."""

    def quadratic_part(self, data: Any) -> Any:
        """The data of the problem without the terms that are far from quadratic in the displacements."""

    def quadratic_curvature(self, data: Any, estimands: Estimands, near: Estimands) -> Any:
        """The part of `curvature` that belongs to `quadratic_part`, as a dense or a sparse matrix.

        What follows "u_boundary" does so as at the estimands `near`.
        """


@runtime_checkable
class Target(Hashable, Protocol):
    """A posterior as the samplers see it; `bayesreg.Posterior` is one. What is optional may be None."""

    @property
    def data(self) -> Any:
        """All arrays of the problem."""

    @property
    def coordinates(self) -> Coordinates:
        """The map between estimands and the real line."""

    @property
    def variables(self) -> Variables:
        """How draws are shown to a reader."""

    def evaluate_estimands(self, data: Any, estimands: Estimands, guess: AnyArray | None = None) -> Any:
        """An `Evaluation` in the constrained space; a guess of its u makes it faster and costs the gradient."""

    def supports(self, data: Any, estimands: Estimands) -> AnyArray:
        """Whether the density may be positive there; much cheaper than an evaluation."""

    def condition(self, estimands: Estimands) -> Any:
        """The data of the same problem, prepared for fast densities near these estimands."""

    @property
    def hard_wall(self) -> Callable[[Any, AnyArray], AnyArray] | None:
        """From the data and "u_boundary" (b, 3) to the nodes (b,) where the density is zero; None: no such wall."""

    @property
    def normaliser(self) -> Normaliser | None:
        """The normaliser of the prior of "u_boundary"; None where the density leaves it out."""

    @property
    def mode_search(self) -> ModeSearch | None:
        """The posterior as the search for a mode sees it; None where no mode can be searched for."""


def logdensity(target: Target, data: Any, position: Estimands) -> Scalar:
    """The log density of a position, the Jacobian included."""
    estimands, log_jacobian = target.coordinates.constrain(data, position)
    return target.evaluate_estimands(data, estimands).logdensity + log_jacobian


def estimands_of(target: Target, data: Any, position: Estimands) -> dict[str, AnyArray]:
    """The estimands of a position."""
    return target.coordinates.constrain(data, position)[0]


def require_soft_wall(target: Target) -> None:
    """Raise InputError where the target has a hard wall: no gradient tells of it."""
    if target.hard_wall is not None:
        raise InputError(
            "samplers that follow the gradient need a soft wall of the skull, and model.skull_width is 0: set it to "
            "half a voxel, model.skull_width: 0.5, or take the paper's sampler, sampler.name: rwmh"
        )


def without_normaliser(target: Target, data: Any) -> Any:
    """The data of the same problem without the normaliser."""
    return data if target.normaliser is None else target.normaliser.without(data)


def has_costly_normaliser(target: Target) -> bool:
    """Whether the density has a normaliser that should not stand in every step of a trajectory."""
    return target.normaliser is not None and target.normaliser.is_costly
