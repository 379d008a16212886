"""Image similarity energies E_s at quadrature points; the likelihood is exp(−E_s / T_s), eq. (11)."""

from __future__ import annotations

from collections.abc import Callable

from jaxtyping import Float

from bayesreg.types import AnyArray, Scalar

Similarity = Callable[[AnyArray, AnyArray, AnyArray], Scalar]


def sum_of_squared_differences(
    fixed: Float[AnyArray, "points"], moving: Float[AnyArray, "points"], weights: Float[AnyArray, "points"]
) -> Scalar:
    """∫ (f − m(x + u))² dx, eq. (1).

    Parameters
    ----------
    fixed, moving : (q,) array
        f(x_q) and m(x_q + u(x_q)).
    weights : (q,) array
        Quadrature weights, mm³.
    """
    # A product of vectors, not a sum of products: XLA would fuse the sum with the interpolation that made `moving`
    # and then redo the index arithmetic for each of its taps.
    return weights @ (fixed - moving) ** 2


SIMILARITIES: dict[str, Similarity] = {"ssd": sum_of_squared_differences}
