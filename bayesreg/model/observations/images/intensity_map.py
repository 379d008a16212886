"""A slow shading between two images of one contrast: f(x) ≈ m(x + u) − p(x) f(x) − c, p a polynomial.

The unknowns are coefficients of functions of f and x that are orthogonal at the quadrature points and have the
magnitude of f there. The images then constrain all coefficients about equally and independently.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from jaxtyping import Float

# Prior standard deviation of each coefficient, as a share of the root mean square of f.
SHARE = 0.5
# Functions are treated as equal if their independent parts are weaker than this share of the strongest.
DEPENDENT = 1e-3


def shading_basis(
    values: Float[np.ndarray, "points"],
    positions: Float[np.ndarray, "points 3"],
    degree: int,
    more: Float[np.ndarray, "points functions"] | None = None,
) -> Float[np.ndarray, "points coefficients"]:
    """Evaluate the basis functions of the shading at the points.

    Parameters
    ----------
    values : (q,) array
        f.
    positions : (q, 3) array
        mm.
    degree : int
        Of the polynomial; zero leaves f and a constant.
    more : (q, k) array, optional
        Other functions, which may depend on these.
    """
    middle, half = (positions.max(axis=0) + positions.min(axis=0)) / 2, np.ptp(positions, axis=0) / 2
    x = (positions - middle) / half
    powers = [power for power in product(range(degree + 1), repeat=3) if sum(power) <= degree]
    functions = np.stack([np.ones_like(values), *(values * np.prod(x**power, axis=1) for power in powers)], axis=1)
    if more is None or not more.shape[1]:
        return np.linalg.qr(functions)[0] * np.linalg.norm(values)
    functions = np.concatenate([functions, more], axis=1)
    basis, strength, _ = np.linalg.svd(functions / np.linalg.norm(functions, axis=0), full_matrices=False)
    return basis[:, strength > DEPENDENT * strength[0]] * np.linalg.norm(values)
