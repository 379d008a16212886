"""Where each part of a position stands in a flat one: the only place that knows an order of the coordinates."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from functools import lru_cache
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Int

from bayesreg.inference.target import Coordinates, Estimands
from bayesreg.types import AnyArray


@runtime_checkable
class Placed(Hashable, Protocol):
    """The part of a target that the order of the coordinates follows from."""

    @property
    def data(self) -> Any:
        """See `Target`."""

    @property
    def coordinates(self) -> Coordinates:
        """See `Target`."""


def flat_position(target: Placed, data: Any, estimands: Estimands) -> AnyArray:
    """The flat position of estimands."""
    return ravel_pytree(target.coordinates.unconstrain(data, estimands))[0]


@lru_cache(maxsize=8)
def unravel(target: Placed) -> Callable[[AnyArray], dict[str, AnyArray]]:
    """The map from flat positions to positions."""
    return ravel_pytree(_at_rest(target))[1]


@lru_cache(maxsize=8)
def slices(target: Placed) -> dict[str, slice]:
    """The entries of a flat position that hold each part of a position, by name."""
    # Shapes alone: this may be asked for while something is traced.
    shapes = jax.eval_shape(lambda: _at_rest(target))
    found, first = {}, 0
    # In the order of the leaves, which is that of `ravel_pytree`.
    for path, leaf in jax.tree_util.tree_leaves_with_path(shapes):
        found[path[0].key] = slice(first, first + math.prod(leaf.shape))
        first += math.prod(leaf.shape)
    return found


def dimension(target: Placed) -> int:
    """The number of coordinates."""
    return sum(part.stop - part.start for part in slices(target).values())


def marked(target: Placed, *names: str) -> Bool[np.ndarray, "dimension"]:
    """Mark the entries of a flat position that belong to the parts of these names; some parts may not exist."""
    marks = np.zeros(dimension(target), bool)
    for name in names:
        if name in slices(target):
            marks[slices(target)[name]] = True
    return marks


def others(target: Placed) -> Int[np.ndarray, "parameters"]:
    """The entries that are no displacements."""
    return np.flatnonzero(~marked(target, "u_boundary"))


def _at_rest(target: Placed) -> dict[str, AnyArray]:
    return target.coordinates.unconstrain(target.data, target.coordinates.reference())
