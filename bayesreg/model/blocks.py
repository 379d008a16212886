"""Blocks of unknowns: the names of each kind of unknown, its prior, and its map to the real line.

A state has three sets of coordinates (see `bayesreg.Posterior`). A *value* has all entries of a block, including the
known ones. An *estimand* has the sampled entries only. A *position* is the estimand mapped to the real line. A block
converts one into another. It is a pytree; everything that determines shapes is static.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Bool, Float, Int
from numpyro.distributions import constraints

from bayesreg.model.priors import RangeTransform, ScaledBeta
from bayesreg.settings import ScalePrior
from bayesreg.types import AnyArray, Scalar

Values = Mapping[str, AnyArray]

LAME = ("lam", "mu")

ONE = np.ones(())


@runtime_checkable
class Block(Protocol):
    """One kind of unknown, with its prior and its map to the real line."""

    @property
    def is_sampled(self) -> bool:
        """Whether any entry of the block is unknown."""

    def draw(self, name: str) -> AnyArray:
        """Draw the value in a NumPyro program: a sample site with this name, or the known value."""

    def reference(self) -> AnyArray:
        """Return the value at rest, at which chains may start."""

    def complete(self, estimand: AnyArray) -> AnyArray:
        """Return the value that belongs to an estimand."""

    def estimand(self, value: AnyArray) -> AnyArray:
        """Return the sampled entries of a value."""

    def constrain(self, position: AnyArray) -> tuple[AnyArray, Scalar]:
        """Return the estimand of a position, and the logarithm of the Jacobian."""

    def unconstrain(self, estimand: AnyArray) -> AnyArray:
        """Return the position of an estimand."""

    def least_curvature(self, position: AnyArray) -> AnyArray:
        """Return the curvature of −log density in every coordinate that the data hardly constrain."""

    def allows(self, value: AnyArray) -> Bool[AnyArray, ""]:
        """Check whether every sampled entry lies in the range of its prior."""


class _Arrays:
    """A block whose arrays are all data. All its entries are sampled, and its position equals its value.

    A subclass names its arrays in `arrays`, in the order of its arguments.
    """

    arrays: ClassVar[tuple[str, ...]]

    @property
    def is_sampled(self) -> bool:
        """Whether any entry is unknown; see `Block`."""
        return True

    def complete(self, estimand: AnyArray | float) -> AnyArray:
        """Return the estimand unchanged: it has all entries."""
        return jnp.asarray(estimand)

    def estimand(self, value: AnyArray | float) -> AnyArray:
        """Return the value unchanged: all its entries are sampled."""
        return jnp.asarray(value, float)

    def constrain(self, position: AnyArray) -> tuple[AnyArray, Scalar]:
        """Return the position unchanged, and a log-Jacobian of zero."""
        return position, jnp.zeros(())

    def unconstrain(self, estimand: AnyArray | float) -> AnyArray:
        """Return the estimand unchanged: it equals its position."""
        return jnp.asarray(estimand)

    def least_curvature(self, position: AnyArray) -> AnyArray:
        """Return one for every coordinate."""
        return jnp.ones_like(position)

    def allows(self, value: AnyArray | float) -> Bool[AnyArray, ""]:
        """Accept every value: the range is the whole real line."""
        return jnp.array(True)

    def tree_flatten(self) -> tuple[tuple[Any, ...], None]:
        """Return the arrays of the block, for JAX."""
        return tuple(getattr(self, name) for name in self.arrays), None

    @classmethod
    def tree_unflatten(cls, _: None, children: Any) -> Any:
        """Build the block from its arrays, for JAX."""
        return cls(*children)


@jax.tree_util.register_pytree_node_class
class Displacement(_Arrays):
    """Displacements of the sampled nodes, mm, with a flat base measure. The skull is a separate term.

    Parameters
    ----------
    points : (b, 3) array
        Positions of these nodes at rest, mm.
    """

    arrays = ("points",)

    def __init__(self, points: Any) -> None:
        self.points = points

    def draw(self, name: str) -> AnyArray:
        """Draw the displacements in a NumPyro program; see `Block`."""
        return numpyro.sample(name, dist.ImproperUniform(constraints.real_matrix, (), event_shape=self.points.shape))

    def reference(self) -> AnyArray:
        """Return displacements of zero."""
        return jnp.zeros(self.points.shape)


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


class _Positive(_Arrays):
    """A positive scalar, whose position is its logarithm."""

    def constrain(self, position: AnyArray) -> tuple[AnyArray, Scalar]:
        """Return the exponential of a position, and the log-Jacobian."""
        return jnp.exp(position), position

    def unconstrain(self, estimand: AnyArray | float) -> AnyArray:
        """Return the logarithm of an estimand."""
        return jnp.log(estimand)

    def allows(self, value: AnyArray | float) -> Bool[AnyArray, ""]:
        """Check whether the value is positive and finite."""
        return jnp.isfinite(value) & (value > 0)


@jax.tree_util.register_pytree_node_class
class Scale(_Positive):
    """A positive scalar, such as a temperature: known, or with a log-normal prior.

    Parameters
    ----------
    median : scalar
        The known value, or the median of the prior.
    log_sd : scalar, optional
        Standard deviation of the logarithm; None means that the value is known.
    factor : scalar
        The value is the estimand times this factor; it is one except in the search for a mode.
    """

    arrays = ("median", "log_sd", "factor")

    def __init__(self, median: Any, log_sd: Any = None, factor: Any = ONE) -> None:
        self.median, self.log_sd, self.factor = median, log_sd, factor

    @property
    def is_sampled(self) -> bool:
        """Whether the scale is unknown; see `Block`."""
        return self.log_sd is not None

    def draw(self, name: str) -> AnyArray:
        """Draw the scale in a NumPyro program; see `Block`."""
        if not self.is_sampled:
            return self.median
        return numpyro.sample(name, dist.LogNormal(jnp.log(self.median), self.log_sd))

    def reference(self) -> AnyArray:
        """Return the median of the prior, or the known value."""
        return jnp.asarray(self.median)

    def complete(self, estimand: AnyArray | float) -> AnyArray:
        """Return the estimand multiplied by the factor."""
        return jnp.asarray(estimand) * self.factor

    def estimand(self, value: AnyArray | float) -> AnyArray:
        """Return the value divided by the factor."""
        return jnp.asarray(value, float) / self.factor

    def times(self, factor: float) -> Scale:
        """Return a scale whose values are those of this scale multiplied by a factor."""
        return Scale(factor * self.median, self.log_sd, factor * self.factor)


def scale_block(given: float | ScalePrior) -> Scale:
    """Make the block of a scale from a number, if it is known, or from a prior, if it is inferred."""
    if isinstance(given, ScalePrior):
        return Scale(jnp.asarray(given.median), jnp.asarray(given.log_sd))
    return Scale(jnp.asarray(given))


@jax.tree_util.register_pytree_node_class
class FieldScale(_Positive):
    """The standard deviation of the field of log-stiffness, with a half-normal prior.

    Parameters
    ----------
    width : scalar
        Scale of the prior.
    """

    arrays = ("width",)

    def __init__(self, width: Any) -> None:
        self.width = width

    def draw(self, name: str) -> AnyArray:
        """Draw the standard deviation in a NumPyro program; see `Block`."""
        return numpyro.sample(name, dist.HalfNormal(self.width))

    def reference(self) -> AnyArray:
        """Return the scale of the prior."""
        return jnp.asarray(self.width)


@jax.tree_util.register_pytree_node_class
class Coefficients(_Arrays):
    """Independent Normal coefficients with mean zero, such as the whitened components of the field of log-stiffness.

    Parameters
    ----------
    sd : (k,) array
        Their standard deviations.
    """

    arrays = ("sd",)

    def __init__(self, sd: Any) -> None:
        self.sd = sd

    def draw(self, name: str) -> AnyArray:
        """Draw the coefficients in a NumPyro program; see `Block`."""
        return numpyro.sample(name, dist.Normal(jnp.zeros_like(self.sd), self.sd).to_event(1))

    def reference(self) -> AnyArray:
        """Return coefficients of zero."""
        return jnp.zeros_like(self.sd)


# Blocks by name. Only code that expects one kind of block uses the members that are particular to it.
Blocks = dict[str, Any]
