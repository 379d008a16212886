"""Blocks of unknowns: the names of each kind of unknown, its prior, and its map to the real line.

A state has three sets of coordinates (see `bayesreg.Posterior`). A *value* has all entries of a block, including the
known ones. An *estimand* has the sampled entries only. A *position* is the estimand mapped to the real line. A block
converts one into another. It is a pytree; everything that determines shapes is static.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Bool
from numpyro.distributions import constraints

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
        return numpyro.sample(name, self.prior())

    def prior(self) -> dist.Distribution:
        """Return the prior of an unknown scale."""
        return dist.LogNormal(jnp.log(self.median), self.log_sd)

    def reference(self) -> AnyArray:
        """Return the median of the prior, or the known value."""
        return jnp.asarray(self.median)

    def complete(self, estimand: AnyArray | float) -> AnyArray:
        """Return the estimand multiplied by the factor."""
        return jnp.asarray(estimand) * self.factor

    def estimand(self, value: AnyArray | float) -> AnyArray:
        """Return the value divided by the factor."""
        return jnp.asarray(value, float) / self.factor

    def multiplied_by(self, factor: float) -> Scale:
        """Return a scale whose values are those of this scale multiplied by a factor."""
        return Scale(factor * self.median, self.log_sd, factor * self.factor)


def scale_block(value_or_prior: float | ScalePrior) -> Scale:
    """Make the block of a scale from a number, if it is known, or from a prior, if it is inferred."""
    if isinstance(value_or_prior, ScalePrior):
        return Scale(jnp.asarray(value_or_prior.median), jnp.asarray(value_or_prior.log_sd))
    return Scale(jnp.asarray(value_or_prior))


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
