"""Priors of the Lamé parameters: Beta distributions scaled to [r1, r2] (section 3.1 of the paper), or log-normal."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.scipy.special import betaln, erfc, ndtri, xlog1py, xlogy
from jax.scipy.stats import norm
from jaxtyping import Bool, Float, Int
from numpyro.distributions import constraints
from numpyro.distributions.transforms import Transform, biject_to

from bayesreg.types import AnyArray


@jax.tree_util.register_static
class Entries:
    """Some entries of a block. They are static because shapes and programs depend on them.

    Parameters
    ----------
    is_in : (entries,) bool array
    """

    def __init__(self, is_in: Bool[np.ndarray, "entries"]) -> None:
        self.is_in = np.asarray(is_in, bool)
        self.index: Int[np.ndarray, "chosen"] = np.flatnonzero(self.is_in)
        self._key = self.is_in.tobytes()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Entries) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


class _Range(constraints.Constraint):
    """The constraint low ≤ x ≤ high of every entry; high may be infinite."""

    def __init__(self, low: AnyArray, high: AnyArray) -> None:
        self.low, self.high = low, high

    def __call__(self, x: AnyArray) -> AnyArray:
        return (x >= self.low) & (x <= self.high)

    def feasible_like(self, prototype: AnyArray) -> AnyArray:
        return jnp.broadcast_to(RangeTransform(self.low, self.high)(jnp.zeros(())), jnp.shape(prototype))

    def tree_flatten(self):  # type: ignore[no-untyped-def]
        return (self.low, self.high), (("low", "high"), {})


class RangeTransform(Transform):
    """Map the real line to [low, high]: Normal numbers become uniform, or exponential if high is infinite.

    With Φ the distribution function of N(0, 1), the map is low + (high − low) Φ(z), or low − scale · log Φ(−z). A
    density that is flat at a bound then has the tail of a Normal density. Under a logarithm or a logit it would
    decrease as e^−|z|, and chains would make long excursions that no Gaussian reference follows.

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
        """The domain, the real line."""
        return constraints.real

    @property
    def codomain(self):  # type: ignore[no-untyped-def]
        """The interval [low, high]."""
        return _Range(self.low, self.high)

    @property
    def _width(self) -> AnyArray:
        return jnp.where(jnp.isinf(self.high), self.scale, self.high - self.low)

    @jax.jit
    def __call__(self, z: AnyArray) -> AnyArray:
        """Return constrained values; they stay below an upper bound by more than rounding."""
        tail = _tail(z)
        below = jnp.minimum(jnp.where(z < 0, tail, 1 - tail), 1 - 8 * jnp.finfo(float).eps)
        return self.low + self._width * jnp.where(jnp.isinf(self.high), -_log_survival(z), below)

    @jax.jit
    def _inverse(self, x: AnyArray) -> AnyArray:
        share, endless = (x - self.low) / self._width, jnp.isinf(self.high)
        # The smaller of the two tails is exact. A branch that is not taken must still have a finite gradient.
        upper, far = endless & (share >= 0.5), endless & (share > 600)
        small, middle, beyond = (jnp.where(taken, share, 1.0) for taken in (endless & ~upper, upper & ~far, far))
        tail = jnp.where(endless, jnp.where(upper, jnp.exp(-middle), -jnp.expm1(-small)), share)
        z = ndtri(jnp.where(far, 0.5, tail))
        return jnp.where(far, _far_score(beyond), jnp.where(upper, -z, z))

    @jax.jit
    def log_abs_det_jacobian(self, x: AnyArray, y: AnyArray, intermediates: None = None) -> AnyArray:
        """Return log |dy/dx| of every entry: φ(z) or φ(z) / Φ(−z), times the width."""
        return jnp.log(self._width) + norm.logpdf(x) - jnp.where(jnp.isinf(self.high), _log_survival(x), 0.0)

    def tree_flatten(self):  # type: ignore[no-untyped-def]
        """Return the parameters as arrays, for JAX."""
        return (self.low, self.high, self.scale), (("low", "high", "scale"), {})


# Above this value, log Φ(−z) equals its asymptotic series up to rounding; Φ(−z) itself underflows soon after.
_FAR = 30.0


def _tail(z: AnyArray) -> AnyArray:
    """Return Φ(−|z|); above zero, z is limited to `_FAR`, where the other tail is zero next to one.

    All functions of Φ use one erfc: Φ and log Φ of the library took a large part of the time to compile a gradient.
    """
    away = jnp.where(z < 0, -z, jnp.where(z < _FAR, z, _FAR))
    # The barrier prevents XLA from repeating this expression in everything that uses it.
    return jax.lax.optimization_barrier(erfc(away / np.sqrt(2)) / 2)


@jax.custom_jvp
def _log_survival(z: AnyArray) -> AnyArray:
    """Return log Φ(−z) without loss of digits."""
    tail = _tail(z)
    near = jnp.where(z < 0, jnp.log1p(-tail), jnp.log(tail))
    return jnp.where(z < _FAR, near, _far_log_survival(jnp.where(z < _FAR, _FAR, z)))


@_log_survival.defjvp
def _log_survival_jvp(primals: tuple[AnyArray], tangents: tuple[AnyArray]) -> tuple[AnyArray, AnyArray]:
    (z,), (dz,) = primals, tangents
    value, far = _log_survival(z), jnp.where(z < _FAR, _FAR, z)
    # The hazard is φ(z) / Φ(−z); a difference of two large logarithms would lose digits.
    hazard = jnp.where(z < _FAR, jnp.exp(norm.logpdf(z) - value), far / _far_series(far))
    return value, -hazard * dz


def _far_log_survival(z: AnyArray) -> AnyArray:
    """Return log Φ(−z) for z ≥ `_FAR`."""
    return norm.logpdf(z) - jnp.log(z) + jnp.log(_far_series(z))


def _far_series(z: AnyArray) -> AnyArray:
    """Return z Φ(−z) / φ(z) for z ≥ `_FAR`: 1 − 1/z² + 3/z⁴ − 15/z⁶ + …"""
    series = jnp.ones_like(z)
    for odd in (9, 7, 5, 3, 1):
        series = 1 - odd / z**2 * series
    return series


def _far_score(t: AnyArray) -> AnyArray:
    """Solve −log Φ(−z) = t > 600 for z by Newton's steps with φ(z) / Φ(−z) ≈ z; exact where e^−t underflows."""
    z = jnp.sqrt(2 * t)
    for _ in range(4):
        z += (_far_log_survival(z) + t) / z
    return z


@biject_to.register(_Range)
def _biject_to_range(constraint: _Range) -> RangeTransform:
    return RangeTransform(constraint.low, constraint.high)


class ScaledBeta(dist.Distribution):
    """Beta(α, β) scaled to [low, high]; if high = ∞ and α = β = 1, the flat improper density 1 on [low, ∞).

    Parameters
    ----------
    alpha, beta, low, high : arrays of one common shape
        Shape parameters A, B and the range [r1, r2], in the unit of the parameter.
    log_beta : array, optional
        log B(α, β), if it is known already: it takes longer to compile than the rest of the density.

    Raises
    ------
    NotImplementedError
        By `sample`, if the prior is improper.
    """

    arg_constraints = {  # noqa: RUF012 (NumPyro's convention)
        "alpha": constraints.positive,
        "beta": constraints.positive,
        "low": constraints.real,
        "high": constraints.real,
    }
    reparametrized_params = ("alpha", "beta", "low", "high")
    pytree_data_fields = (*reparametrized_params, "log_beta")

    def __init__(
        self, alpha: AnyArray, beta: AnyArray, low: AnyArray, high: AnyArray, log_beta: AnyArray | None = None
    ) -> None:
        self.alpha, self.beta, self.low, self.high = alpha, beta, low, high
        self.log_beta = betaln(alpha, beta) if log_beta is None else log_beta
        super().__init__(batch_shape=jnp.shape(alpha), validate_args=False)

    @constraints.dependent_property(is_discrete=False, event_dim=0)
    def support(self) -> _Range:
        """The support, the interval [low, high]."""
        return _Range(self.low, self.high)

    def log_prob(self, value: Float[AnyArray, "*entries"]) -> Float[AnyArray, "*entries"]:
        """Return log p(value) of every entry; −∞ outside the range."""
        inside = self.support(value)
        improper = jnp.isinf(self.high)
        width = jnp.where(improper, 1.0, self.high - self.low)
        fraction = jnp.where(inside & ~improper, (value - self.low) / width, 0.5)
        beta = xlogy(self.alpha - 1, fraction) + xlog1py(self.beta - 1, -fraction)
        density = jnp.where(improper, 0.0, beta - self.log_beta - jnp.log(width))
        return jnp.where(inside, density, -jnp.inf)

    def sample(self, key: AnyArray, sample_shape: tuple[int, ...] = ()) -> AnyArray:
        """Draw from a proper prior."""
        if np.any(np.isinf(self.high)):
            raise NotImplementedError("a flat prior on [low, inf) cannot be sampled; give a finite high")
        return self.low + (self.high - self.low) * dist.Beta(self.alpha, self.beta).sample(key, sample_shape)


class MixedPrior(dist.Distribution):
    """Log-normal priors of some entries, scaled Beta priors of the others.

    Parameters
    ----------
    beta : ScaledBeta
        The scaled Beta priors; that of a log-normal entry is the flat one of positive numbers.
    median, log_sd : arrays
        The medians of log-normal numbers, in the unit of the parameter, and the standard deviations of their
        logarithms; any positive numbers for the other entries.
    log_normal : Entries
        The entries with a log-normal prior.
    """

    arg_constraints = {"median": constraints.positive, "log_sd": constraints.positive}  # noqa: RUF012
    pytree_data_fields = ("beta", "median", "log_sd")
    pytree_aux_fields = ("log_normal",)

    def __init__(self, beta: ScaledBeta, median: AnyArray, log_sd: AnyArray, log_normal: Entries) -> None:
        self.beta, self.median, self.log_sd, self.log_normal = beta, median, log_sd, log_normal
        super().__init__(batch_shape=jnp.shape(median), validate_args=False)

    @constraints.dependent_property(is_discrete=False, event_dim=0)
    def support(self) -> _Range:
        """The support: all positive numbers for a log-normal entry."""
        return self.beta.support

    def log_prob(self, value: Float[AnyArray, "*entries"]) -> Float[AnyArray, "*entries"]:
        """Return log p(value) of every entry; −∞ outside the range."""
        chosen = self.log_normal.is_in
        # A branch that is not taken must still have a finite gradient.
        log = jnp.log(jnp.where(chosen & (value > 0), value, 1.0))
        log_normal = norm.logpdf(log, jnp.log(self.median), self.log_sd) - log
        return self.beta.log_prob(value) + jnp.where(chosen, log_normal, 0.0)

    def sample(self, key: AnyArray, sample_shape: tuple[int, ...] = ()) -> AnyArray:
        """Draw from a proper prior."""
        chosen, (key_beta, key_normal) = self.log_normal.is_in, jax.random.split(key)
        positive = self.median * jnp.exp(
            self.log_sd * jax.random.normal(key_normal, (*sample_shape, *self.batch_shape))
        )
        if chosen.all():
            return positive
        bounded = ScaledBeta(self.beta.alpha, self.beta.beta, self.beta.low, jnp.where(chosen, 1.0, self.beta.high))
        return jnp.where(chosen, positive, bounded.sample(key_beta, sample_shape))
