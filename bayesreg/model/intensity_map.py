"""A slow shading between two images of one contrast: f(x) ≈ m(x + u) − p(x) f(x) − c, p a polynomial.

What is inferred are coefficients of functions of f and x that are orthogonal at the quadrature points and as great as f
is there, so that the images say about as much of each, and of each by itself.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from jaxtyping import Float

# Prior standard deviation of each coefficient, as a share of the root mean square of f.
SHARE = 0.5


def shading_basis(
    values: Float[np.ndarray, "points"], positions: Float[np.ndarray, "points 3"], degree: int
) -> Float[np.ndarray, "points coefficients"]:
    """The functions at the points.

    Parameters
    ----------
    values : (q,) array
        f.
    positions : (q, 3) array
        mm.
    degree : int
        Of the polynomial; zero leaves f and a constant.
    """
    middle, half = (positions.max(axis=0) + positions.min(axis=0)) / 2, np.ptp(positions, axis=0) / 2
    x = (positions - middle) / half
    powers = [power for power in product(range(degree + 1), repeat=3) if sum(power) <= degree]
    functions = [np.ones_like(values), *(values * np.prod(x**power, axis=1) for power in powers)]
    return np.linalg.qr(np.stack(functions, axis=1))[0] * np.linalg.norm(values)
