"""The order of the coordinates in a flat position. No other module knows this order."""

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
    """The part of a target that defines the order of the coordinates."""

    @property
    def data(self) -> Any:
        """All arrays of the problem, as in `Target`."""

    @property
    def coordinates(self) -> Coordinates:
        """The map between estimands and the real line, as in `Target`."""


def flat_position(target: Placed, data: Any, estimands: Estimands) -> AnyArray:
    """Flatten the position of estimands."""
    return ravel_pytree(target.coordinates.unconstrain(data, estimands))[0]


@lru_cache(maxsize=8)
def unravel(target: Placed) -> Callable[[AnyArray], dict[str, AnyArray]]:
    """Make the map from flat positions to positions."""
    return ravel_pytree(_at_rest(target))[1]


@lru_cache(maxsize=8)
def slices(target: Placed) -> dict[str, slice]:
    """Find the entries of a flat position that hold each part of a position, by name."""
    # Shapes are enough: this function may be called while JAX traces another one.
    shapes = jax.eval_shape(lambda: _at_rest(target))
    entries, first = {}, 0
    # `ravel_pytree` concatenates the leaves in this order.
    for path, leaf in jax.tree_util.tree_leaves_with_path(shapes):
        entries[path[0].key] = slice(first, first + math.prod(leaf.shape))
        first += math.prod(leaf.shape)
    return entries


def dimension(target: Placed) -> int:
    """Count the coordinates of a position."""
    return sum(block.stop - block.start for block in slices(target).values())


def marked(target: Placed, *names: str) -> Bool[np.ndarray, "dimension"]:
    """Mark the entries of a flat position that belong to the named parts; a part need not exist."""
    marks = np.zeros(dimension(target), bool)
    for name in names:
        if name in slices(target):
            marks[slices(target)[name]] = True
    return marks


def others(target: Placed) -> Int[np.ndarray, "parameters"]:
    """List the entries of a flat position that are not displacements."""
    return np.flatnonzero(~marked(target, "u_boundary"))


def _at_rest(target: Placed) -> dict[str, AnyArray]:
    return target.coordinates.unconstrain(target.data, target.coordinates.reference())
