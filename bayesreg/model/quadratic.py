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

    def log(self, u: Float[AnyArray, "unknowns"]) -> Scalar:
        """Return −½ |E u − y|²."""
        return -0.5 * ((self.root @ u[self.unknowns] - self.shift) ** 2).sum()

    def among(self, unknowns: Int[np.ndarray, "t"]) -> Quadratic:
        """Return the same factor with the places of its unknowns among these, which are sorted, for their numbers."""
        return self._replace(unknowns=np.searchsorted(unknowns, self.unknowns))

    def interpolation(self, unknowns: int) -> Float[np.ndarray, "rows unknowns"]:
        """Return E with a column for every unknown."""
        whole = np.zeros((len(self.shift), unknowns))
        whole[:, np.asarray(self.unknowns)] = np.asarray(self.root)
        return whole


def approximate_about(term: Any, places: Float[np.ndarray, "places nodes 3"], values: Values) -> Quadratic:
    """Return the Gaussian that has a term's mean slope and mean curvature over several displacements.

    It has no rows for directions along which it hardly changes: those along a surface.
    """
    factors = [approximate(term, u, values) for u in places]
    unknowns = np.unique(np.concatenate([factor.unknowns for factor in factors]))
    curvature, slope = np.zeros((len(unknowns),) * 2), np.zeros(len(unknowns))
    for factor in factors:
        own = np.searchsorted(unknowns, factor.unknowns)
        curvature[np.ix_(own, own)] += factor.root.T @ factor.root / len(places)
        slope[own] += factor.root.T @ factor.shift / len(places)
    squares, directions = np.linalg.eigh(curvature)
    kept = squares > LEAST_SHARE * squares[-1]
    sizes, directions = np.sqrt(squares[kept]), directions[:, kept]
    return Quadratic(unknowns, sizes[:, None] * directions.T, directions.T @ slope / sizes)


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
