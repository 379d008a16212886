"""Interpolation of displacements between points by methods that know no tissue: what bayesreg is compared with.

A method takes the points that are data and the places where it predicts, and returns the mean displacement and its
variance by axis; the variance is None for a method that states none.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import RBFInterpolator
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from sklearn.model_selection import KFold

Points = Float[np.ndarray, "k 3"]
SMOOTHINGS = np.geomspace(1e-4, 1e4, 17)
FOLDS = 10


class Predicted(NamedTuple):
    """The displacement at some places, and its variance with the error of a new point; mm and mm²."""

    mean: Float[np.ndarray, "k 3"]
    variance: Float[np.ndarray, "k 3"] | None = None


Method = Callable[[Points, Points, Points], Predicted]


def rigid(fixed: Points, shift: Points, places: Points) -> Predicted:
    """Fit a rotation and a translation (Arun, Huang and Blostein 1987)."""
    moving, centre = fixed + shift, fixed.mean(axis=0)
    u, _, vt = np.linalg.svd((fixed - centre).T @ (moving - moving.mean(axis=0)))
    flip = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = (u @ flip @ vt).T
    return Predicted((places - centre) @ rotation.T + moving.mean(axis=0) - places)


def affine(fixed: Points, shift: Points, places: Points) -> Predicted:
    """Fit an affine map."""
    coefficients = np.linalg.lstsq(np.c_[fixed, np.ones(len(fixed))], shift, rcond=None)[0]
    return Predicted(np.c_[places, np.ones(len(places))] @ coefficients)


def thin_plate(fixed: Points, shift: Points, places: Points) -> Predicted:
    """Fit a thin-plate spline, smoothed as cross-validation chooses."""
    # A point that occurs twice leaves the system of the spline without a solution if it is not smoothed.
    scores = [np.mean(_errors_in_folds(fixed, shift, smoothing)) for smoothing in SMOOTHINGS]
    return Predicted(_spline(fixed, shift, SMOOTHINGS[int(np.argmin(scores))])(places))


def gaussian_process(fixed: Points, shift: Points, places: Points) -> Predicted:
    """Fit a Gaussian process about the affine map, with a Matérn kernel of its greatest evidence for each axis."""
    trend_here, trend_there = affine(fixed, shift, fixed).mean, affine(fixed, shift, places).mean
    extent = float(np.ptp(fixed, axis=0).max())
    means, sds = [], []
    for axis in range(3):
        kernel = ConstantKernel(1.0, (1e-3, 1e3)) * Matern(extent / 4, (extent / 100, 10 * extent), nu=1.5)
        kernel += WhiteKernel(0.1, (1e-4, 1e1))
        process = GaussianProcessRegressor(kernel, normalize_y=True, n_restarts_optimizer=2, random_state=0)
        process.fit(fixed, (shift - trend_here)[:, axis])
        mean, sd = process.predict(places, return_std=True)
        means.append(mean)
        sds.append(sd)
    return Predicted(np.stack(means, axis=1) + trend_there, np.stack(sds, axis=1) ** 2)


def _spline(fixed: Points, shift: Points, smoothing: float) -> RBFInterpolator:
    return RBFInterpolator(fixed, shift, kernel="thin_plate_spline", smoothing=smoothing)


def _errors_in_folds(fixed: Points, shift: Points, smoothing: float) -> Float[np.ndarray, "k"]:
    error = np.empty(len(fixed))
    for kept, left_out in KFold(FOLDS, shuffle=True, random_state=0).split(fixed):
        predicted = _spline(fixed[kept], shift[kept], smoothing)(fixed[left_out])
        error[left_out] = np.linalg.norm(predicted - shift[left_out], axis=1)
    return error


METHODS = {
    "rigid": rigid, "affine": affine, "thin-plate spline": thin_plate, "Gaussian process": gaussian_process,
}  # fmt: skip
