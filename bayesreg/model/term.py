"""The protocols of a term.

A term is one factor of the joint density. It has a `name` and `log(state)`. The other classes here are optional
abilities of a term; callers check for each with `isinstance`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpyro.distributions as dist
from jaxtyping import Bool, Float, Int

from bayesreg.model.blocks import Values
from bayesreg.model.state import State
from bayesreg.types import AnyArray, Scalar


@runtime_checkable
class Term(Protocol):
    """One factor of the joint density; an observation from outside the package needs only these two members."""

    @property
    def name(self) -> str:
        """The name of the term in tables and in the NumPyro program."""

    def log(self, state: State) -> Scalar:
        """Return the logarithm of the factor, up to a constant; JAX can trace it."""


@runtime_checkable
class Likelihood(Protocol):
    """A term that is the density of observed values."""

    def observed(self) -> AnyArray:
        """Return the observed values."""

    def likelihood(self, state: State) -> dist.Distribution:
        """Return the distribution of the observed values, from which replicates can be drawn."""


@runtime_checkable
class Support(Protocol):
    """A term that is zero at some values and can check this at low cost."""

    def allows(self, values: Values) -> Bool[AnyArray, ""]:
        """Check whether the density may be positive at these values."""


@runtime_checkable
class Standardised(Protocol):
    """A term that provides its residuals; the report shows their root mean square."""

    def standardised_residual(self, state: State) -> AnyArray:
        """Return the residuals in units of their sd; if the model holds, their mean square is about one."""


class SharedCurvature(NamedTuple):
    """The curvature that a group of points shares: Σ_r s_r Σ_k g_rk g_rkᵀ, where g_rk holds v_rq for q in group k.

    Attributes
    ----------
    groups : (q,) int array
        The group of each point.
    vectors : (r, q, ...) array
        v, with one number for each unknown of a point.
    signs : (r,) array
        s, 1 or −1.
    """

    groups: Int[AnyArray, "points"]
    vectors: Float[AnyArray, "r points *unknowns"]
    signs: Float[AnyArray, "r"]


class PointCurvature(NamedTuple):
    """The curvature of −log in the displacements of some points of the mesh.

    Attributes
    ----------
    nodes : (q, 4) int array
        Nodes of the cell that holds each point.
    weights : (q, 4) array
        Barycentric coordinates there.
    matrices : (q, 3, 3) array
        The curvature in the displacement of each point, 1/mm².
    shared : SharedCurvature or None
        The curvature of groups of points, in addition, 1/mm².
    """

    nodes: Int[AnyArray, "points 4"]
    weights: Float[AnyArray, "points 4"]
    matrices: Float[AnyArray, "points 3 3"]
    shared: SharedCurvature | None = None


@runtime_checkable
class HasCurvature(Protocol):
    """A term that provides its curvature in the displacements of points, at nodal displacements u, mm."""

    def gauss_newton(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Return the Gauss–Newton part, which is positive semidefinite."""

    def remainder(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Return the rest of the exact curvature: residuals times second derivatives."""


@jax.tree_util.register_static
@dataclass(frozen=True)
class Label:
    """A name, as a part of pytrees that has no arrays."""

    name: str


@jax.tree_util.register_static
class ExternalTerm:
    """A term from outside the package, as a part of pytrees without arrays; its own arrays become constants."""

    def __init__(self, term: Term) -> None:
        self.term = term

    @property
    def name(self) -> str:
        """The name of the wrapped term."""
        return self.term.name

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        """The names of the unknowns that the term brings."""
        return tuple(getattr(self.term, "blocks", {}))

    def log(self, state: State) -> Any:
        """Return the log of the wrapped term."""
        return self.term.log(state)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ExternalTerm) and self.term is other.term

    def __hash__(self) -> int:
        return id(self.term)


Terms = dict[str, Any]
