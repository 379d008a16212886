"""The interface between a posterior and the samplers: a target, and the objects that it may have.

The functions of a target take its `data`, a pytree with all its arrays, as an argument. Compiled code then contains no
array, and accepts the data of an easier or a prepared problem, too. A *target* is hashable; its hash ignores the values
in its data. Code that is compiled for one target serves all equal ones.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from bayesreg.types import AnyArray, InputError, Scalar

Estimands = Mapping[str, AnyArray]


@runtime_checkable
class Evaluation(Protocol):
    """The log density of some estimands, and the results of its computation."""

    logdensity: AnyArray
    u: AnyArray
    similarity_energy: AnyArray
    strain_energy: AnyArray
    solver_iterations: AnyArray
    solver_failed: AnyArray
    outside_support: AnyArray


@runtime_checkable
class Coordinates(Protocol):
    """The map between estimands and positions. A *position* holds the estimands mapped to the real line."""

    def reference(self) -> dict[str, AnyArray]:
        """Return the estimands of the body at rest."""

    def constrain(self, data: Any, position: Estimands) -> tuple[dict[str, AnyArray], Scalar]:
        """Map a position to its estimands; return them and the logarithm of the Jacobian."""

    def unconstrain(self, data: Any, estimands: Estimands) -> dict[str, AnyArray]:
        """Map estimands to their position."""

    def least_curvature(self, data: Any, position: Estimands) -> dict[str, AnyArray]:
        """Return a lower bound, positive, for the curvature of −log density in every coordinate.

        It is the curvature of a coordinate about which almost nothing is known.
        """


@runtime_checkable
class Variables(Protocol):
    """The names and shapes of draws for a reader, as in xarray; known entries are included."""

    @property
    def dims(self) -> Mapping[str, Sequence[str]]:
        """The dimensions of each variable and constant, without chain and draw."""

    @property
    def coords(self) -> Mapping[str, Any]:
        """The labels along these dimensions; "node" holds the node numbers of the rows of "u_boundary"."""

    @property
    def constants(self) -> Mapping[str, AnyArray]:
        """Arrays that a reader of the draws needs, such as the mesh."""

    @property
    def attributes(self) -> Mapping[str, Mapping[str, str]]:
        """The meanings and units of variables and constants: "long_name" and "units", as in xarray."""

    def values(self, estimands: Estimands) -> dict[str, Any]:
        """Convert estimands, whose arrays may have leading axes, to variables on the host."""

    def estimands(self, values: Estimands) -> dict[str, Any]:
        """Take the sampled entries of variables; this is the inverse of `values`."""


@runtime_checkable
class Normaliser(Protocol):
    """A factor of the density that does not depend on "u_boundary"."""

    @property
    def is_costly(self) -> bool:
        """Whether this factor costs much more than the rest of the density."""

    @property
    def depends_on(self) -> Sequence[str]:
        """The names of the estimands on which this factor depends; some may not be sampled."""

    def smooth_coordinates(self, data: Any, estimands: Estimands) -> AnyArray:
        """Compute coordinates (k,) of which the logarithm of this factor is a smooth function.

        Their number k is the number of estimands on which it depends.
        """

    def log(self, data: Any, estimands: Estimands) -> Scalar:
        """Compute the logarithm of this factor, as part of the log density."""

    def without(self, data: Any) -> Any:
        """Return the data of the same problem without this factor."""


@runtime_checkable
class Curvature(Protocol):
    """The curvature of minus a log density, as the sum of a positive semidefinite part and a remainder."""

    @property
    def gauss_newton(self) -> AnyArray:
        """The positive semidefinite part."""

    @property
    def remainder(self) -> AnyArray:
        """The exact curvature less the positive semidefinite part."""


@runtime_checkable
class ModeSearch(Protocol):
    """The parts of a posterior that the search for a mode and Laplace's approximation need."""

    @property
    def hyperparameters(self) -> Sequence[str]:
        """The names of sampled parameters of the prior and the noise of the displacements.

        The joint mode of these and the displacements is far from most of the probability.
        """

    @property
    def separable(self) -> Sequence[str]:
        """The names of hyperparameters on which, at a fixed "u_boundary", only `quadratic_part` depends."""

    @property
    def followed(self) -> Sequence[str]:
        """The names of hyperparameters that the displacements follow, because the data say little about them."""

    @property
    def search_start(self) -> Estimands | None:
        """Estimands near the mode, where the search begins; None if it begins where the chains start."""

    @property
    def tempering(self) -> Callable[[Estimands], Target] | None:
        """The map from estimands near the mode to the tempered target; None if the target needs no tempering."""

    @property
    def loosening(self) -> Mapping[str, float]:
        """The factors, by name, on the scales with which the search begins."""

    def continuation(self) -> Iterable[Any]:
        """Yield the data of problems of increasing difficulty that lead to the target's own problem.

        Only the displacements are unknown in these problems.
        """

    def curvature(self, data: Any, estimands: Estimands) -> Curvature:
        """Compute the curvature of minus the log density in "field" (k entries or none) and "u_boundary"."""

    def quadratic_part(self, data: Any) -> Any:
        """Return the data of the problem without the terms that are far from quadratic in the displacements."""

    def quadratic_curvature(self, data: Any, estimands: Estimands, near: Estimands) -> Any:
        """Compute the part of `curvature` that belongs to `quadratic_part`, as a dense or a sparse matrix.

        The nodes that follow "u_boundary" do so as they do at the estimands `near`.
        """

    def quadratic_trace(self, data: Any, near: Estimands, covariance: AnyArray) -> Callable[[Estimands], float]:
        """Make the function from estimands to tr(C R), up to a constant.

        C is a covariance in the order of `curvature`, and R is the `quadratic_curvature`.
        """


@runtime_checkable
class Marginal(Protocol):
    """A posterior with the displacements integrated out, given the weights of the observations (a pytree)."""

    @property
    def problem(self) -> Any:
        """The data of the posterior."""

    @property
    def costly(self) -> tuple[str, ...]:
        """The names of the parameters whose change makes `log` costly."""

    @property
    def touched_nodes(self) -> AnyArray:
        """The nodes whose unknowns v are the arguments of factors that are not Gaussian; it may be empty."""

    @property
    def drawn(self) -> tuple[str, ...]:
        """The names of the parameters that `draw_weights` draws given the displacements, and `log` does not know."""

    def draw_weights(self, key: AnyArray, estimands: Estimands) -> tuple[AnyArray, dict[str, AnyArray]]:
        """Draw the weights given all estimands; return them, and all estimands, of which some move with the weights."""

    def log(self, estimands: Estimands, weights: AnyArray) -> Scalar:
        """Compute the log density of all estimands but "u_boundary", which may have any value, given the weights."""

    def draw_displacements(
        self, key: AnyArray, estimands: Estimands, weights: AnyArray, v: AnyArray | None = None
    ) -> AnyArray:
        """Draw "u_boundary" given the other estimands and the weights, and v if it is there."""

    def draw_touched(self, key: AnyArray, estimands: Estimands) -> AnyArray:
        """Draw v given all estimands, near to the touched unknowns."""

    def touched(self, estimands: Estimands, weights: AnyArray) -> Any:
        """Compute the `log`, and the `mean` and the Cholesky factor `root` of the Gaussian of v given θ and weights."""

    def log_surfaces(self, estimands: Estimands, v: AnyArray) -> Scalar:
        """Compute the log of the factors that are functions of v."""

    def log_approximations(self, v: AnyArray) -> Scalar:
        """Compute the log of the Gaussian factors that stand for them in `log`."""

    def log_others(self, estimands: Estimands) -> Scalar:
        """Compute the log of the terms of the posterior that are not Gaussian."""


@runtime_checkable
class Marginalisation(Protocol):
    """The function that prepares, at its first call, a posterior with the displacements integrated out."""

    @property
    def is_costly(self) -> bool:
        """Whether each new stiffness costs a factorisation."""

    @property
    def has_costly_draws(self) -> bool:
        """Whether a draw takes a part of a second."""

    def __call__(self) -> Marginal:
        """Return the posterior with the displacements integrated out."""


@runtime_checkable
class Target(Hashable, Protocol):
    """The posterior as the samplers use it; `bayesreg.Posterior` is an implementation."""

    @property
    def data(self) -> Any:
        """All arrays of the problem."""

    @property
    def coordinates(self) -> Coordinates:
        """The map between estimands and the real line."""

    @property
    def variables(self) -> Variables:
        """The names and shapes of draws for a reader."""

    def evaluate_estimands(self, data: Any, estimands: Estimands, guess: AnyArray | None = None) -> Any:
        """Evaluate the density of estimands, in the constrained space; return an `Evaluation`.

        A guess of its u makes the function faster, but the result then has no gradient.
        """

    def supports(self, data: Any, estimands: Estimands) -> AnyArray:
        """Check whether the density may be positive at estimands; this is much cheaper than an evaluation."""

    def condition(self, estimands: Estimands) -> Any:
        """Prepare the data of the same problem for fast densities near these estimands."""

    @property
    def hard_wall(self) -> Callable[[Any, AnyArray], AnyArray] | None:
        """The map from the data and "u_boundary" (b, 3) to marks (b,) of the nodes that make the density zero.

        The map is None if the target has no hard wall.
        """

    @property
    def normaliser(self) -> Normaliser | None:
        """The normaliser of the prior of "u_boundary"; None if the density leaves it out."""

    @property
    def surrogate(self) -> Callable[[Any], Any] | None:
        """The map from the data to those of a similar problem with nearly the same density, up to the normaliser.

        The costly normaliser is left out. The map is None without a costly normaliser.
        """

    @property
    def prepare_marginal(self) -> Marginalisation | None:
        """The marginalisation; None if the displacements cannot be integrated out in closed form."""

    @property
    def mode_search(self) -> ModeSearch | None:
        """The parts that the search for a mode needs; None if the target does not allow this search."""


def logdensity(target: Target, data: Any, position: Estimands) -> Scalar:
    """Compute the log density of a position, including the Jacobian."""
    estimands, log_jacobian = target.coordinates.constrain(data, position)
    return target.evaluate_estimands(data, estimands).logdensity + log_jacobian


def estimands_of(target: Target, data: Any, position: Estimands) -> dict[str, AnyArray]:
    """Map a position to its estimands."""
    return target.coordinates.constrain(data, position)[0]


def require_soft_wall(target: Target) -> None:
    """Raise InputError if the target has a hard wall, which the gradient does not show."""
    if target.hard_wall is not None:
        raise InputError(
            "samplers that follow the gradient need a soft wall of the skull, and model.skull_width is 0: set it to "
            "half a voxel, model.skull_width: 0.5, or take the paper's model and sampler, model.preset: paper and "
            "sampler.name: rwmh"
        )


def without_normaliser(target: Target, data: Any) -> Any:
    """Return the data of the same problem without the normaliser."""
    return data if target.normaliser is None else target.normaliser.without(data)
