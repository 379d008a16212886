"""A Gaussian factor that stands for an observation near one displacement."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayesreg.model.blocks import Values
from bayesreg.types import AnyArray, Scalar

# Directions of one point, and of all points, with less than these shares of the greatest curvature are left out.
LEAST_CURVATURE, LEAST_SHARE = 1e-10, 1e-5


class Quadratic(NamedTuple):
    """exp(−½ |E u − y|²), where u has some unknowns of the nodes (a pytree).

    Attributes
    ----------
    unknowns : (t,) int array
        3 · node + axis.
    root : (r, t) array
        E.
    shift : (r,) array
        y.
    """

    unknowns: Int[AnyArray, "touched"]
    root: Float[AnyArray, "rows touched"]
    shift: Float[AnyArray, "rows"]

    def log(self, u: Float[AnyArray, "nodes 3"]) -> Scalar:
        """Return −½ |E u − y|²."""
        return -0.5 * ((self.root @ u.reshape(-1)[self.unknowns] - self.shift) ** 2).sum()

    def without_flat_directions(self) -> Quadratic:
        """Return fewer rows, without directions along which the factor hardly changes: those along a surface."""
        left, sizes, right = np.linalg.svd(self.root, full_matrices=False)
        kept = sizes**2 > LEAST_SHARE * sizes[0] ** 2
        shift = left[:, kept].T @ self.shift
        return self._replace(root=sizes[kept, None] * right[kept], shift=shift)

    def interpolation(self, unknowns: int) -> Float[np.ndarray, "rows unknowns"]:
        """Return E with a column for every unknown."""
        whole = np.zeros((len(self.shift), unknowns))
        whole[:, np.asarray(self.unknowns)] = np.asarray(self.root)
        return whole


def approximate_about(term: Any, places: Float[np.ndarray, "places nodes 3"], values: Values) -> Quadratic:
    """Return the Gaussian that has a term's mean slope and mean curvature over several displacements."""
    factors = [approximate(term, u, values) for u in places]
    unknowns = np.unique(np.concatenate([factor.unknowns for factor in factors]))
    root = np.concatenate([factor.interpolation(places[0].size)[:, unknowns] for factor in factors])
    shift = np.concatenate([factor.shift for factor in factors])
    scale = 1 / np.sqrt(len(places))
    return Quadratic(unknowns, scale * root, scale * shift).without_flat_directions()


def approximate(term: Any, u: Float[np.ndarray, "nodes 3"], values: Values) -> Quadratic:
    """Return the Gaussian that has a term's slope and Gauss–Newton curvature at a displacement.

    Parameters
    ----------
    term : ComparedPoints or MeasuredSurface
    u : (n, 3) array
        mm.
    values : mapping
        Values of all blocks.
    """
    own_values = {name: values[name] for name in term.hyperparameters}
    nodes, weights, matrices, scores = map(np.asarray, _slope_and_curvature(term, jnp.asarray(u), own_values))
    squares, axes = np.linalg.eigh(matrices)
    kept = squares > LEAST_CURVATURE * squares.max()
    point, axis = np.nonzero(kept)
    stiffness, directions = np.sqrt(squares[kept]), axes[point, :, axis]
    columns = 3 * nodes[point][:, :, None] + np.arange(3)
    unknowns, index = np.unique(columns, return_inverse=True)
    rows = np.zeros((len(point), len(unknowns)))
    entries = stiffness[:, None, None] * weights[point][:, :, None] * directions[:, None, :]
    # The nodes of a place on the surface of a mesh are three and one of them again.
    np.add.at(rows, (np.arange(len(point))[:, None, None], index.reshape(columns.shape)), entries)
    push = (scores[point] * directions).sum(axis=1) / stiffness
    return Quadratic(unknowns, rows, rows @ u.ravel()[unknowns] + push)


@jax.jit
def _slope_and_curvature(term: Any, u: AnyArray, values: Values) -> tuple[AnyArray, ...]:
    curvature = term.gauss_newton(u, values)
    return curvature.nodes, curvature.weights, curvature.matrices, term.score(u, values)
