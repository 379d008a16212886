"""Each point of a patient predicted by all others: by the methods, by one run of bayesreg, and by refitting it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import bayesreg as br
from bayesreg.config import model_of
from bayesreg.fem.location import nearest_places
from bayesreg.inference.chains.stopping import StopRule
from bayesreg.io.points import read_point_pairs
from bayesreg.model.observations.landmarks import ROBUST, UNKNOWN_SD
from bayesreg.model.observations.left_out import LeftOut, Predictions, leave_out
from bayesreg.results.result import Result
from studies.points.peers import METHODS, Method, Points, Predicted
from studies.points.runs import mask_of, register
from studies.points.table import Errors, errors_of

# How far the organ is thought to reach around its points, mm: landmarks of a brain lie about a tumour.
MARGIN = 15.0
DRAWS, SECONDS = 4000, 600.0


def compare(path: Path, folder: Path, refit: bool) -> Iterator[tuple[str, Errors]]:
    """Yield what each method does on the points of a file, where it has all points but the one that it predicts."""
    pairs = read_point_pairs(path)
    fixed, shift = pairs.fixed, pairs.moving - pairs.fixed
    for name, method in METHODS.items():
        began = time.perf_counter()
        predicted = predict_each(method, fixed, shift)
        yield name, errors_of(predicted, shift, time.perf_counter() - began)
    result, seconds = register(fixed, shift, mask_of(fixed, MARGIN), folder)
    yield "bayesreg", _errors(stored(result), seconds)
    if refit:
        began = time.perf_counter()
        parts = [refitted(result, fixed, pairs.moving, k) for k in range(len(fixed))]
        joined = LeftOut(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
        yield "bayesreg, refitted", _errors(joined, time.perf_counter() - began)


def predict_each(method: Method, fixed: Points, shift: Points) -> Predicted:
    """Predict each point by a method that has the others."""
    rows = np.arange(len(fixed))
    parts = [method(fixed[rows != k], shift[rows != k], fixed[k : k + 1]) for k in rows]
    means, variances = zip(*parts, strict=True)
    return Predicted(np.concatenate(means), None if variances[0] is None else np.concatenate(variances))


def stored(result: Result) -> LeftOut:
    """Return the predictions that a run has stored of each of its points by the others."""
    assert result.run.predicted is not None
    arrays = result.run.predicted.of_observation("landmarks")
    return LeftOut(*(np.asarray(arrays[f"left_out_{name}"]) for name in LeftOut._fields))


def refitted(result: Result, fixed: Points, moving: Points, k: int) -> LeftOut:
    """Sample without point k on the mesh of a run, and predict it from the draws."""
    kept, mesh = np.arange(len(fixed)) != k, result.mesh
    moved = result.run.matching.pose.inverse.place(moving)
    points = br.Landmarks(fixed[kept], moved[kept], UNKNOWN_SD)
    posterior = br.build_posterior(mesh, [points], model_of(result.run.config))
    stop = StopRule(1.01, 400, SECONDS)
    samples = br.sample(posterior, draws=DRAWS, stop=stop, progress=False)
    print(f"without point {k + 1}: {samples.reason}", flush=True)
    draws = samples.idata.posterior
    nodes, weights, _ = nearest_places(mesh, fixed[k : k + 1])
    u = np.asarray(draws["u_boundary"]).reshape(-1, *mesh.points.shape)[:, nodes[0]]
    residual = (moved[k] - fixed[k] - np.einsum("a,sai->si", weights[0], u))[:, None]
    sd = np.broadcast_to(np.asarray(draws["landmarks_sd"]).reshape(-1, 1, 1), residual.shape)
    nothing, weight = np.zeros((*residual.shape, 3)), np.full((len(u), 1), 1 / len(u))
    return leave_out(Predictions(residual, nothing, sd, weight), ROBUST)


def _errors(left_out: LeftOut, seconds: float) -> Errors:
    return Errors(left_out.residual, left_out.covariance, left_out.share, seconds)
