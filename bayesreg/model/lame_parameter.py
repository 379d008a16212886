"""The block of a Lamé parameter: λ or μ of every entry, of which some may be known."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Bool, Float

from bayesreg.model.priors import Entries, MixedPrior, RangeTransform, ScaledBeta
from bayesreg.types import AnyArray, Scalar

# All but 1e-9 of a log-normal prior lies below the value of this Normal score.
GREATEST_SCORE = 6.0


class LameParameter(NamedTuple):
    """The Lamé parameter λ or μ: its prior, its known entries, and its values at the start.

    Attributes
    ----------
    alpha, beta, low, high : (entries,) arrays
        Parameters of the scaled Beta prior of each entry; of a log-normal entry those of the flat prior of all positive
        numbers.
    log_beta : (entries,) array
        log B(α, β).
    median, log_sd : (entries,) arrays
        Parameters of the log-normal prior of each entry; 1 for the other entries.
    log_normal : Entries
        The entries with a log-normal prior.
    free : Entries
        The entries that are sampled.
    at_rest : (entries,) array
        The known value, or the value at which the interior solve is preconditioned and chains may start. For a flat
        prior without an upper bound, it is also the scale of the coordinate.
    """

    alpha: Float[AnyArray, "entries"]
    beta: Float[AnyArray, "entries"]
    low: Float[AnyArray, "entries"]
    high: Float[AnyArray, "entries"]
    log_beta: Float[AnyArray, "entries"]
    median: Float[AnyArray, "entries"]
    log_sd: Float[AnyArray, "entries"]
    log_normal: Entries
    free: Entries
    at_rest: Float[AnyArray, "entries"]

    @property
    def is_sampled(self) -> bool:
        """Whether any entry is unknown; see `Block`."""
        return bool(self.free.is_in.any())

    def prior(self) -> dist.Distribution:
        """Return the prior p(λ) or p(μ) of the sampled entries; known entries have no density."""
        prior: dist.Distribution = ScaledBeta(self.alpha, self.beta, self.low, self.high, self.log_beta)
        if self.log_normal.is_in.any():
            prior = MixedPrior(prior, self.median, self.log_sd, self.log_normal)
        return prior.mask(self.free.is_in).to_event(1)

    def draw(self, name: str) -> AnyArray:
        """Draw the parameter in a NumPyro program; see `Block`."""
        return numpyro.sample(name, self.prior())

    def reference(self) -> AnyArray:
        """Return the reference values, `at_rest`."""
        return jnp.asarray(self.at_rest)

    def bounds(self) -> tuple[float, float]:
        """Return the least value of any entry and the greatest: of the prior, or the known ones if none is sampled."""
        if not self.is_sampled:
            return float(np.min(self.at_rest)), float(np.max(self.at_rest))
        likely = np.asarray(self.median) * np.exp(GREATEST_SCORE * np.asarray(self.log_sd))
        high = np.where(self.log_normal.is_in, likely, self.high)
        return float(np.min(self.low)), float(high.max())

    def complete(self, estimand: AnyArray) -> AnyArray:
        """Return all entries, including the known ones."""
        return jnp.asarray(self.at_rest).at[self.free.index].set(estimand)

    def estimand(self, value: AnyArray) -> AnyArray:
        """Return the sampled entries of a value."""
        return jnp.asarray(value, float)[..., self.free.index]

    def constrain(self, position: AnyArray) -> tuple[AnyArray, Scalar]:
        """Map Normal scores to λ or μ."""
        to_range, (median, log_sd) = self._to_range, self._of_log_normal
        estimand = self._by_kind(lambda: median * jnp.exp(log_sd * position), lambda: to_range(position))
        log_jacobian = self._by_kind(
            lambda: jnp.log(median * log_sd) + log_sd * position,
            lambda: to_range.log_abs_det_jacobian(position, estimand),
        )
        return estimand, log_jacobian.sum()

    def unconstrain(self, estimand: AnyArray) -> AnyArray:
        """Map λ or μ to Normal scores."""
        to_range, (median, log_sd) = self._to_range, self._of_log_normal
        # A branch that is not taken must still have a finite gradient.
        positive = jnp.where(self._is_log_normal, estimand, 1.0)
        return self._by_kind(lambda: jnp.log(positive / median) / log_sd, lambda: to_range.inv(estimand))

    def least_curvature(self, position: AnyArray) -> AnyArray:
        """Return one, the curvature of a Normal score, or less for a large score without an upper bound.

        With a flat prior without an upper bound, λ and μ grow as scale · z²/2 for large scores z. The curvature in
        log λ or log μ does not depend on the scale, and is one.
        """
        to_range = self._to_range

        def of_range() -> AnyArray:
            x = to_range(position)
            growth = jnp.exp(to_range.log_abs_det_jacobian(position, x)) / (x - to_range.low)
            return jnp.where(jnp.isinf(to_range.high), jnp.minimum(growth, 1.0) ** 2, 1.0)

        return self._by_kind(lambda: jnp.ones_like(position), of_range)

    def allows(self, value: AnyArray) -> Bool[AnyArray, ""]:
        """Check whether the sampled entries lie in [low, high]."""
        return (~self.free.is_in | ((value >= self.low) & (value <= self.high))).all()

    @property
    def _to_range(self) -> RangeTransform:
        """The map from the real line to the sampled entries with a scaled Beta prior."""
        index = self.free.index
        low, high, scale = (jnp.asarray(x)[index] for x in (self.low, self.high, self.at_rest))
        return RangeTransform(low, high, scale)

    @property
    def _of_log_normal(self) -> tuple[Float[AnyArray, "free"], Float[AnyArray, "free"]]:
        """The medians and log-sds of the sampled entries."""
        return jnp.asarray(self.median)[self.free.index], jnp.asarray(self.log_sd)[self.free.index]

    @property
    def _is_log_normal(self) -> Bool[np.ndarray, "free"]:
        return self.log_normal.is_in[self.free.index]

    def _by_kind(self, log_normal: Callable[[], AnyArray], others: Callable[[], AnyArray]) -> AnyArray:
        """Choose between two arrays by the prior of every sampled entry; an array that no entry takes is not made."""
        chosen = self._is_log_normal
        if not chosen.any():
            return others()
        return log_normal() if chosen.all() else jnp.where(chosen, log_normal(), others())
