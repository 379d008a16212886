"""What the samplers know of a posterior."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol, runtime_checkable

from bayesreg.types import AnyArray

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
class Curvature(Protocol):
    """Of minus a log density: a positive semidefinite part, and what the exact one has besides."""

    @property
    def gauss_newton(self) -> AnyArray:
        """The former."""

    @property
    def remainder(self) -> AnyArray:
        """The latter."""


@runtime_checkable
class Target(Protocol):
    """A posterior as the samplers see it; `bayesreg.Posterior` is one.

    `data` is a pytree and an argument of every density, so that no array is baked into compiled code.
    """

    def __hash__(self) -> int:
        """Of all but the values in `data`, as for equality: what is compiled for a target serves its equals."""

    @property
    def data(self) -> Any:
        """All arrays of the problem."""

    @property
    def sampled(self) -> AnyArray:
        """Node numbers of the rows of "u_boundary"."""

    @property
    def free(self) -> Mapping[str, AnyArray]:
        """Indices of the sampled entries of "lam" and "mu"."""

    @property
    def entry_names(self) -> tuple[str, ...]:
        """Names of all entries of "lam" and "mu"."""

    def evaluate_estimands(self, data: Any, estimands: Estimands, guess: AnyArray | None = None) -> Any:
        """An `Evaluation` in the constrained space; a guess of its u makes it faster and costs the gradient."""

    def conditioned(self, estimands: Estimands, alone: AnyArray, quick: bool = False) -> Any:
        """The data of the same problem, prepared for fast densities near these estimands.

        And for `local_logdensity` of the nodes in the rows `alone` of "u_boundary". Where there may be many, `quick` is
        about as good and cheap.
        """

    def supports(self, data: Any, estimands: Estimands) -> AnyArray:
        """Whether the density may be positive there."""

    def estimands(self, values: Estimands) -> dict[str, AnyArray]:
        """The sampled entries of values."""

    def reference(self) -> dict[str, AnyArray]:
        """Values at rest."""

    def allowed(self, u_boundary: AnyArray) -> AnyArray:
        """Which sampled nodes, so displaced, satisfy the hard constraint."""

    def constant_data(self) -> dict[str, AnyArray]:
        """What a reader of the draws needs to know of the mesh."""


@runtime_checkable
class SmoothTarget(Target, Protocol):
    """What samplers that follow gradients know besides.

    A *position* holds the estimands mapped to the real line; "u_boundary" stays as it is.
    """

    def logdensity_of(self, data: Any, position: Estimands) -> AnyArray:
        """Log density of a position, the Jacobian included."""

    def constrain_of(self, data: Any, position: Estimands) -> dict[str, AnyArray]:
        """Estimands of a position."""

    def unconstrain_of(self, data: Any, estimands: Estimands) -> dict[str, AnyArray]:
        """Position of estimands."""

    def unconstrain(self, values: Estimands) -> dict[str, AnyArray]:
        """Position of values."""

    @property
    def costly_normaliser(self) -> bool:
        """Whether the density has a normaliser that depends on estimands other than "u_boundary", and is costly."""

    def log_normaliser(self, data: Any, estimands: Estimands) -> AnyArray:
        """It, as part of the log density; it is the same for all displacements."""

    def without_normaliser(self, data: Any) -> Any:
        """The data of the same problem without it."""

    def clearance(self, data: Any, u: AnyArray, nodes: AnyArray) -> AnyArray:
        """Signed distance (…, nodes), mm, of rows of "u_boundary" displaced by u (…, nodes, 3) to where none may be."""

    @property
    def knows_neighbourhoods(self) -> bool:
        """Whether there is a `local_logdensity`."""

    def local_logdensity(self, data: Any, estimands: Estimands, which: AnyArray) -> Callable[[AnyArray], AnyArray]:
        """Approximate log density, up to a constant, as a function of the displacement (3,) of one node, mm.

        The node is that one of those that `data` was conditioned for. The sum over all of these is one function of
        where they are: it must not matter to any of them where another one is.
        """

    def local_equilibrium(self, data: Any, estimands: Estimands, which: AnyArray) -> AnyArray:
        """Displacement (3,), mm, at which one of these nodes feels no elastic force while all others stay."""

    def without_walls(self, data: Any) -> Any:
        """The data of the same problem in which a node may be anywhere."""

    def continuation(self) -> Iterable[Any]:
        """Data of ever harder problems, in the displacements alone, that lead to this one."""

    def least_curvature(self, data: Any, position: Estimands) -> dict[str, AnyArray]:
        """Of minus the log density in every coordinate where next to nothing is known of it, positive."""

    def displacement_curvature(self, data: Any, estimands: Estimands) -> Curvature:
        """Curvature of minus the log density in "field" (k entries or none) and "u_boundary"."""
