"""Intervals that allow for an error which simulations know: what is found of a stiffness whose truth is known.

A registration finds on its mesh a λ/μ that differs, for all bodies in much the same way, from that of the body: linear
tetrahedra are too stiff where a tissue hardly changes its volume, and the boundary is displaced between its nodes, too.
Bodies with known λ/μ show by how much (an approximation error in the sense of Kaipio and Somersalo 2007, "Statistical
inverse problems: discretization, model reduction and inverse crimes"). Here x = μ/λ, the compressibility of a tissue
against its shear: a mesh adds to it, so that the largest λ/μ suffer most.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats
from scipy.optimize import least_squares
from scipy.special import logsumexp

from bayesreg.types import InputError

# λ/μ of which nothing is known, and of the bodies: log-uniform, from a Poisson ratio of 0.25 to one of 0.498.
RANGE = (1.0, 300.0)
CANDIDATES = 20_000
MOST_DRAWS = 200
# No curve is known better than that, in the logarithm.
LEAST_SCATTER = 0.02
# Candidates are drawn anew, so often, where others had more than this share of the greatest weight.
ROUNDS, LEAST_WEIGHT = 3, 1e-6


class Response(NamedTuple):
    """log x_found = log(offset + slope · x_true) + scatter, by tissue.

    Attributes
    ----------
    offset : (t,) array
        Compressibility that is found of an incompressible body.
    slope : (t, t) array
        Row: what is found; column: what is true.
    scatter : (t, t) array
        Covariance of the logarithm between bodies, the average uncertainty of the curve included.
    degrees_of_freedom : int
        Those of Student's distribution of a further body's scatter.
    """

    offset: Float[np.ndarray, "tissues"]
    slope: Float[np.ndarray, "tissues tissues"]
    scatter: Float[np.ndarray, "tissues tissues"]
    degrees_of_freedom: int

    def __call__(self, compressibility: Float[np.ndarray, "bodies tissues"]) -> Float[np.ndarray, "bodies tissues"]:
        """log x_found without its scatter."""
        return np.log(self.offset + compressibility @ self.slope.T)


def least_bodies(tissues: int) -> int:
    """How many bodies it takes: four for each unknown of a tissue's curve."""
    return 4 * (tissues + 1)


def response(true: Float[np.ndarray, "bodies tissues"], found: Float[np.ndarray, "bodies tissues"]) -> Response:
    """How what is found of λ/μ depends on the truth, from simulated registrations.

    Parameters
    ----------
    true, found : (k, t) arrays
        λ/μ of each tissue, positive.

    Raises
    ------
    InputError
        If there are fewer bodies than `least_bodies`, or a ratio is not positive and finite.
    """
    true, found = np.asarray(true, float), np.asarray(found, float)
    bodies, tissues = true.shape
    if bodies < least_bodies(tissues):
        raise InputError(f"{tissues} tissues need {least_bodies(tissues)} simulated bodies or more, got {bodies}")
    if not all(np.isfinite(values).all() and (values > 0).all() for values in (true, found)):
        raise InputError("the ratios of simulated bodies must be positive and finite")
    design, wanted = np.column_stack([np.ones(bodies), 1 / true]), -np.log(found)
    curves = np.array([_curve(design, wanted[:, tissue], 1 + tissue) for tissue in range(tissues)])
    free = bodies - design.shape[1]
    residual = wanted - np.log(design @ curves.T)
    scatter = residual.T @ residual / free * (1 + design.shape[1] / bodies)
    return Response(curves[:, 0], curves[:, 1:], scatter + LEAST_SCATTER**2 * np.eye(tissues), free)


def _curve(
    design: Float[np.ndarray, "bodies unknowns"], wanted: Float[np.ndarray, "bodies"], own: int
) -> Float[np.ndarray, "unknowns"]:
    """Offset and slopes, none negative, of least squares in the logarithm."""
    first = np.full(design.shape[1], 1e-3)
    first[own] = 1.0
    # A trace of offset keeps the logarithm finite.
    least = np.array([1e-9] + [0.0] * (len(first) - 1))
    return least_squares(lambda curve: np.log(design @ curve) - wanted, first, bounds=(least, np.inf)).x


def recalibrate(
    known: Response, found: Float[np.ndarray, "draws tissues"], seed: int = 0
) -> Float[np.ndarray, "candidates tissues"]:
    """Draws of the body's own λ/μ, given draws of what the registration found.

    Parameters
    ----------
    known : Response
    found : (n, t) array
        Draws of a posterior, positive; evenly spaced ones are used, at most 200.
    seed : int

    Returns
    -------
    (20000, t) array
        Equally likely, with repetitions. The prior is log-uniform on `RANGE`.

    Raises
    ------
    InputError
        If there is no draw.
    """
    if not len(found):
        raise InputError("there is no draw of which every tissue has a λ/μ")
    rng, tissues = np.random.default_rng(seed), len(known.offset)
    some = found[np.linspace(0, len(found) - 1, min(len(found), MOST_DRAWS)).round().astype(int)]
    student = stats.multivariate_t(np.zeros(tissues), known.scatter, df=known.degrees_of_freedom)
    low, high = (np.full(tissues, end) for end in np.log(RANGE))
    for _ in range(ROUNDS):
        candidates = rng.uniform(low, high, (CANDIDATES, tissues))
        expected = known(np.exp(-candidates))
        weight = logsumexp([student.logpdf(-np.log(draw) - expected) for draw in some], axis=0)
        heavy = candidates[weight > weight.max() + np.log(LEAST_WEIGHT)]
        # The new range reaches half as far again, so that nothing between two candidates is cut off.
        margin = (heavy.max(axis=0) - heavy.min(axis=0)) / 2 + (high - low) / CANDIDATES ** (1 / tissues)
        low = np.maximum(heavy.min(axis=0) - margin, low)
        high = np.minimum(heavy.max(axis=0) + margin, high)
    chances = np.exp(weight - logsumexp(weight))
    return np.exp(candidates[rng.choice(CANDIDATES, CANDIDATES, p=chances / chances.sum())])
