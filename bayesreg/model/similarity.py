"""Image similarity energies E_s at quadrature points; the likelihood is exp(−E_s / T_s) / Z_s, eq. (11)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln
from jaxtyping import Float

from bayesreg.types import AnyArray, Scalar


class Noise(NamedTuple):
    """What a likelihood knows of the noise (a pytree).

    Attributes
    ----------
    temperature : scalar
        T_s, mm³ times squared intensity: at a point of weight w_q the residual has the squared scale T_s / (2 w_q).
    degrees_of_freedom : scalar
        ν of Student's t.
    """

    temperature: Scalar
    degrees_of_freedom: Scalar


class Similarity(NamedTuple):
    """One family of noise.

    Attributes
    ----------
    energy : callable
        (fixed values, moving values, weights, noise) → E_s, mm³ times squared intensity.
    log_normaliser : callable
        (weights, noise) → −log Z_s, with which exp(−E_s / T_s) is a density of the residuals.
    variance : callable
        (noise) → variance of the residual in units of its squared scale.
    draw : callable
        (key, shape, noise) → independent residuals in units of their scale √(T_s / 2w).
    """

    energy: Callable[[AnyArray, AnyArray, AnyArray, Noise], Scalar]
    log_normaliser: Callable[[AnyArray, Noise], Scalar]
    variance: Callable[[Noise], Scalar]
    draw: Callable[[AnyArray, tuple[int, ...], Noise], AnyArray]


def sum_of_squared_differences(
    fixed: Float[AnyArray, "points"],
    moving: Float[AnyArray, "points"],
    weights: Float[AnyArray, "points"],
    noise: Noise | None = None,
) -> Scalar:
    """∫ (f − m(x + u))² dx, eq. (1); the same for any noise.

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


def gaussian_log_normaliser(weights: Float[AnyArray, "points"], noise: Noise) -> Scalar:
    """Σ_q −½ log(2π σ_q²) with σ_q² = T_s / (2 w_q)."""
    return 0.5 * jnp.log(weights / (jnp.pi * noise.temperature)).sum()


def student_t_energy(
    fixed: Float[AnyArray, "points"],
    moving: Float[AnyArray, "points"],
    weights: Float[AnyArray, "points"],
    noise: Noise,
) -> Scalar:
    """T_s (ν + 1)/2 Σ_q log(1 + 2 w_q (f − m)² / (ν T_s)): −T_s times the log of Student's t without its normaliser.

    For small residuals, and for many degrees of freedom, eq. (1); a large residual adds its logarithm alone.
    """
    temperature, nu = noise
    surprise = jnp.log1p(2 * weights * (fixed - moving) ** 2 / (nu * temperature))
    # A product of vectors, as in eq. (1).
    return temperature * (nu + 1) / 2 * (jnp.ones_like(weights) @ surprise)


def student_t_log_normaliser(weights: Float[AnyArray, "points"], noise: Noise) -> Scalar:
    """Σ_q log Γ((ν+1)/2) − log Γ(ν/2) − ½ log(νπ s_q²) with s_q² = T_s / (2 w_q)."""
    temperature, nu = noise
    shape = gammaln((nu + 1) / 2) - gammaln(nu / 2)
    return (shape + 0.5 * jnp.log(2 * weights / (jnp.pi * nu * temperature))).sum()


SIMILARITIES: dict[str, Similarity] = {
    "ssd": Similarity(
        sum_of_squared_differences,
        gaussian_log_normaliser,
        lambda _: jnp.ones(()),
        lambda key, shape, _: jax.random.normal(key, shape),
    ),
    "student_t": Similarity(
        student_t_energy,
        student_t_log_normaliser,
        lambda noise: noise.degrees_of_freedom / (noise.degrees_of_freedom - 2),
        lambda key, shape, noise: jax.random.t(key, noise.degrees_of_freedom, shape),
    ),
}
