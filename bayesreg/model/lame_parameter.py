"""The block of a Lamé parameter: λ or μ of every entry, of which some may be known."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Bool, Float, Int

from bayesreg.model.priors import RangeTransform, ScaledBeta
from bayesreg.types import AnyArray, Scalar


@jax.tree_util.register_static
class FreeEntries:
    """The sampled entries of a block. They are static because shapes depend on them.

    Parameters
    ----------
    is_free : (entries,) bool array
    """

    def __init__(self, is_free: Bool[np.ndarray, "entries"]) -> None:
        self.is_free = np.asarray(is_free, bool)
        self.index: Int[np.ndarray, "free"] = np.flatnonzero(self.is_free)
        self._key = self.is_free.tobytes()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FreeEntries) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


class LameParameter(NamedTuple):
    """The Lamé parameter λ or μ: its prior, its known entries, and its values at the start.

    Attributes
    ----------
    alpha, beta, low, high : (entries,) arrays
        Parameters of the scaled Beta prior of each entry.
    log_beta : (entries,) array
        log B(α, β).
    free : FreeEntries
        The entries that are sampled.
    at_rest : (entries,) array
        The known value, or the value at which the interior solve is preconditioned and chains may start. Without an
        upper bound, it is also the scale of the coordinate.
    """

    alpha: Float[AnyArray, "entries"]
    beta: Float[AnyArray, "entries"]
    low: Float[AnyArray, "entries"]
    high: Float[AnyArray, "entries"]
    log_beta: Float[AnyArray, "entries"]
    free: FreeEntries
    at_rest: Float[AnyArray, "entries"]

    @property
    def is_sampled(self) -> bool:
        """Whether any entry is unknown; see `Block`."""
        return bool(self.free.is_free.any())

    def prior(self) -> dist.Distribution:
        """Return the prior p(λ) or p(μ) of the sampled entries; known entries have no density."""
        beta = ScaledBeta(self.alpha, self.beta, self.low, self.high, self.log_beta)
        return beta.mask(self.free.is_free).to_event(1)

    def draw(self, name: str) -> AnyArray:
        """Draw the parameter in a NumPyro program; see `Block`."""
        return numpyro.sample(name, self.prior())

    def reference(self) -> AnyArray:
        """Return the reference values, `at_rest`."""
        return jnp.asarray(self.at_rest)

    def complete(self, estimand: AnyArray) -> AnyArray:
        """Return all entries, including the known ones."""
        return jnp.asarray(self.at_rest).at[self.free.index].set(estimand)

    def estimand(self, value: AnyArray) -> AnyArray:
        """Return the sampled entries of a value."""
        return jnp.asarray(value, float)[..., self.free.index]

    @property
    def transform(self) -> RangeTransform:
        """The map from the real line to the sampled entries."""
        index = self.free.index
        low, high, scale = (jnp.asarray(x)[index] for x in (self.low, self.high, self.at_rest))
        return RangeTransform(low, high, scale)

    def constrain(self, position: AnyArray) -> tuple[AnyArray, Scalar]:
        """Map Normal scores to λ or μ."""
        to_range = self.transform
        estimand = to_range(position)
        return estimand, to_range.log_abs_det_jacobian(position, estimand).sum()

    def unconstrain(self, estimand: AnyArray) -> AnyArray:
        """Map λ or μ to Normal scores."""
        return self.transform.inv(estimand)

    def least_curvature(self, position: AnyArray) -> AnyArray:
        """Return one, the curvature of a Normal score, or less for a large score without an upper bound.

        Without an upper bound, λ and μ grow as scale · z²/2 for large scores z. The curvature in log λ or log μ does
        not depend on the scale, and is one.
        """
        to_range = self.transform
        x = to_range(position)
        growth = jnp.exp(to_range.log_abs_det_jacobian(position, x)) / (x - to_range.low)
        return jnp.where(jnp.isinf(to_range.high), jnp.minimum(growth, 1.0) ** 2, 1.0)

    def allows(self, value: AnyArray) -> Bool[AnyArray, ""]:
        """Check whether the sampled entries lie in [low, high]."""
        return (~self.free.is_free | ((value >= self.low) & (value <= self.high))).all()
