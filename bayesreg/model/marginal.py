"""The posterior of pairs of points alone with the displacements integrated out, for one tissue and random loads."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayesreg.mesh import TetMesh
from bayesreg.model import evaluation, point_algebra
from bayesreg.model.blocks import Values
from bayesreg.model.coordinates import complete
from bayesreg.model.elastic.barrier import Barrier
from bayesreg.model.elastic.loads import LoadsTerm
from bayesreg.model.observations.compared_points import ComparedPoints
from bayesreg.model.point_algebra import PointAlgebra
from bayesreg.model.program import Problem
from bayesreg.model.state import state_of
from bayesreg.types import AnyArray, Scalar

# The eigenvectors of more unknowns take minutes, and the matrices of more coordinates of points a gigabyte.
MOST_UNKNOWNS, MOST_COORDINATES = 5000, 1500


class Marginal(NamedTuple):
    """The posterior with the displacements integrated out (a pytree); see `bayesreg.inference.target.Marginal`.

    Attributes
    ----------
    problem : Problem
        The posterior's own, with the determinant of K from its eigenvalues.
    number : scalar integer
        That of its `PointAlgebra`.
    """

    problem: Problem
    number: Int[AnyArray, ""]

    def draw_weights(self, key: AnyArray, estimands: Values) -> tuple[Float[AnyArray, "points"], dict[str, AnyArray]]:
        """Draw the weight τ of every point given all estimands, and the sd of points with their weights.

        Returns
        -------
        weights : (k,) array
            One for Normal errors.
        estimands : dict
            With other sds of points.
        """
        values, drawn = complete(self.problem.blocks, estimands), []
        points = points_of(self.problem)
        for term, key_term in zip(points, jax.random.split(key, len(points)), strict=True):
            weights, scales = term.draw_weights(key_term, values, self.problem.blocks)
            values = {**values, **scales}
            drawn.append(weights)
        return jnp.concatenate(drawn), {**estimands, **{name: values[name] for name in estimands}}

    def log(self, estimands: Values, weights: Float[AnyArray, "points"]) -> Scalar:
        """Compute log p(y, θ | τ) up to a constant; the displacements of the estimands have no effect."""
        values = complete(self.problem.blocks, estimands)
        prior = evaluation.evaluate(self.problem._replace(terms={}), values).logdensity
        log = prior + point_algebra.log_density(self.number, *self.given(values, weights))
        return jnp.where(jnp.isnan(log), -jnp.inf, log)

    def draw_displacements(
        self, key: AnyArray, estimands: Values, weights: Float[AnyArray, "points"]
    ) -> Float[AnyArray, "nodes 3"]:
        """Draw u given θ and τ, mm."""
        values = complete(self.problem.blocks, estimands)
        lam, sizes, noise = self.given(values, weights)
        key_load, key_error = jax.random.split(key)
        white = jax.random.normal(key_load, (values["u_boundary"].size,))
        errors = jax.random.normal(key_error, noise.shape)
        return point_algebra.draw(self.number, lam, sizes, noise, white, errors).reshape(-1, 3)

    def log_others(self, estimands: Values) -> Scalar:
        """Compute the sum of the logs of all terms that are not Gaussian in u: the barrier."""
        values = complete(self.problem.blocks, estimands)
        state = state_of(self.problem.body, self.problem.blocks, values)
        others = (term for term in self.problem.terms.values() if not isinstance(term, LoadsTerm | ComparedPoints))
        return sum((term.log(state) for term in others), jnp.zeros(()))

    def given(self, values: Values, weights: AnyArray) -> tuple[Scalar, AnyArray, AnyArray]:
        """Return λ, the squared sizes of the loads, and the variances of the errors of all coordinates."""
        sd = jnp.concatenate([term.sd(values) for term in points_of(self.problem)])
        sizes = jnp.stack([values["body_load"] ** 2, values["surface_load"] ** 2])
        return values["lam"][0], sizes, (sd**2 / weights[:, None]).reshape(-1)


@dataclass(frozen=True, eq=False)
class Marginalisation:
    """A posterior whose displacements can be integrated out; its algebra is prepared at the first call.

    Attributes
    ----------
    problem : Problem
    mesh : TetMesh
    """

    problem: Problem
    mesh: TetMesh
    _lock: Lock = field(default_factory=Lock)

    @classmethod
    def of(cls, problem: Problem, mesh: TetMesh) -> Marginalisation | None:
        """Return that of a posterior; None if it has other terms, several tissues, an unknown μ, or is too large."""
        points = points_of(problem)
        known_terms = all(isinstance(term, LoadsTerm | ComparedPoints | Barrier) for term in problem.terms.values())
        if not (points and known_terms and "elastic" in problem.terms) or problem.body.field is not None:
            return None
        one_tissue = np.shape(problem.blocks["lam"].reference()) == (1,) and not problem.blocks["mu"].is_sampled
        is_small = 3 * len(mesh.points) <= MOST_UNKNOWNS
        is_small &= 3 * sum(len(term.shift) for term in points) <= MOST_COORDINATES
        return cls(problem, mesh) if one_tissue and is_small and np.isfinite(_range_of_lam(problem)[1]) else None

    def __call__(self) -> Marginal:
        """Return the marginal; several threads may ask for it."""
        with self._lock:
            elastic = self.problem.terms["elastic"]._replace(determinant=self._algebra.spectrum)
            return Marginal(self.problem.with_term("elastic", elastic), jnp.asarray(self._algebra.number))

    @cached_property
    def _algebra(self) -> PointAlgebra:
        points, unknowns = points_of(self.problem), 3 * len(self.mesh.points)
        identity = jnp.eye(unknowns).reshape(-1, 3, unknowns)
        interpolation = np.concatenate([np.asarray(term.interpolate(identity)) for term in points])
        return PointAlgebra(
            self.mesh,
            self.problem.terms["elastic"],
            interpolation.reshape(-1, unknowns),
            np.concatenate([np.asarray(term.shift) for term in points]).ravel(),
            float(np.asarray(self.problem.blocks["mu"].reference())[0]),
            _range_of_lam(self.problem),
        )


def points_of(problem: Problem) -> list[ComparedPoints]:
    """Return the terms of pairs of points."""
    return [term for term in problem.terms.values() if isinstance(term, ComparedPoints)]


def _range_of_lam(problem: Problem) -> tuple[float, float]:
    """Return the least and the greatest λ that its prior allows; both are the known one."""
    block = problem.blocks["lam"]
    low, high = (block.low, block.high) if block.is_sampled else (block.reference(),) * 2
    return float(np.asarray(low)[0]), float(np.asarray(high)[0])
