"""Nodes that a search for the mode has left in a pocket, millimetres from where they are far more probable.

A node that few elements hold may be caught where the blurred images of a search's first stages match by chance. It
stays there, and the chains with it: between the two places the density is next to nothing, and no curvature in the
pocket hints at the other. Elasticity does. Of every node, while all others stay, places are looked at about the one
where no elastic force acts on it.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float, Int

from bayesreg.inference.laplace import unravel
from bayesreg.inference.target import Estimands, SmoothTarget
from bayesreg.types import AnyArray

# Places for a node: Normal about where no force acts on it, their standard deviations its way there and halves of it.
PLACES, HALVES = 240, 5
# A node is put elsewhere if the log density is higher there by more.
GAIN = 1.0
# Nodes looked at together: all of them respond to every sampled one.
AT_A_TIME = 512


def out_of_pockets(
    target: SmoothTarget, flat: Float[np.ndarray, "dimension"]
) -> tuple[Float[np.ndarray, "dimension"], Int[np.ndarray, "moved"]]:
    """The flat position with some nodes elsewhere, where the log density is higher, and the rows of these nodes."""
    nodes = len(target.sampled)
    moved: list[int] = []
    if not target.knows_neighbourhoods:
        return flat, np.array(moved, int)
    estimands = target.constrain_of(target.data, unravel(target)(jnp.asarray(flat)))
    for rows in np.array_split(np.arange(nodes), -(-nodes // AT_A_TIME)):
        data = target.conditioned(estimands, rows)
        gains, places = (np.asarray(found) for found in _looked(target, data, estimands, jnp.asarray(rows)))
        # What is said of a node holds while its neighbours stay.
        for which in np.argsort(-gains):
            if gains[which] <= GAIN:
                break
            u = estimands["u_boundary"].at[rows[which]].set(places[which])
            there = {**estimands, "u_boundary": u}
            if _height(target, target.data, there) > _height(target, target.data, estimands) + GAIN:
                estimands = there
                moved.append(int(rows[which]))
    position = target.unconstrain_of(target.data, estimands)
    return np.asarray(ravel_pytree(position)[0]) if moved else flat, np.array(sorted(moved), int)


@partial(jax.jit, static_argnums=0)
def _looked(target: SmoothTarget, data: Any, estimands: Estimands, rows: Int[AnyArray, "k"]) -> tuple[Any, Any]:
    """Of every node the highest place that was seen, and by how much it is higher, approximately."""

    def of_node(asked: tuple[AnyArray, AnyArray]) -> tuple[AnyArray, AnyArray]:
        which, row = asked
        here, rest = estimands["u_boundary"][row], target.place_of_rest(data, estimands, which)
        width = jnp.linalg.norm(rest - here) / 2.0 ** (jnp.arange(PLACES) % HALVES)
        spread = jax.random.normal(jax.random.fold_in(jax.random.key(0), row), (PLACES, 3))
        places = jnp.concatenate([here[None], rest + width[:, None] * spread])
        heights = jax.lax.map(target.local_logdensity(data, estimands, which), places)
        heights = jnp.nan_to_num(heights, nan=-jnp.inf)
        best = heights.argmax()
        return heights[best] - heights[0], places[best]

    return jax.lax.map(of_node, (jnp.arange(len(rows)), rows))


@partial(jax.jit, static_argnums=0)
def _height(target: SmoothTarget, data: Any, estimands: Estimands) -> AnyArray:
    return target.logdensity_of(data, target.unconstrain_of(data, estimands))
