"""How well do points of real patients predict a point that is left out, and is the predicted uncertainty right?

    BAYESREG_DATA=… python -m studies.benchmarks.points

RESECT's pairs of points, from pre-operative MRI to ultrasound before resection (Xiao et al. 2017), lie in the folder
`resect` of the folder that BAYESREG_DATA names. Each point of every patient is left out in turn and predicted from the
others: by the mean of their displacements, by a rigid fit, and by bayesreg's elastic body. The body is a box of
tetrahedra around the points, 10 mm wider; T_r and the sd of the points maximise the evidence of the others. The tables
show the mean error, the share of points in the predicted 50 % and 95 % regions, and the mean error of each patient.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from scipy import stats

import bayesreg as br
from bayesreg.io.point_formats import PointPairs
from bayesreg.io.points import read_point_pairs
from tests.phantoms import box_mesh

MARGIN, CELLS_PER_SIDE = 10.0, 4
# λ and μ are known: with one tissue only ν affects the displacements. The prior of the pose is wide.
LAM, MU, RIGID_SD = 10.0, 1.0, 50.0
TEMPERATURES, SDS = np.geomspace(0.1, 1e5, 25), np.geomspace(0.3, 5.0, 13)
LEVELS = (0.5, 0.95)


class Prediction(NamedTuple):
    """The error of the mean, mm, and the level of the region on whose border the point lies."""

    error: float
    level: float


# A method takes all pairs, and predicts each pair from the others.
Method = Callable[[PointPairs], list[Prediction]]


def mean_of_others(pairs: PointPairs) -> list[Prediction]:
    """Predict by the mean displacement, with Hotelling's region of Normal displacements."""
    u, predictions = pairs.moving - pairs.fixed, []
    for k in range(len(u)):
        others = np.delete(u, k, axis=0)
        away, n = u[k] - others.mean(axis=0), len(others)
        square = away @ np.linalg.solve(np.cov(others.T) * (1 + 1 / n), away)
        level = stats.f.cdf(square * (n - 3) / (3 * (n - 1)), 3, n - 3)
        predictions.append(Prediction(float(np.linalg.norm(away)), float(level)))
    return predictions


def rigid_fit_of_others(pairs: PointPairs) -> list[Prediction]:
    """Predict by the best rotation and shift (Kabsch), with isotropic errors and the first-order error of the fit."""
    predictions = []
    for k in range(len(pairs.fixed)):
        p, q = np.delete(pairs.fixed, k, axis=0), np.delete(pairs.moving, k, axis=0)
        U, _, Vt = np.linalg.svd((p - p.mean(axis=0)).T @ (q - q.mean(axis=0)))
        R = Vt.T @ np.diag([1, 1, np.linalg.det(Vt.T @ U.T)]) @ U.T
        residual = q - q.mean(axis=0) - (p - p.mean(axis=0)) @ R.T
        freedom = 3 * len(p) - 6
        variance = (residual**2).sum() / freedom
        design, left_out_design = (np.vstack([_motions(x) for x in points]) for points in (p, pairs.fixed[k : k + 1]))
        away = pairs.moving[k] - q.mean(axis=0) - R @ (pairs.fixed[k] - p.mean(axis=0))
        covariance = variance * (np.eye(3) + left_out_design @ np.linalg.solve(design.T @ design, left_out_design.T))
        level = stats.f.cdf(away @ np.linalg.solve(covariance, away) / 3, 3, freedom)
        predictions.append(Prediction(float(np.linalg.norm(away)), float(level)))
    return predictions


def _motions(x: np.ndarray) -> np.ndarray:
    """The displacements of a point by three shifts and three small rotations."""
    return np.column_stack([np.eye(3), *(np.cross(axis, x) for axis in np.eye(3))])


def elastic_body(pairs: PointPairs) -> list[Prediction]:
    """Predict by the Gaussian posterior of landmarks with known λ and μ; T_r and the sd maximise the evidence."""
    elastic, rigid = prior_covariances(pairs.fixed)
    u, predictions = pairs.moving - pairs.fixed, []
    for k in range(len(u)):
        others = np.delete(np.arange(len(u)), k)
        rows = (3 * others[:, None] + np.arange(3)).ravel()
        left_out_rows, y = 3 * k + np.arange(3), u[others].ravel()
        best = max(
            (_evidence(t * elastic[np.ix_(rows, rows)] + rigid[np.ix_(rows, rows)], sd, y), t, sd)
             for t in TEMPERATURES for sd in SDS
        )  # fmt: skip
        _, t, sd = best
        prior = t * elastic + rigid
        gain = np.linalg.solve(
            prior[np.ix_(rows, rows)] + sd**2 * np.eye(len(rows)), prior[np.ix_(rows, left_out_rows)]
        ).T
        away = u[k] - gain @ y
        covariance = (
            prior[np.ix_(left_out_rows, left_out_rows)] - gain @ prior[np.ix_(rows, left_out_rows)] + sd**2 * np.eye(3)
        )
        level = stats.chi2.cdf(away @ np.linalg.solve(covariance, away), 3)
        predictions.append(Prediction(float(np.linalg.norm(away)), float(level)))
    return predictions


def _evidence(covariance: np.ndarray, sd: float, y: np.ndarray) -> float:
    factor = np.linalg.cholesky(covariance + sd**2 * np.eye(len(y)))
    half = np.linalg.solve(factor, y)
    return float(-0.5 * half @ half - np.log(np.diag(factor)).sum())


def prior_covariances(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The covariances (3k, 3k) of points' displacements by the elastic prior at T_r = 1, and by the rigid prior."""
    low, high = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
    unit = box_mesh(CELLS_PER_SIDE, 1.0)
    mesh = br.TetMesh.from_arrays(unit.points * (high - low) + low, unit.cells, 0 * unit.tissue, ("tissue",))
    elastic, lame = br.Boltzmann(temperature=1.0), {"lam": LAM, "mu": MU}
    model = br.ModelConfig(elasticity="uniform", fixed=lame, elastic_prior=elastic, rigid_sd=RIGID_SD)
    marks = br.Landmarks(points, points, sd=1.0)
    posterior = br.build_posterior(mesh, [marks], model)
    data = posterior.data.without_term("landmarks")
    precision = posterior.target.mode_search.curvature(data, posterior.estimands(posterior.reference())).gauss_newton
    modes, term = np.asarray(data.terms["rigid"].modes), posterior.data.terms["landmarks"]

    def moved(u_boundary: jax.Array) -> jax.Array:
        u = posterior.target.evaluate_estimands(data, {"u_boundary": u_boundary}).u
        return (term.weights[:, :, None] * u[term.nodes]).sum(axis=1).ravel()

    J = np.asarray(jax.jacrev(moved)(posterior.reference()["u_boundary"])).reshape(3 * len(points), -1)
    covariance = J @ np.linalg.solve(precision, J.T)
    rigid = RIGID_SD**2 * len(modes) / 3 * (J @ modes) @ (J @ modes).T
    return covariance - rigid, rigid


METHODS: dict[str, Method] = {
    "mean of the others": mean_of_others,
    "rigid fit of the others": rigid_fit_of_others,
    "bayesreg, landmarks alone": elastic_body,
}


def main() -> None:
    """Read the points, and print the tables."""
    folder = Path(os.environ.get("BAYESREG_DATA", "."), "resect")
    files = sorted(folder.glob("*.tag"))
    if not files:
        raise SystemExit(f"no *.tag in {folder}; set BAYESREG_DATA to the folder that holds resect/")
    cases = [read_point_pairs(path) for path in files]
    moved = np.concatenate([np.linalg.norm(pairs.moving - pairs.fixed, axis=1) for pairs in cases])
    print(f"{len(cases)} patients, {len(moved)} points, displaced by {moved.mean():.2f} mm in the mean\n")
    print(f"{'method':26s} {'error, mm':>10s} {'by patient':>14s}" + "".join(f"{f'in {x:.0%}':>9s}" for x in LEVELS))
    by_patient = {}
    for name, method in METHODS.items():
        predictions = [method(pairs) for pairs in cases]
        every = np.concatenate([np.array(case) for case in predictions])
        of_cases = [np.mean([prediction.error for prediction in case]) for case in predictions]
        shares = "".join(f"{np.mean(every[:, 1] < level):9.0%}" for level in LEVELS)
        by_patient[name] = of_cases
        spread = f"{min(of_cases):.2f} to {max(of_cases):.2f}"
        print(f"{name:26s} {every[:, 0].mean():10.2f} {spread:>14s}{shares}", flush=True)
    print("\nmean error of each patient, mm")
    for path, *errors in zip(files, *by_patient.values(), strict=True):
        print(f"{path.stem:26s}" + "".join(f"{error:8.2f}" for error in errors))


if __name__ == "__main__":
    main()
