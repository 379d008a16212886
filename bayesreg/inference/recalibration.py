"""Intervals that allow for an error which simulations know: what is found of a stiffness whose truth is known.

A registration finds on its mesh a λ/μ that differs, for every body alike, from that of the body: linear tetrahedra are
too stiff where a tissue hardly changes its volume, and the boundary is displaced between its nodes, too. Bodies with
known λ/μ show by how much (an approximation error in the sense of Kaipio and Somersalo 2007, "Statistical inverse
problems: discretization, model reduction and inverse crimes"). Here x = μ/λ, the compressibility of a tissue against
its shear: what the mesh does to it is nearly an addition, so that the largest λ/μ suffer most.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats
from scipy.optimize import least_squares

from bayesreg.types import InputError

# λ/μ of which nothing is known: log-uniform, from a Poisson ratio of 0.25 to one of 0.4995.
RANGE = (1.0, 1000.0)
CANDIDATES = 20_000
MOST_DRAWS = 200


class Response(NamedTuple):
    """log x_found = log(offset + slope · x_true) + scatter, by tissue.

    Attributes
    ----------
    offset : (t,) array
        Compressibility that is found of an incompressible body.
    slope : (t, t) array
        Row: what is found; column: what is true.
    scatter : (t, t) array
        Covariance of the logarithm between bodies, the uncertainty of the curve included.
    degrees_of_freedom : int
        Of the scatter, whose distribution is Student's.
    """

    offset: Float[np.ndarray, "tissues"]
    slope: Float[np.ndarray, "tissues tissues"]
    scatter: Float[np.ndarray, "tissues tissues"]
    degrees_of_freedom: int

    def __call__(self, compressibility: Float[np.ndarray, "bodies tissues"]) -> Float[np.ndarray, "bodies tissues"]:
        """log x_found without its scatter."""
        return np.log(self.offset + compressibility @ self.slope.T)


def least_bodies(tissues: int) -> int:
    """How many bodies it takes: twice as many as a tissue's curve has unknowns."""
    return 2 * (tissues + 1)


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
    curves = [_curve(design, wanted[:, tissue], 1 + tissue) for tissue in range(tissues)]
    unknowns = tissues + 1
    residual = wanted - np.column_stack([np.log(design @ curve) for curve in curves])
    scatter = residual.T @ residual / (bodies - unknowns) * (1 + unknowns / bodies)
    offset, slope = np.array([curve[0] for curve in curves]), np.array([curve[1:] for curve in curves])
    return Response(offset, slope, scatter, bodies - unknowns)


def _curve(
    design: Float[np.ndarray, "bodies unknowns"], wanted: Float[np.ndarray, "bodies"], own: int
) -> Float[np.ndarray, "unknowns"]:
    """Offset and slopes, none negative, of least squares in the logarithm."""
    first = np.full(design.shape[1], 1e-3)
    first[own] = 1.0
    # A trace of offset keeps the logarithm finite.
    return least_squares(lambda curve: np.log(design @ curve + 1e-9) - wanted, first, bounds=(0, np.inf)).x + 0.0


def recalibrated(
    known: Response, found: Float[np.ndarray, "draws tissues"], seed: int = 0
) -> Float[np.ndarray, "candidates tissues"]:
    """Draws of the body's own λ/μ, given draws of what the registration found.

    Parameters
    ----------
    known : Response
    found : (n, t) array
        Draws of a posterior; evenly spaced ones are used, at most 200.
    seed : int

    Returns
    -------
    (20000, t) array
        Equally likely, with repetitions. The prior is log-uniform on `RANGE`, whatever that of the registration.
    """
    rng = np.random.default_rng(seed)
    tissues = len(known.offset)
    least, greatest = np.log(RANGE)
    candidates = np.exp(rng.uniform(least, greatest, (CANDIDATES, tissues)))
    some = found[np.linspace(0, len(found) - 1, min(len(found), MOST_DRAWS)).round().astype(int)]
    scatter = stats.multivariate_t(np.zeros(tissues), known.scatter, df=known.degrees_of_freedom)
    expected = known(1 / candidates)
    weight = sum(scatter.pdf(-np.log(draw) - expected) for draw in some)
    return candidates[rng.choice(CANDIDATES, CANDIDATES, p=weight / weight.sum())]
