"""Pockets: local maxima of the density in the displacement of a single node, where a search for the mode may leave it.

A node that few elements hold may be caught where the blurred images of a search's first stages match by chance. It
stays there, and the chains with it: between that place and the one where it belongs, millimetres away, the density is
next to nothing, and no curvature in the pocket hints at the other. Elasticity does. For every node, while all others
stay, places are looked at about its elastic equilibrium.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayesreg.inference.gaussian.density import height_and_slope
from bayesreg.inference.layout import displacements, node_count, unravel
from bayesreg.inference.target import Estimands, Target, estimands_of, without_normaliser
from bayesreg.types import AnyArray

# Places for a node: Normal about its equilibrium, with its distance from there, 1/2, 1/4, 1/8 and 1/16 of it as
# standard deviations.
PLACES, WIDTHS = 240, 5
# A node is moved where the density is higher by this factor, log.
GAIN = 5.0
# Nodes that are looked at together: how the nodes near any of them follow all sampled ones is one dense matrix.
AT_A_TIME = 512


def leave_pockets(
    target: Target, flat: Float[np.ndarray, "dimension"]
) -> tuple[Float[np.ndarray, "dimension"], Int[np.ndarray, "moved"]]:
    """Move single nodes to where the density is far higher.

    Parameters
    ----------
    target : Target
        One that knows no densities of single nodes is left alone.
    flat : (d,) array
        Flat position, a local maximum.

    Returns
    -------
    flat : (d,) array
        With these nodes elsewhere.
    nodes : (moved,) int array
        Their rows of "u_boundary".
    """
    count, moved = node_count(target), []
    # The normaliser is the same for all displacements.
    data = without_normaliser(target, target.data)
    estimands = estimands_of(target, data, unravel(target)(jnp.asarray(flat)))
    for first in range(0, 0 if target.single_nodes is None else count, AT_A_TIME):
        rows = np.arange(first, min(first + AT_A_TIME, count))
        near = target.condition(estimands, rows, quick=True)
        gains, places = (np.asarray(found) for found in _look(target, near, estimands, jnp.asarray(rows)))
        # Approximate, and said of a node while all others stay: the density itself decides, one node after the other.
        for which in (candidate for candidate in np.argsort(-gains) if gains[candidate] > GAIN):
            there, at = flat.copy(), displacements(target).start + 3 * rows[which]
            there[at : at + 3] = places[which]
            if height_and_slope(target, data, there)[0] > height_and_slope(target, data, flat)[0] + GAIN:
                flat = there
                moved.append(rows[which])
    return flat, np.array(sorted(moved), int)


@partial(jax.jit, static_argnums=0)
def _look(target: Target, data: Any, estimands: Estimands, rows: Int[AnyArray, "k"]) -> tuple[Any, Any]:
    """The highest place that was seen for every node, and by how much it is higher, approximately."""

    assert target.single_nodes is not None
    single_nodes = target.single_nodes

    def of_node(asked: tuple[AnyArray, AnyArray]) -> tuple[AnyArray, AnyArray]:
        which, row = asked
        here, rest = estimands["u_boundary"][row], single_nodes.equilibrium(data, estimands, which)
        width = jnp.linalg.norm(rest - here) / 2.0 ** (jnp.arange(PLACES) % WIDTHS)
        about = jax.random.normal(jax.random.fold_in(jax.random.key(0), row), (PLACES, 3))
        places = jnp.concatenate([here[None], rest[None], rest + width[:, None] * about])
        heights = jax.vmap(single_nodes.log_density(data, estimands, which))(places)
        heights = jnp.where(jnp.isnan(heights), -jnp.inf, heights)
        best = heights.argmax()
        return heights[best] - heights[0], places[best]

    return jax.lax.map(of_node, (jnp.arange(len(rows)), rows))
