"""Similarities that compare the images point by point: each residual f(x_q) − m(x_q + u(x_q)) has independent noise."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Float
from pydantic import Field
from scipy import stats

from bayesreg.interpolation import Interpolator
from bayesreg.model.term import SharedCurvature
from bayesreg.settings import KnownOrInferred, Section
from bayesreg.types import AnyArray, Scalar

Same = TypeVar("Same")


class Intensities(NamedTuple):
    """The intensities of two images at the quadrature points.

    Attributes
    ----------
    fixed : (q,) array
        f(x_q).
    moving : (q,) array
        m(x_q + u(x_q)).
    weights : (q,) array
        Quadrature weights w_q, mm³. A point has noise of the squared scale T_s / (2 w_q).
    share : (q,) array or None
        Share of each point that is compared, from 0 to 1; None: all of every point.
    """

    fixed: Float[AnyArray, "points"]
    moving: Float[AnyArray, "points"]
    weights: Float[AnyArray, "points"]
    share: Float[AnyArray, "points"] | None = None

    @property
    def differences(self) -> Float[AnyArray, "points"]:
        """The differences f − m."""
        return self.fixed - self.moving

    @property
    def shares(self) -> Float[AnyArray, "points"]:
        """The share of each point that is compared."""
        return jnp.ones_like(self.weights) if self.share is None else self.share


class ValueCurvature(NamedTuple):
    """The curvature of E_s in the values m_q, mm³.

    Attributes
    ----------
    diagonal : (q,) array
    shared : SharedCurvature or None
        The curvature of groups of points, in addition; each point has one unknown, its value.
    """

    diagonal: Float[AnyArray, "points"]
    shared: SharedCurvature | None = None


def total(weights: Float[AnyArray, "points"], values: Float[AnyArray, "points"]) -> Scalar:
    """Sum weighted values in double precision, whatever their own precision is.

    This is a product of vectors instead of a sum of products: XLA would fuse the sum with the interpolation that made
    the values, and repeat the index arithmetic for each of its taps.
    """
    return weights.astype(float) @ values.astype(float)


class Pointwise(ABC):
    """The base of these similarities; see `bayesreg.model.observations.images.similarity.Similarity`.

    A subclass is a pytree: it names its arrays in `arrays`, in the order of its arguments. It adds `energy`,
    `log_normaliser`, `variance` and `draw`.
    """

    arrays: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def energy(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return E_s, a sum over the points, mm³ times squared intensity."""

    def residuals(self, pair: Intensities) -> Float[AnyArray, "points"]:
        """Return the residuals f − m."""
        return pair.differences

    def convexity(self, pair: Intensities, temperature: Scalar) -> ValueCurvature:
        """Return the curvature of eq. (1), 2 w."""
        return ValueCurvature(2 * pair.weights * pair.shares)

    def curvature(self, pair: Intensities, temperature: Scalar) -> ValueCurvature:
        """Return ∂²E_s/∂m_q²: the Hessian is diagonal."""
        slope = jax.grad(lambda values: self.energy(pair._replace(moving=values), temperature))
        return ValueCurvature(jax.jvp(slope, (pair.moving,), (jnp.ones_like(pair.moving),))[1])

    @abstractmethod
    def log_normaliser(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return −log Z_s, a sum over the points."""

    @abstractmethod
    def draw(self, key: AnyArray, pair: Intensities) -> Float[AnyArray, "points"]:
        """Draw residuals from the model, in units of their scales."""

    def expected_slope(self, pair: Intensities) -> None:
        """Return None; see `Similarity`."""
        return

    def of_one_point(self: Same) -> Same:
        """Return the similarity itself: its points are independent."""
        return self

    def tree_flatten(self) -> tuple[tuple[Any, ...], None]:
        """Return the arrays, for JAX."""
        return tuple(getattr(self, name) for name in self.arrays), None

    @classmethod
    def tree_unflatten(cls, _: None, arrays: tuple[Any, ...]) -> Any:
        """Build the similarity from its arrays, for JAX."""
        return cls(*arrays)


@jax.tree_util.register_pytree_node_class
class SumOfSquaredDifferences(Pointwise):
    """The similarity ∫ (f − m(x + u))² dx, eq. (1): Gaussian noise with the variance σ_q² = T_s / (2 w_q)."""

    def energy(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return Σ_q w_q (f − m)², which does not depend on the temperature."""
        return total(pair.weights * pair.shares, pair.differences**2)

    def log_normaliser(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return Σ_q −½ log(2π σ_q²)."""
        return total(pair.shares, 0.5 * jnp.log(pair.weights / (jnp.pi * temperature)))

    def variance(self) -> Scalar:
        """Return one, the variance of the noise in units of its squared scale."""
        return jnp.ones(())

    def draw(self, key: AnyArray, pair: Intensities) -> Float[AnyArray, "points"]:
        """Draw independent standard Normal numbers."""
        return jax.random.normal(key, pair.weights.shape)


@jax.tree_util.register_pytree_node_class
class StudentTNoise(Pointwise):
    """Student's t noise of the squared scale s_q² = T_s / (2 w_q), which gives outliers a small weight.

    Parameters
    ----------
    degrees_of_freedom : scalar
        ν.
    """

    arrays = ("degrees_of_freedom",)

    def __init__(self, degrees_of_freedom: Any) -> None:
        self.degrees_of_freedom = degrees_of_freedom

    def energy(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return T_s (ν + 1)/2 Σ_q log(1 + 2 w_q (f − m)² / (ν T_s)).

        It is −T_s times the log of Student's t without its normaliser. For small residuals, and for many degrees of
        freedom, it equals eq. (1); a large residual adds only its logarithm.
        """
        nu = self.degrees_of_freedom
        log_terms = jnp.log1p(2 * pair.weights * pair.differences**2 / (nu * temperature))
        return temperature * (nu + 1) / 2 * total(pair.shares, log_terms)

    def convexity(self, pair: Intensities, temperature: Scalar) -> ValueCurvature:
        """Return 2 w (ν + 1)/(ν + 3) times the weights (ν + 1)/(ν + z²) of iteratively reweighted least squares.

        If the residuals z, in units of their scale, follow the model, then the mean of the weights is one, and the
        curvature is Fisher's information. Outliers reduce the mean.
        """
        nu = self.degrees_of_freedom
        squares = 2 * pair.weights * pair.differences**2 / temperature
        return ValueCurvature(2 * pair.weights * pair.shares * (nu + 1) ** 2 / ((nu + 3) * (nu + squares)))

    def log_normaliser(self, pair: Intensities, temperature: Scalar) -> Scalar:
        """Return Σ_q log Γ((ν+1)/2) − log Γ(ν/2) − ½ log(νπ s_q²)."""
        nu = self.degrees_of_freedom
        shape = gammaln((nu + 1) / 2) - gammaln(nu / 2)
        return total(pair.shares, shape + 0.5 * jnp.log(2 * pair.weights / (jnp.pi * nu * temperature)))

    def variance(self) -> Scalar:
        """Return the variance ν / (ν − 2)."""
        return self.degrees_of_freedom / (self.degrees_of_freedom - 2)

    def draw(self, key: AnyArray, pair: Intensities) -> Float[AnyArray, "points"]:
        """Draw independent numbers of Student's t by Bailey's method (1994), 25 times as fast as `jax.random.t`."""
        nu, shape = self.degrees_of_freedom, pair.weights.shape
        key_radius, key_angle = jax.random.split(key)
        uniform = jax.random.uniform(key_radius, shape, minval=jnp.finfo(pair.weights.dtype).tiny)
        angle = 2 * jnp.pi * jax.random.uniform(key_angle, shape)
        return jnp.sqrt(nu * (uniform ** (-2 / nu) - 1)) * jnp.cos(angle)


class SimilaritySettings(Section):
    """The base of the settings of every similarity."""

    kind: str
    temperature: KnownOrInferred = 0.05
    """Boltzmann temperature T_s, mm³ times squared intensity, or its prior."""

    serves_any_contrast: ClassVar[bool] = False
    compares_descriptors: ClassVar[bool] = False
    # Whether the gradient of m is mostly that of its noise.
    has_noisy_slopes: ClassVar[bool] = False
    # E_s in the report, and the description of its residual if that is not f − m(x + u).
    formula: ClassVar[str]
    residual: ClassVar[str] = ""
    has_heavy_tails: ClassVar[bool] = False

    def noise(self) -> tuple[str, Any]:
        """Return the distribution of standardised residuals in the model: its name, and SciPy's object."""
        return "standard Normal", stats.norm()


class SquaredDifferences(SimilaritySettings):
    """Sum of squared differences, eq. (1): Gaussian noise."""

    formula = "∫ (<var>f</var> − <var>m</var>(<var>x</var> + <var>u</var>))² d<var>x</var>, by quadrature over the mesh"

    kind: Literal["ssd"] = "ssd"

    def on(
        self, positions: Float[np.ndarray, "points 3"], rest: Intensities, fixed: Interpolator, blur: float = 0.0
    ) -> SumOfSquaredDifferences:
        """Make the similarity at these points; see `AnySimilarity`."""
        return SumOfSquaredDifferences()


class StudentT(SimilaritySettings):
    """Student's t noise, which gives outliers a small weight."""

    formula = (
        "<var>T</var><sub>s</sub> (ν+1)/2 Σ log(1 + 2<var>wr</var>² / (ν<var>T</var><sub>s</sub>)), where "
        "<var>r</var> = <var>f</var> − <var>m</var>(<var>x</var> + <var>u</var>) at a quadrature point of weight "
        "<var>w</var>: Student’s t"
    )

    has_heavy_tails = True

    kind: Literal["student_t"] = "student_t"
    degrees_of_freedom: Annotated[float, Field(strict=True, gt=2, allow_inf_nan=False)] = 4.0
    """ν, above 2: the fewer, the heavier the tails; many are Gaussian."""

    def noise(self) -> tuple[str, Any]:
        """Return Student's t, see `SimilaritySettings.noise`."""
        return f"Student’s t with ν = {self.degrees_of_freedom:g}", stats.t(self.degrees_of_freedom)

    def on(
        self, positions: Float[np.ndarray, "points 3"], rest: Intensities, fixed: Interpolator, blur: float = 0.0
    ) -> StudentTNoise:
        """Make the similarity at these points; see `AnySimilarity`."""
        return StudentTNoise(jnp.asarray(self.degrees_of_freedom))
