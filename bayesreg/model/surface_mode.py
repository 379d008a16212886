"""The mode of a posterior with points and surfaces alone, by repeated Gaussian approximations.

Each step replaces every observation by the Gaussian that it has at the last displacement (`Quadratic`), takes the
scales of the loads and of the errors that maximise the evidence, and then the mean displacement. The stiffness stays at
its reference. For Student's t and a flat surface, the steps are those of iteratively reweighted least squares.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float
from scipy.optimize import minimize

from bayesreg.fem.elasticity import stiffness
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Values
from bayesreg.model.coordinates import complete, reference_values
from bayesreg.model.observations.observation import Correlated
from bayesreg.model.program import Problem
from bayesreg.model.quadratic import approximate
from bayesreg.model.state import state_of
from bayesreg.types import Scalar

# The search ends where no node moves further than this, mm, or after so many steps.
SETTLED, MOST_STEPS = 0.05, 25
# Before so many steps, the residuals are still those of the motion, and all points count.
FREE_STEPS = 3
# Evaluations of the evidence in one step, which need not find its maximum exactly.
EVALUATIONS = 40
# The sd of each rigid motion that stands for a flat prior, mm.
WIDE = 1e3


class Mode(NamedTuple):
    """The displacement and the scales of the greatest evidence.

    Attributes
    ----------
    problem : Problem
        With the counted numbers of independent points.
    values : dict
        Values of all blocks, the displacements included.
    """

    problem: Problem
    values: dict[str, Any]


def find_mode(
    problem: Problem, mesh: TetMesh, observations: Mapping[str, Any] | None = None, start: Values | None = None
) -> Mode:
    """Find the mode of a posterior of points and surfaces.

    Parameters
    ----------
    problem : Problem
        With random loads.
    mesh : TetMesh
    observations : mapping, optional
        Those whose independent points are to be counted on the way, by name.
    start : mapping, optional
        Estimands to begin with.
    """
    values = reference_values(problem.blocks) if start is None else complete(problem.blocks, start)
    values = {name: np.asarray(value) for name, value in values.items()}
    solver = _Solver(problem, mesh, values)
    correlated = {name: each for name, each in (observations or {}).items() if isinstance(each, Correlated)}
    for number in range(MOST_STEPS):
        gaussian = _Step(solver, problem, values["u_boundary"], values)
        values = {**values, **_best_scales(gaussian, {name: float(values[name]) for name in _scales(problem)})}
        u, last = gaussian.mean(values), values["u_boundary"]
        values = {**values, "u_boundary": u}
        if correlated and number + 1 < FREE_STEPS:
            continue
        for name, observation in correlated.items():
            term = problem.terms[name]
            count = observation.count_independent_points(term, u, values)
            problem = problem.with_term(name, term.with_independent_points(count))
        if np.abs(u - last).max() < SETTLED:
            break
    return Mode(problem, values)


def draw_about_mode(problem: Problem, mesh: TetMesh, mode: Mode, count: int) -> Float[np.ndarray, "count nodes 3"]:
    """Draw displacements from the Gaussian at a mode, at its scales, mm."""
    gaussian = _Step(_Solver(problem, mesh, mode.values), problem, mode.values["u_boundary"], mode.values)
    return gaussian.draw(mode.values, count)


def _best_scales(gaussian: _Step, start: dict[str, float]) -> dict[str, float]:
    """Return scales of a greater evidence, nearly the greatest."""
    if not start:
        return {}

    def scales(logs: np.ndarray) -> dict[str, float]:
        return dict(zip(start, np.exp(logs), strict=True))

    options = {"maxfev": EVALUATIONS, "xatol": 0.02, "fatol": 0.05}
    logs = np.log(list(start.values()))
    found = minimize(lambda logs: -gaussian.log_evidence(scales(logs)), logs, method="Nelder-Mead", options=options)
    return scales(found.x)


def observed_terms(problem: Problem) -> list[Any]:
    """Return the terms of points and surfaces: those with a slope for each point."""
    return [term for term in problem.terms.values() if hasattr(term, "score")]


def _scales(problem: Problem) -> list[str]:
    """Return the names of the sampled scales of loads and errors."""
    names = [name for term in problem.terms.values() for name in getattr(term, "hyperparameters", ())]
    return [name for name in names if problem.blocks[name].is_sampled]


class _Solver:
    """The Gaussian of the displacements at the reference stiffness."""

    def __init__(self, problem: Problem, mesh: TetMesh, values: Values) -> None:
        elastic = problem.terms["elastic"]
        self.rigid = np.asarray(elastic.rigid)
        self.masses = elastic.masses
        prior = problem.terms.get("rigid")
        # A flat prior of the rigid motion is the limit of a wide one.
        self.rigid_root = np.sqrt(len(mesh.points)) * (WIDE if prior is None else float(prior.sd)) * self.rigid
        K = stiffness(mesh, *(np.asarray(by_cell) for by_cell in problem.body.lame_by_cell(values))).toarray()
        # K⁺ of balanced loads: the rigid motions get a stiffness of their own.
        self._factor = scipy.linalg.cho_factor(K + np.diag(K).mean() * self.rigid @ self.rigid.T)

    def respond(self, loads: Float[np.ndarray, "unknowns columns"]) -> Float[np.ndarray, "unknowns columns"]:
        """Return K⁺ times loads."""
        u = scipy.linalg.cho_solve(self._factor, loads - self.rigid @ (self.rigid.T @ loads))
        return u - self.rigid @ (self.rigid.T @ u)


class _Step:
    """The Gaussian approximation at one displacement, for all scales."""

    def __init__(self, solver: _Solver, problem: Problem, u: Float[np.ndarray, "nodes 3"], values: Values) -> None:
        self._solver, self._problem, self._u, self._values = solver, problem, u, values
        touched = [np.asarray(approximate(term, u, values).unknowns) for term in observed_terms(problem)]
        self._touched = np.unique(np.concatenate(touched))
        self._response = solver.respond(np.eye(u.size)[:, self._touched])
        self._squares = [self._response.T @ (mass[:, None] * self._response) for mass in solver.masses]

    def log_evidence(self, scales: dict[str, Any]) -> float:
        """Compute the log of the evidence of some scales, up to a constant.

        C is the covariance of the touched unknowns; J and J v are the curvature and the slope of the Gaussians of all
        observations. It is −½ log det(1 + C J) + ½ (J v)ᵀ (1 + C J)⁻¹ C J v, and what the observations have beyond
        their Gaussians, at u.
        """
        values = {**self._values, **scales}
        push, balance = self._balance(values)
        C = sum(size * square for size, square in zip(_sizes(values), self._squares, strict=True))
        rigid = self._solver.rigid_root[self._touched]
        C = C - push.T @ np.linalg.solve(balance, push) + rigid @ rigid.T
        E, y = self._rows(values)
        J, slope = E.T @ E, E.T @ y
        M = np.eye(len(C)) + C @ J
        beyond = ((E @ self._u.ravel()[self._touched] - y) ** 2).sum() / 2 - y @ y / 2
        log = -np.linalg.slogdet(M)[1] / 2 + slope @ np.linalg.solve(M, C @ slope) / 2 + beyond
        return float(log + _log_terms(self._problem, scales, {**values, "u_boundary": self._u}))

    def mean(self, values: Values) -> Float[np.ndarray, "nodes 3"]:
        """Compute the mean displacement, mm."""
        E, y = self._rows(values)
        return self._response_to(E, y[:, None], values).reshape(-1, 3)

    def draw(self, values: Values, count: int) -> Float[np.ndarray, "count nodes 3"]:
        """Draw displacements, mm: those of the prior, corrected by their difference from what is observed."""
        rng, (E, y) = np.random.default_rng(0), self._rows(values)
        variances, (_, balance) = _sizes(values) @ self._solver.masses, self._balance(values)
        load = np.sqrt(variances)[:, None] * rng.normal(size=(self._u.size, count))
        DR = variances[:, None] * self._solver.rigid
        load -= DR @ np.linalg.solve(balance, self._solver.rigid.T @ load)
        u = self._solver.respond(load) + self._solver.rigid_root @ rng.normal(size=(6, count))
        apart = y[:, None] - E @ u[self._touched] - rng.normal(size=(len(y), count))
        return (u + self._response_to(E, apart, values)).T.reshape(count, -1, 3)

    def _response_to(
        self, E: Float[np.ndarray, "rows touched"], shifts: Float[np.ndarray, "rows columns"], values: Values
    ) -> Float[np.ndarray, "unknowns columns"]:
        """Return the mean displacement of a prior of mean zero, given what E u is observed to be."""
        push, balance = self._balance(values)
        variances = _sizes(values) @ self._solver.masses
        load = variances[:, None] * (self._response - self._solver.rigid @ np.linalg.solve(balance, push))
        rigid = self._solver.rigid_root
        covariance = self._solver.respond(load) + rigid @ rigid[self._touched].T
        M = np.eye(len(self._touched)) + E.T @ E @ covariance[self._touched]
        return covariance @ np.linalg.solve(M, E.T @ shifts)

    def _rows(self, values: Values) -> tuple[Float[np.ndarray, "rows touched"], Float[np.ndarray, "rows"]]:
        factors = [approximate(term, self._u, values) for term in observed_terms(self._problem)]
        rows = [factor.interpolation(self._u.size)[:, self._touched] for factor in factors]
        return np.concatenate(rows), np.concatenate([np.asarray(factor.shift) for factor in factors])

    def _balance(self, values: Values) -> tuple[Float[np.ndarray, "6 touched"], Float[np.ndarray, "6 6"]]:
        """Return Rᵀ D G and Rᵀ D R."""
        DR = (_sizes(values) @ self._solver.masses)[:, None] * self._solver.rigid
        return DR.T @ self._response, self._solver.rigid.T @ DR


@jax.jit
def _log_terms(problem: Problem, scales: dict[str, Any], values: dict[str, Any]) -> Scalar:
    """Compute the logs of the observations, and of the priors of some scales by their logarithms."""
    state = state_of(problem.body, problem.blocks, values)
    priors = (problem.blocks[name].prior().log_prob(scale) + jnp.log(scale) for name, scale in scales.items())
    return sum((term.log(state) for term in observed_terms(problem)), jnp.zeros(())) + sum(priors)


def _sizes(values: Values) -> Float[np.ndarray, "2"]:
    return np.array([float(values["body_load"]) ** 2, float(values["surface_load"]) ** 2])
