"""What an observation is to the posterior.

An observation has a `name` and, inside the package, a method `on(mesh, preset)` that places it on a mesh. An object
from outside with a function `log(state)` alone is an observation, too. The protocols here say what else one may know,
and who asks for it.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import xarray as xr
from jaxtyping import Float

from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Blocks, Values
from bayesreg.model.state import State
from bayesreg.model.term import Outside
from bayesreg.types import AnyArray


class Placed(NamedTuple):
    """An observation on a mesh.

    Attributes
    ----------
    observation : object
        The observation, prepared for what follows.
    term : pytree
        The factor of the density (`bayesreg.model.term.Term`).
    blocks : dict
        The unknowns that the observation brings, by name.
    """

    observation: Any
    term: Any
    blocks: Blocks


@runtime_checkable
class Observation(Protocol):
    """An observation that makes its own term."""

    name: str

    def on(self, mesh: TetMesh, preset: str) -> Placed:
        """The observation on a mesh; options that were not given are those of the model's preset."""


class Recorded(NamedTuple):
    """What was observed, as ArviZ keeps it.

    Attributes
    ----------
    values : xarray.DataArray
        With names of its dimensions, labels and units.
    chosen : int array or slice
        The entries of all that was observed, along its first axis.
    """

    values: xr.DataArray
    chosen: Any = slice(None)


@runtime_checkable
class Recordable(Protocol):
    """An observation whose values, and replicates of them, are kept with the draws."""

    def recorded(self, term: Any) -> Recorded:
        """The observed values; the `likelihood` of the term draws replicates of them."""


@runtime_checkable
class Checked(Protocol):
    """An observation that looks at every draw for a posterior predictive check."""

    def check_draw(self, term: Any, state: State, key: AnyArray) -> dict[str, AnyArray]:
        """Small arrays of this draw; JAX can trace it."""


@runtime_checkable
class Summarised(Protocol):
    """An observation that leaves arrays for the report."""

    def summarise(self, posterior: Any, state: State) -> dict[str, np.ndarray]:
        """Arrays, by name, at the state that the mean of the draws is."""


@runtime_checkable
class Eased(Protocol):
    """An observation of which the search for a mode knows easier forms."""

    def eased(self, term: Any, sd: float) -> Any:
        """The term with what is compared smoothed, sd in mm."""


@runtime_checkable
class Correlated(Protocol):
    """An observation whose values depend on one another, so that its likelihood counts too many of them."""

    @property
    def is_tempered_by_residuals(self) -> bool:
        """Whether residuals tell how many values are independent."""

    def count_independent_points(self, term: Any, u: Float[AnyArray, "nodes 3"], values: Values) -> float:
        """How many values are independent, by the residuals at these values of all blocks."""


def place(observation: Any, mesh: TetMesh, preset: str) -> Placed:
    """An observation of any kind on a mesh."""
    if isinstance(observation, Observation):
        return observation.on(mesh, preset)
    return Placed(observation, Outside(observation), getattr(observation, "blocks", {}))


def points_that_bound(observation: Any) -> Float[np.ndarray, "points 3"] | None:
    """The points at which an observation bounds the motion; None where it bounds all of it."""
    return getattr(observation, "fixed_points", None)
