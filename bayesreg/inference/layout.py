"""Where each part of a position stands in a flat one: the only place that knows an order of the coordinates."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Int

from bayesreg.types import AnyArray


@lru_cache(maxsize=8)
def unravel(target: Any) -> Callable[[AnyArray], dict[str, AnyArray]]:
    """The map from flat positions to positions."""
    return ravel_pytree(target.unconstrain(target.reference()))[1]


@lru_cache(maxsize=8)
def slices(target: Any) -> dict[str, slice]:
    """The entries of a flat position that hold each part of a position, by name."""
    # Shapes alone: this may be asked for while something is traced.
    shapes = jax.eval_shape(lambda: target.unconstrain(target.reference()))
    found, first = {}, 0
    # In the order of the leaves, which is that of `ravel_pytree`.
    for path, leaf in jax.tree_util.tree_leaves_with_path(shapes):
        found[path[0].key] = slice(first, first + math.prod(leaf.shape))
        first += math.prod(leaf.shape)
    return found


def displacements(target: Any) -> slice:
    """The entries of "u_boundary": three for each node."""
    return slices(target)["u_boundary"]


def others(target: Any) -> Int[np.ndarray, "parameters"]:
    """The entries that are no displacements."""
    size = sum(part.stop - part.start for part in slices(target).values())
    return np.delete(np.arange(size), displacements(target))
