"""The posterior of points and surfaces alone with the displacements integrated out, for random loads.

Pairs of points are Gaussian in the displacements, given a weight for every point. A surface is nearly so, and depends
on few unknowns of the nodes: those that it touches. A Gaussian that has its slope and curvature near the mode
(`bayesreg.model.quadratic`) stands for it where displacements are integrated out. Given the touched unknowns v and all
else, the displacements are exactly Gaussian.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayesreg.mesh import TetMesh
from bayesreg.model import evaluation, point_algebra
from bayesreg.model.blocks import LAME, Values
from bayesreg.model.coordinates import complete
from bayesreg.model.elastic.barrier import Barrier
from bayesreg.model.elastic.loads import LoadsTerm
from bayesreg.model.elastic.rigid import RigidPrior
from bayesreg.model.factorised_response import FactorisedResponse
from bayesreg.model.observations.compared_points import ComparedPoints
from bayesreg.model.observations.measured_surface import MeasuredSurface
from bayesreg.model.point_algebra import PointAlgebra, ResponseDeterminant
from bayesreg.model.point_gaussian import LEAST_VARIANCE, TouchedGaussian
from bayesreg.model.program import Problem
from bayesreg.model.quadratic import Quadratic, approximate_about
from bayesreg.model.spectral_response import SpectralResponse
from bayesreg.model.state import state_of
from bayesreg.model.stiffness_parts import has_few_entries
from bayesreg.model.surface_mode import Mode, draw_about_mode, find_mode
from bayesreg.types import AnyArray, Scalar

# The matrices of more unknowns take minutes, and those of more coordinates of points a gigabyte.
MOST_UNKNOWNS, MOST_COORDINATES = 5000, 1500
# A draw with more coordinates than this takes a part of a second.
MANY_COORDINATES = 600
# The number of displacements about the mode over which a surface's slope and curvature are averaged.
PLACES = 16
# The terms that are Gaussian in the displacements, and those that may stand beside them.
GAUSSIAN, BESIDE = LoadsTerm | RigidPrior | ComparedPoints, MeasuredSurface | Barrier


class Marginal(NamedTuple):
    """The posterior with the displacements integrated out (a pytree); see `bayesreg.inference.target.Marginal`.

    Attributes
    ----------
    problem : Problem
        The posterior's own, with the determinant of K from its eigenvalues.
    number : scalar integer
        That of its `PointAlgebra`.
    approximations : dict
        The Gaussian of v that stands for each surface, by name.
    restricted : dict
        The term of each surface on the touched nodes alone, by name.
    touched_nodes : (t,) int array
        The nodes whose unknowns surfaces touch; none without surfaces.
    """

    problem: Problem
    number: Int[AnyArray, ""]
    approximations: dict[str, Quadratic]
    restricted: dict[str, MeasuredSurface]
    touched_nodes: Int[AnyArray, "touched"]

    @property
    def costly(self) -> tuple[str, ...]:
        """The names of the parameters whose change costs a factorisation."""
        return () if has_one_tissue(self.problem) else LAME

    @property
    def drawn(self) -> tuple[str, ...]:
        """The names of the parameters that `draw_weights` draws, and that the Gaussians do not depend on."""
        return tuple(name for term in surfaces_of(self.problem) for name in term.hyperparameters)

    def draw_weights(self, key: AnyArray, estimands: Values) -> tuple[Float[AnyArray, "points"], dict[str, AnyArray]]:
        """Draw the weight τ of every point given all estimands, and the sds of points and surfaces.

        Returns
        -------
        weights : (k,) array
            One for Normal errors.
        estimands : dict
            With other sds of points.
        """
        blocks, drawn = self.problem.blocks, [jnp.zeros(0)]
        scales: dict[str, AnyArray] = {}
        values, points, surfaces = complete(blocks, estimands), points_of(self.problem), surfaces_of(self.problem)
        keys = jax.random.split(key, len(points) + len(surfaces))
        for term, key_term in zip(points, keys[: len(points)], strict=True):
            weights, term_scales = term.draw_weights(key_term, values, blocks)
            drawn.append(weights)
            scales |= term_scales
        for surface, key_surface in zip(surfaces, keys[len(points) :], strict=True):
            scales |= surface.draw_sd(key_surface, values, blocks)
        return jnp.concatenate(drawn), {**estimands, **scales}

    def log(self, estimands: Values, weights: Float[AnyArray, "points"]) -> Scalar:
        """Compute log p(y, θ | τ) up to a constant; the displacements of the estimands have no effect."""
        values = complete(self.problem.blocks, estimands)
        prior = evaluation.evaluate(self.problem._replace(terms={}), values).logdensity
        log = prior + point_algebra.log_density(self.number, *self.given(values, weights))
        return jnp.where(jnp.isnan(log), -jnp.inf, log)

    def draw_displacements(
        self,
        key: AnyArray,
        estimands: Values,
        weights: Float[AnyArray, "points"],
        v: Float[AnyArray, "touched"] | None = None,
    ) -> Float[AnyArray, "nodes 3"]:
        """Draw u given θ and τ, mm, and given v in place of the Gaussians of surfaces if it is there."""
        values = complete(self.problem.blocks, estimands)
        given, unknowns = self.given(values, weights), values["u_boundary"].size
        return point_algebra.draw(self.number, *given, jnp.zeros(0) if v is None else v, key, unknowns).reshape(-1, 3)

    def draw_touched(self, key: AnyArray, estimands: Values) -> Float[AnyArray, "touched"]:
        """Draw v given the displacements, mm: the touched unknowns up to a micrometre."""
        u = estimands["u_boundary"][self.touched_nodes].reshape(-1)
        return u + math.sqrt(LEAST_VARIANCE) * jax.random.normal(key, u.shape)

    def touched(self, estimands: Values, weights: Float[AnyArray, "points"]) -> TouchedGaussian:
        """Compute the Gaussian of v given θ and τ, and log p(y, θ | τ) up to a constant, as `log` does."""
        values = complete(self.problem.blocks, estimands)
        prior = evaluation.evaluate(self.problem._replace(terms={}), values).logdensity
        count = 3 * len(self.touched_nodes)
        gaussian = point_algebra.touched_given(self.number, *self.given(values, weights), count)
        log = prior + gaussian.log
        return gaussian._replace(log=jnp.where(jnp.isnan(log), -jnp.inf, log))

    def log_surfaces(self, estimands: Values, v: Float[AnyArray, "touched"]) -> Scalar:
        """Compute the log of the surfaces as functions of v."""
        values, u = complete(self.problem.blocks, estimands), v.reshape(-1, 3)
        return sum((term.log_at(u, values) for term in self.restricted.values()), jnp.zeros(()))

    def log_approximations(self, v: Float[AnyArray, "touched"]) -> Scalar:
        """Compute the log of the Gaussians that stand for the surfaces."""
        return sum((quadratic.log(v) for quadratic in self.approximations.values()), jnp.zeros(()))

    def log_others(self, estimands: Values) -> Scalar:
        """Compute the log of the terms that are not Gaussian in the displacements: the barrier, and the surfaces."""
        values = complete(self.problem.blocks, estimands)
        state = state_of(self.problem.body, self.problem.blocks, values)
        others = (term for term in self.problem.terms.values() if not isinstance(term, GAUSSIAN))
        return sum((term.log(state) for term in others), jnp.zeros(()))

    def given(self, values: Values, weights: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return λ and μ of all entries, the squared sizes of the loads, and the variances of all coordinates."""
        sd = jnp.concatenate([jnp.zeros((0, 3)), *(term.sd(values) for term in points_of(self.problem))])
        sizes = jnp.stack([values["body_load"] ** 2, values["surface_load"] ** 2])
        # The rows of an approximation have the variance one.
        rows = sum(len(quadratic.shift) for quadratic in self.approximations.values())
        noise = jnp.concatenate([(sd**2 / weights[:, None]).reshape(-1), jnp.ones(rows)])
        return jnp.concatenate([values[name] for name in LAME]), sizes, noise


@dataclass(frozen=True, eq=False)
class Marginalisation:
    """A posterior whose displacements can be integrated out; its algebra is prepared at the first call.

    Attributes
    ----------
    problem : Problem
    mesh : TetMesh
    start : mapping or None
        Estimands at the mode, if an earlier search has found it.
    """

    problem: Problem
    mesh: TetMesh
    start: Values | None = None
    _lock: Lock = field(default_factory=Lock)

    @classmethod
    def of(cls, problem: Problem, mesh: TetMesh, start: Values | None = None) -> Marginalisation | None:
        """Return that of a posterior; None if it has other terms, a stiffness in many entries, or is too large."""
        points, surfaces = points_of(problem), surfaces_of(problem)
        known_terms = all(isinstance(term, GAUSSIAN | BESIDE) for term in problem.terms.values())
        if not ((points or surfaces) and known_terms and "elastic" in problem.terms):
            return None
        if problem.body.field is not None or not has_few_entries(problem.body):
            return None
        is_small = 3 * len(mesh.points) <= MOST_UNKNOWNS
        is_small &= 3 * _count_points(problem) <= MOST_COORDINATES
        is_bounded = all(np.isfinite(problem.blocks[name].bounds()).all() for name in LAME)
        return cls(problem, mesh, start) if is_small and is_bounded else None

    @property
    def is_costly(self) -> bool:
        """Whether each new stiffness costs a factorisation of K."""
        return not has_one_tissue(self.problem)

    @property
    def has_costly_draws(self) -> bool:
        """Whether a draw takes a part of a second: many points, surfaces, or a factorisation for each stiffness."""
        has_many_points = 3 * _count_points(self.problem) > MANY_COORDINATES
        return self.is_costly or has_many_points or bool(surfaces_of(self.problem))

    def __call__(self) -> Marginal:
        """Return the marginal; several threads may ask for it."""
        with self._lock:
            number, cells = self._algebra.number, np.unique(self.problem.body.cell_entry, return_index=True)[1]
            determinant = ResponseDeterminant(jnp.asarray(number), jnp.asarray(cells))
            elastic = self.problem.terms["elastic"]._replace(determinant=determinant)
            touched, terms = self._touched_nodes, {term.name: term for term in surfaces_of(self.problem)}
            approximations = {name: each.among(unknowns_of(touched)) for name, each in self._approximations.items()}
            restricted = {name: term.restricted_to(touched) for name, term in terms.items()}
            arrays = jax.tree.map(jnp.asarray, (approximations, restricted, touched))
            return Marginal(self.problem.with_term("elastic", elastic), determinant.number, *arrays)

    def count_independent_points(self, observations: Mapping[str, Any]) -> tuple[dict[str, float], dict[str, Any]]:
        """Count the independent points of surfaces, by name; return the counts, and all values at the mode."""
        mode = find_mode(self.problem, self.mesh, observations, self.start)
        counts = {term.name: float(term.independent_points) for term in surfaces_of(mode.problem)}
        return counts, mode.values

    @cached_property
    def _approximations(self) -> dict[str, Quadratic]:
        surfaces = surfaces_of(self.problem)
        if not surfaces:
            return {}
        if self.start is None:
            mode = find_mode(self.problem, self.mesh)
        else:
            mode = Mode(self.problem, jax.tree.map(np.asarray, complete(self.problem.blocks, self.start)))
        places = draw_about_mode(self.problem, self.mesh, mode, PLACES)
        return {term.name: approximate_about(term, places, mode.values) for term in surfaces}

    @cached_property
    def _touched_nodes(self) -> Int[np.ndarray, "touched"]:
        touched = [np.asarray(quadratic.unknowns) // 3 for quadratic in self._approximations.values()]
        return np.unique(np.concatenate([np.zeros(0, int), *touched]))

    @cached_property
    def _algebra(self) -> PointAlgebra:
        elastic, unknowns = self.problem.terms["elastic"], 3 * len(self.mesh.points)
        rigid, prior = np.asarray(elastic.rigid), self.problem.terms.get("rigid")
        precision = 0.0 if prior is None else 1 / (len(self.mesh.points) * float(prior.sd) ** 2)
        interpolation, shift = self._rows(unknowns)
        masses = elastic.masses
        response, points = self._response(rigid, masses, interpolation), 3 * _count_points(self.problem)
        return PointAlgebra(response, rigid, masses, precision, interpolation, shift, points)

    def _rows(self, unknowns: int) -> tuple[Float[np.ndarray, "rows unknowns"], Float[np.ndarray, "observed"]]:
        """Return B and y: coordinates of all points and rows of approximations; B has touched unknowns, too."""
        identity = jnp.eye(unknowns).reshape(-1, 3, unknowns)
        points, approximations = points_of(self.problem), self._approximations.values()
        rows = [np.asarray(term.interpolate(identity)).reshape(-1, unknowns) for term in points]
        rows += [quadratic.interpolation(unknowns) for quadratic in approximations]
        rows.append(np.eye(unknowns)[unknowns_of(self._touched_nodes)])
        shifts = [np.asarray(term.shift).ravel() for term in points]
        shifts += [np.asarray(quadratic.shift) for quadratic in approximations]
        return np.concatenate(rows), np.concatenate(shifts)

    def _response(
        self,
        rigid: Float[np.ndarray, "unknowns 6"],
        masses: Float[np.ndarray, "2 unknowns"],
        interpolation: Float[np.ndarray, "rows unknowns"],
    ) -> SpectralResponse | FactorisedResponse:
        if not has_one_tissue(self.problem):
            entries = np.asarray(self.problem.body.cell_entry)
            return FactorisedResponse(self.mesh, entries, rigid, masses, interpolation, point_algebra.side_by_side)
        mu = float(np.asarray(self.problem.blocks["mu"].reference())[0])
        return SpectralResponse(self.mesh, rigid, masses, interpolation, mu, self.problem.blocks["lam"].bounds())


def has_one_tissue(problem: Problem) -> bool:
    """Check whether there is one λ, and one μ that is known."""
    return np.shape(problem.blocks["lam"].reference()) == (1,) and not problem.blocks["mu"].is_sampled


def points_of(problem: Problem) -> list[ComparedPoints]:
    """Return the terms of pairs of points."""
    return [term for term in problem.terms.values() if isinstance(term, ComparedPoints)]


def surfaces_of(problem: Problem) -> list[MeasuredSurface]:
    """Return the terms of surfaces."""
    return [term for term in problem.terms.values() if isinstance(term, MeasuredSurface)]


def unknowns_of(nodes: Int[np.ndarray, "n"]) -> Int[np.ndarray, "unknowns"]:
    """Return 3 · node + axis of some nodes."""
    return (3 * nodes[:, None] + np.arange(3)).ravel()


def _count_points(problem: Problem) -> int:
    return sum(len(term.shift) for term in points_of(problem))
