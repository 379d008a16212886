"""The interface between an observation and the posterior.

An observation of the package has a `name` and a method `on(mesh, preset)` that places it on a mesh. An object from
outside with only a `name` and a function `log(state)` is an observation, too. The protocols here are optional abilities
of an observation, each with the code that uses it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import xarray as xr
from jaxtyping import Float

from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Blocks, Values
from bayesreg.model.state import State
from bayesreg.model.term import ExternalTerm
from bayesreg.types import AnyArray


class Placed(NamedTuple):
    """An observation on a mesh.

    Attributes
    ----------
    observation : object
        The observation, prepared for this mesh.
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
        """Place the observation on a mesh; options that were not given are those of the model's preset."""


class Recorded(NamedTuple):
    """The observed values in the form that ArviZ stores.

    Attributes
    ----------
    values : xarray.DataArray
        The values, with names of dimensions, labels and units.
    chosen : int array or slice
        The entries of all that was observed, along its first axis.
    """

    values: xr.DataArray
    chosen: Any = slice(None)


@runtime_checkable
class Recordable(Protocol):
    """An observation whose values, and replicates of them, are stored with the draws."""

    def recorded(self, term: Any) -> Recorded:
        """Return the observed values; the `likelihood` of the term draws replicates of them."""


@runtime_checkable
class Checked(Protocol):
    """An observation that evaluates every draw for a posterior predictive check."""

    def check_draw(self, term: Any, state: State, key: AnyArray) -> dict[str, AnyArray]:
        """Compute small arrays of this draw; JAX can trace it."""


@runtime_checkable
class Summarised(Protocol):
    """An observation that stores arrays for the report."""

    def summarise(self, posterior: Any, state: State, draws: Values) -> dict[str, np.ndarray]:
        """Return arrays, by name, from the state of the mean and from some draws of all values, in a leading axis."""


@runtime_checkable
class Smoothable(Protocol):
    """An observation that has easier forms for the search for a mode."""

    def smoothed_term(self, term: Any, sd: float) -> Any:
        """Return the term with smoothed data; sd in mm."""


@runtime_checkable
class Doubtful(Protocol):
    """An observation that may have sentences on doubtful values, for the terminal and the report's first page."""

    def doubts(self, summary: Mapping[str, np.ndarray]) -> list[str]:
        """Return these sentences, from the arrays of `summarise`."""


@runtime_checkable
class Noted(Protocol):
    """An observation that may have sentences on what was found, for the terminal and the report."""

    def notes(self, summary: Mapping[str, np.ndarray]) -> list[str]:
        """Return these sentences, from the arrays of `summarise`."""


# The subfolder of a run with the maps of its observations.
MAPS = "maps"


class Maps(NamedTuple):
    """Images that an observation adds to the folder of a run, by the names of their files.

    Attributes
    ----------
    of_fixed, of_moving : dict
        Images in the world of the fixed image, and in that of the aligned moving image.
    """

    of_fixed: dict[str, Image]
    of_moving: dict[str, Image]


@runtime_checkable
class Mapped(Protocol):
    """An observation that makes maps."""

    def maps(self, summary: Mapping[str, np.ndarray]) -> Maps:
        """Return the maps, from the arrays of `summarise`."""


@runtime_checkable
class Correlated(Protocol):
    """An observation whose values depend on one another, so that its likelihood counts too many of them."""

    @property
    def is_tempered_by_residuals(self) -> bool:
        """Whether residuals determine the number of independent values."""

    def count_independent_points(self, term: Any, u: Float[AnyArray, "nodes 3"], values: Values) -> float:
        """Count the independent values, from the residuals at these values of all blocks."""


def place(observation: Any, mesh: TetMesh, preset: str) -> Placed:
    """Place an observation of any kind on a mesh."""
    if isinstance(observation, Observation):
        return observation.on(mesh, preset)
    return Placed(observation, ExternalTerm(observation), getattr(observation, "blocks", {}))


def bounding_points(observation: Any) -> Float[np.ndarray, "points 3"] | None:
    """Return the points at which an observation bounds the motion; None if it bounds all of it."""
    return getattr(observation, "fixed_points", None)
