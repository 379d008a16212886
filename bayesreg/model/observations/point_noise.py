"""The error of a point, as a function of z² = Σ_i (q − p − u(p))_i² / sd_i², its squared distance in units of sd.

A point that was measured with its partner has errors along three dimensions, one on a surface along its normal alone.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Float
from pydantic import BeforeValidator, Field
from scipy import stats

from bayesreg.settings import Section, by_kind
from bayesreg.types import AnyArray

# A point is wrong if the standard deviation of its own error is more than this multiple of sd.
WRONG = 3.0
# The least and the greatest weight of a point that count: errors of 10,000 sd are foreseen.
LEAST_WEIGHT, GREATEST_WEIGHT = 1e-8, 1e2


@jax.tree_util.register_static
class NormalNoise(Section):
    """Normal errors, the same for all points."""

    kind: Literal["normal"] = "normal"

    @property
    def variance(self) -> float:
        """The variance of each coordinate, in units of sd²."""
        return 1.0

    @property
    def mixture(self) -> list[tuple[float, float]]:
        """Pairs of a weight τ and the logarithm of its probability, of which the error is a mixture."""
        return [(1.0, 0.0)]

    def weight(self, squares: AnyArray, dimensions: int = 3) -> AnyArray:
        """Return −2 times the derivative of the log density by z²: one."""
        return jnp.ones_like(squares)

    def bend(self, squares: AnyArray, dimensions: int = 3) -> AnyArray:
        """Return −4 times the second derivative of the log density by z²: zero."""
        return jnp.zeros_like(squares)

    def distribution(self, mean: AnyArray, sd: AnyArray) -> dist.Distribution:
        """Return the distribution of points about their means (k, 3), with standard deviations (k, 3)."""
        return dist.Normal(mean, sd).to_event(1)

    def distribution_along(self, mean: AnyArray, sd: AnyArray) -> dist.Distribution:
        """Return the distribution of numbers about their means, for errors along one dimension."""
        return dist.Normal(mean, sd)

    def draw_weights(self, key: AnyArray, squares: AnyArray) -> AnyArray:
        """Return one for every point, the weight τ that errors of Student's t have to be drawn."""
        return jnp.ones_like(squares)

    def probability_of_wrong(
        self, squares: Float[np.ndarray, "k"], dimensions: int = 3
    ) -> Float[np.ndarray, "k"] | None:
        """Return None: no point has an error of its own."""
        return None


@jax.tree_util.register_static
class StudentTNoise(Section):
    """Student's t in d dimensions: a Normal error whose precision τ_k / sd² differs from point to point.

    With τ_k ~ Gamma(ν/2, ν/2), integrated out. A point far off has a small weight (Lange, Little and Taylor 1989).
    """

    kind: Literal["student_t"] = "student_t"
    nu: Annotated[float, Field(strict=True, gt=2, allow_inf_nan=False)] = 4.0
    """ν, the degrees of freedom, above 2: the fewer, the heavier the tails."""

    @property
    def variance(self) -> float:
        """The variance of each coordinate, in units of sd²."""
        return self.nu / (self.nu - 2)

    @property
    def mixture(self) -> list[tuple[float, float]]:
        """Pairs of a weight τ and the logarithm of its probability, of which the error is nearly a mixture."""
        log_tau, step = np.linspace(math.log(LEAST_WEIGHT), math.log(GREATEST_WEIGHT), 101, retstep=True)
        log_probability = stats.gamma(self.nu / 2, scale=2 / self.nu).logpdf(np.exp(log_tau)) + log_tau + np.log(step)
        return list(zip(np.exp(log_tau), log_probability, strict=True))

    def weight(self, squares: AnyArray, dimensions: int = 3) -> AnyArray:
        """Return −2 times the derivative of the log density by z², the mean of τ given z²: (ν + d) / (ν + z²)."""
        return (self.nu + dimensions) / (self.nu + squares)

    def bend(self, squares: AnyArray, dimensions: int = 3) -> AnyArray:
        """Return −4 times the second derivative of the log density by z²."""
        return -2 * (self.nu + dimensions) / (self.nu + squares) ** 2

    def distribution(self, mean: AnyArray, sd: AnyArray) -> dist.Distribution:
        """Return the distribution of points about their means (k, 3), with scales (k, 3)."""
        # With one number for ν, NumPyro would draw one weight for all points.
        return dist.MultivariateStudentT(jnp.full(mean.shape[:-1], self.nu), mean, jnp.eye(3) * sd[..., None])

    def distribution_along(self, mean: AnyArray, sd: AnyArray) -> dist.Distribution:
        """Return the distribution of numbers about their means, for errors along one dimension."""
        return dist.StudentT(self.nu, mean, sd)

    def draw_weights(self, key: AnyArray, squares: AnyArray) -> AnyArray:
        """Draw τ given z²: it has the distribution Gamma((ν + 3)/2, (ν + z²)/2)."""
        return 2 * jax.random.gamma(key, (self.nu + 3) / 2, squares.shape) / (self.nu + squares)

    def probability_of_wrong(self, squares: Float[np.ndarray, "k"], dimensions: int = 3) -> Float[np.ndarray, "k"]:
        """Return the probability that τ < 1 / WRONG², given z²: τ has the distribution Gamma((ν + d)/2, (ν + z²)/2)."""
        return stats.gamma((self.nu + dimensions) / 2, scale=2 / (self.nu + np.asarray(squares))).cdf(1 / WRONG**2)


Noise = Annotated[NormalNoise | StudentTNoise, Field(discriminator="kind"), BeforeValidator(by_kind)]


class Adjusted(dist.Distribution):
    """A distribution whose log density counts by a share, and lacks a constant; replicates are drawn from the whole.

    Parameters
    ----------
    whole : Distribution
    share : scalar, default 1
        The share of points that are independent, where they depend on one another.
    constant : array, default 0
        The part of the log density that is left out, such as the known part of its normaliser.
    """

    def __init__(
        self, whole: dist.Distribution, share: AnyArray | float = 1.0, constant: AnyArray | float = 0.0
    ) -> None:
        self.whole, self.share, self.constant = whole, share, constant
        super().__init__(whole.batch_shape, whole.event_shape)

    @property
    def support(self):  # type: ignore[no-untyped-def]
        """The support of the whole distribution."""
        return self.whole.support

    def sample(self, key: AnyArray, sample_shape: tuple[int, ...] = ()) -> AnyArray:
        """Draw from the whole distribution."""
        return self.whole.sample(key, sample_shape)

    def log_prob(self, value: AnyArray, intermediates: None = None) -> AnyArray:
        """Return the share of the log density, less the constant."""
        return self.share * self.whole.log_prob(value) - self.constant
