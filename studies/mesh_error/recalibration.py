"""Intervals of λ/μ that are corrected for the error of the mesh, by simulated bodies whose λ/μ is known.

The λ/μ that a registration finds on its mesh differs from the true one in much the same way for all bodies: linear
tetrahedra are too stiff where a tissue hardly changes its volume, and the boundary also moves between its nodes. Bodies
of known λ/μ show the size of this approximation error (Kaipio and Somersalo 2007, "Statistical inverse problems:
discretization, model reduction and inverse crimes"). Here x = μ/λ is the compressibility of a tissue relative to its
shear. A mesh adds to x, so that the error of the largest λ/μ is the greatest.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats
from scipy.optimize import least_squares
from scipy.special import logsumexp

from bayesreg.types import InputError

# The range of the log-uniform prior of λ/μ, and of the λ/μ of the bodies: Poisson ratios from 0.25 to 0.498.
RANGE = (1.0, 300.0)
CANDIDATES = 20_000
MOST_DRAWS = 200
# The least uncertainty of a curve, in the logarithm.
LEAST_SCATTER = 0.02
# The number of times that candidates are drawn, each time in the range of those with at least this relative weight.
ROUNDS, LEAST_WEIGHT = 3, 1e-6


class Response(NamedTuple):
    """log x_found = log(offset + slope · x_true) + scatter, by tissue.

    Attributes
    ----------
    offset : (t,) array
        The compressibility that a registration finds of an incompressible body.
    slope : (t, t) array
        The rows are the found compressibilities, the columns the true ones.
    scatter : (t, t) array
        The covariance of the logarithm between bodies; it includes the average uncertainty of the curve.
    degrees_of_freedom : int
        The degrees of freedom of Student's t distribution of a new body's scatter.
    """

    offset: Float[np.ndarray, "tissues"]
    slope: Float[np.ndarray, "tissues tissues"]
    scatter: Float[np.ndarray, "tissues tissues"]
    degrees_of_freedom: int

    def __call__(self, compressibility: Float[np.ndarray, "bodies tissues"]) -> Float[np.ndarray, "bodies tissues"]:
        """log x_found without its scatter."""
        return np.log(self.offset + compressibility @ self.slope.T)


def least_bodies(tissues: int) -> int:
    """The least number of bodies: four for each unknown of a tissue's curve."""
    return 4 * (tissues + 1)


def response(true: Float[np.ndarray, "bodies tissues"], estimated: Float[np.ndarray, "bodies tissues"]) -> Response:
    """Fit the dependence of the estimated λ/μ on the true λ/μ, from simulated registrations.

    Parameters
    ----------
    true, estimated : (k, t) arrays
        λ/μ of each tissue, positive.

    Raises
    ------
    InputError
        If there are fewer bodies than `least_bodies`, or a ratio is not positive and finite.
    """
    true, estimated = np.asarray(true, float), np.asarray(estimated, float)
    bodies, tissues = true.shape
    if bodies < least_bodies(tissues):
        raise InputError(f"{tissues} tissues need {least_bodies(tissues)} simulated bodies or more, got {bodies}")
    if not all(np.isfinite(values).all() and (values > 0).all() for values in (true, estimated)):
        raise InputError("the ratios of simulated bodies must be positive and finite")
    design, wanted = np.column_stack([np.ones(bodies), 1 / true]), -np.log(estimated)
    curves = np.array([_curve(design, wanted[:, tissue], 1 + tissue) for tissue in range(tissues)])
    free = bodies - design.shape[1]
    residual = wanted - np.log(design @ curves.T)
    scatter = residual.T @ residual / free * (1 + design.shape[1] / bodies)
    return Response(curves[:, 0], curves[:, 1:], scatter + LEAST_SCATTER**2 * np.eye(tissues), free)


def _curve(
    design: Float[np.ndarray, "bodies unknowns"], logarithms: Float[np.ndarray, "bodies"], own_column: int
) -> Float[np.ndarray, "unknowns"]:
    """Fit an offset and slopes, none of them negative, by least squares in the logarithm."""
    start = np.full(design.shape[1], 1e-3)
    start[own_column] = 1.0
    # A tiny offset keeps the logarithm finite.
    lower_bounds = np.array([1e-9] + [0.0] * (len(start) - 1))
    return least_squares(lambda curve: np.log(design @ curve) - logarithms, start, bounds=(lower_bounds, np.inf)).x


def recalibrate(
    curve: Response, estimated: Float[np.ndarray, "draws tissues"], seed: int = 0
) -> Float[np.ndarray, "candidates tissues"]:
    """Draw from the distribution of a body's true λ/μ, given draws of the λ/μ that its registration found.

    Parameters
    ----------
    curve : Response
    estimated : (n, t) array
        Draws of a posterior, positive. At most 200 of them are used, evenly spaced.
    seed : int

    Returns
    -------
    (20000, t) array
        Draws of equal weight, with repetitions. The prior is log-uniform on `RANGE`.

    Raises
    ------
    InputError
        If `estimated` is empty.
    """
    if not len(estimated):
        raise InputError("there is no draw with a λ/μ of every tissue")
    rng, tissues = np.random.default_rng(seed), len(curve.offset)
    thinned = estimated[np.linspace(0, len(estimated) - 1, min(len(estimated), MOST_DRAWS)).round().astype(int)]
    student = stats.multivariate_t(np.zeros(tissues), curve.scatter, df=curve.degrees_of_freedom)
    low, high = (np.full(tissues, end) for end in np.log(RANGE))
    for _ in range(ROUNDS):
        candidates = rng.uniform(low, high, (CANDIDATES, tissues))
        expected = curve(np.exp(-candidates))
        weight = logsumexp([student.logpdf(-np.log(draw) - expected) for draw in thinned], axis=0)
        heavy = candidates[weight > weight.max() + np.log(LEAST_WEIGHT)]
        # The margin keeps values between two candidates inside the new range.
        margin = (heavy.max(axis=0) - heavy.min(axis=0)) / 2 + (high - low) / CANDIDATES ** (1 / tissues)
        low = np.maximum(heavy.min(axis=0) - margin, low)
        high = np.minimum(heavy.max(axis=0) + margin, high)
    chances = np.exp(weight - logsumexp(weight))
    return np.exp(candidates[rng.choice(CANDIDATES, CANDIDATES, p=chances / chances.sum())])
