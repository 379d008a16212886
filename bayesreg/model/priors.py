"""Priors of the Lamé parameters: Beta distributions scaled to [r1, r2] (section 3.1 of the paper)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.scipy.special import betaln, log_ndtr, ndtr, ndtri, xlog1py, xlogy
from jax.scipy.stats import norm
from jaxtyping import Float
from numpyro.distributions import constraints
from numpyro.distributions.transforms import Transform, biject_to

from bayesreg.types import AnyArray


class _Range(constraints.Constraint):
    """low ≤ x ≤ high, entry by entry; high may be infinite."""

    def __init__(self, low: AnyArray, high: AnyArray) -> None:
        self.low, self.high = low, high

    def __call__(self, x: AnyArray) -> AnyArray:
        return (x >= self.low) & (x <= self.high)

    def feasible_like(self, prototype: AnyArray) -> AnyArray:
        return jnp.broadcast_to(RangeTransform(self.low, self.high)(jnp.zeros(())), jnp.shape(prototype))

    def tree_flatten(self):  # type: ignore[no-untyped-def]
        return (self.low, self.high), (("low", "high"), {})


class RangeTransform(Transform):
    """The real line to [low, high]: what is Normal there is uniform here, or exponential where high is infinite.

    With Φ the distribution function of N(0, 1): low + (high − low) Φ(z), or low − scale · log Φ(−z). A density that is
    flat at a bound falls off towards it as a Normal one then; under a logarithm or a logit as e^−|z|, with excursions
    that no Gaussian reference follows.

    Parameters
    ----------
    low, high : arrays
        Bounds, entry by entry; high may be infinite.
    scale : array
        Mean of the exponential distribution, above low.
    """

    def __init__(self, low: AnyArray, high: AnyArray, scale: AnyArray | float = 1.0) -> None:
        self.low, self.high, self.scale = low, high, scale

    @property
    def domain(self):  # type: ignore[no-untyped-def]
        """The real line."""
        return constraints.real

    @property
    def codomain(self):  # type: ignore[no-untyped-def]
        """The interval."""
        return _Range(self.low, self.high)

    @property
    def _width(self) -> AnyArray:
        return jnp.where(jnp.isinf(self.high), self.scale, self.high - self.low)

    def __call__(self, z: AnyArray) -> AnyArray:
        """Constrained values, below an upper bound by more than rounding."""
        below = jnp.minimum(ndtr(z), 1 - 8 * jnp.finfo(float).eps)
        # Each side from the lesser of Φ(z) and Φ(−z): next to one, nothing is left of the other.
        lower, upper = jnp.where(z < 0, z, 0.0), jnp.where(z < 0, 0.0, z)
        exponential = jnp.where(z < 0, -jnp.log1p(-ndtr(lower)), -log_ndtr(-upper))
        return self.low + self._width * jnp.where(jnp.isinf(self.high), exponential, below)

    def _inverse(self, x: AnyArray) -> AnyArray:
        share, endless = (x - self.low) / self._width, jnp.isinf(self.high)
        # What is not taken must stay finite for its gradient.
        return jnp.where(endless, _score(jnp.where(endless, share, 0.5)), ndtri(jnp.where(endless, 0.5, share)))

    def log_abs_det_jacobian(self, x: AnyArray, y: AnyArray, intermediates: None = None) -> AnyArray:
        """log |dy/dx|, entry by entry: φ(z) or φ(z) / Φ(−z), times the width."""
        return jnp.log(self._width) + norm.logpdf(x) - jnp.where(jnp.isinf(self.high), log_ndtr(-x), 0.0)

    def tree_flatten(self):  # type: ignore[no-untyped-def]
        """All are data."""
        return (self.low, self.high, self.scale), (("low", "high", "scale"), {})


def _score(t: AnyArray) -> AnyArray:
    """The Normal score z of a standard exponential value t > 0: −log Φ(−z) = t."""
    small, far = t < 0.5, t > 600
    low, middle, beyond = (jnp.where(taken, t, 1.0) for taken in (small, ~small & ~far, far))
    # Before e^−t underflows Newton's steps from √(2t) take over, which are exact there.
    tail = jnp.sqrt(2 * beyond)
    for _ in range(4):
        height = log_ndtr(-tail)
        tail += (height + beyond) * jnp.exp(height - norm.logpdf(tail))
    return jnp.where(small, ndtri(-jnp.expm1(-low)), jnp.where(far, tail, -ndtri(jnp.exp(-middle))))


@biject_to.register(_Range)
def _biject_to_range(constraint: _Range) -> RangeTransform:
    return RangeTransform(constraint.low, constraint.high)


class ScaledBeta(dist.Distribution):
    """Beta(α, β) scaled to [low, high]; where high = ∞ and α = β = 1, the flat improper density 1 on [low, ∞).

    Parameters
    ----------
    alpha, beta, low, high : arrays of one common shape
        Shape parameters A, B and the range [r1, r2], in the unit of the parameter.

    Raises
    ------
    NotImplementedError
        By `sample`, where the prior is improper.
    """

    arg_constraints = {  # noqa: RUF012 (NumPyro's convention)
        "alpha": constraints.positive,
        "beta": constraints.positive,
        "low": constraints.real,
        "high": constraints.real,
    }
    reparametrized_params = ("alpha", "beta", "low", "high")

    def __init__(self, alpha: AnyArray, beta: AnyArray, low: AnyArray, high: AnyArray) -> None:
        self.alpha, self.beta, self.low, self.high = alpha, beta, low, high
        super().__init__(batch_shape=jnp.shape(alpha), validate_args=False)

    @constraints.dependent_property(is_discrete=False, event_dim=0)
    def support(self) -> _Range:
        """[low, high]."""
        return _Range(self.low, self.high)

    def log_prob(self, value: Float[AnyArray, "*entries"]) -> Float[AnyArray, "*entries"]:
        """log p(value), entry by entry; −∞ outside the range."""
        inside = self.support(value)
        improper = jnp.isinf(self.high)
        width = jnp.where(improper, 1.0, self.high - self.low)
        fraction = jnp.where(inside & ~improper, (value - self.low) / width, 0.5)
        beta = xlogy(self.alpha - 1, fraction) + xlog1py(self.beta - 1, -fraction)
        density = jnp.where(improper, 0.0, beta - betaln(self.alpha, self.beta) - jnp.log(width))
        return jnp.where(inside, density, -jnp.inf)

    def sample(self, key: AnyArray, sample_shape: tuple[int, ...] = ()) -> AnyArray:
        """Draw from a proper prior."""
        if np.any(np.isinf(self.high)):
            raise NotImplementedError("a flat prior on [low, inf) cannot be sampled; give a finite high")
        return self.low + (self.high - self.low) * dist.Beta(self.alpha, self.beta).sample(key, sample_shape)
