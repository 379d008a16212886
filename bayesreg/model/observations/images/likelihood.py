"""The likelihood exp(−E_s / T_s) of eqs. (1) and (11): a pair of images on a mesh."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Float, Int
from numpyro.distributions import constraints

from bayesreg.fem.elements import Quadrature
from bayesreg.interpolation import Interpolator
from bayesreg.model.blocks import Values
from bayesreg.model.observations.images.independence import excess_of_patches, independent_blocks
from bayesreg.model.observations.images.pointwise import Intensities, Pointwise, ValueCurvature
from bayesreg.model.observations.images.self_similarity import AlternatingImages
from bayesreg.model.observations.images.similarity import Similarity
from bayesreg.model.state import State
from bayesreg.model.term import PointCurvature, SharedCurvature
from bayesreg.types import AnyArray, Scalar

NOTHING: Values = MappingProxyType({})


@jax.tree_util.register_static
@dataclass(frozen=True)
class Comparison:
    """The static part of a comparison of two images.

    Attributes
    ----------
    name : str
    normalised : bool
        Whether the likelihood's normaliser is part of the density: where T_s is inferred.
    temperature : str
        The name of its T_s among the values.
    """

    name: str
    normalised: bool
    temperature: str = "t_similarity"


class ComparedImages(NamedTuple):
    """A pair of images on a mesh (a pytree).

    Attributes
    ----------
    comparison : Comparison
    similarity : Similarity
    fixed_values : (q,) array
        f(x_q).
    moving : Interpolator or AlternatingImages
        m, or what is compared of it.
    quadrature : Quadrature
    nodes : (q, 4) int array
        Nodes of the cell of every quadrature point.
    positions : (q, 3) array
        World positions x_q of the quadrature points, mm.
    independent_share : scalar
        Effective number of independent quadrature points over the number of all; it tempers the likelihood.
    shading : (q, k) array or None
        Functions whose sum is the shading of m (`bayesreg.model.observations.images.intensity_map`).
    visible : Interpolator or None
        1 where the moving image is compared and 0 where it is ignored; None if it is compared everywhere.
    """

    comparison: Comparison
    similarity: Similarity
    fixed_values: Float[AnyArray, "points"]
    moving: Interpolator | AlternatingImages
    quadrature: Quadrature
    nodes: Int[AnyArray, "points 4"]
    positions: Float[AnyArray, "points 3"]
    independent_share: Scalar
    shading: Float[AnyArray, "points coefficients"] | None = None
    visible: Interpolator | None = None

    @property
    def is_nearly_quadratic(self) -> bool:
        """Whether the log is nearly quadratic in the displacements; it is not."""
        return False

    @property
    def name(self) -> str:
        """The name of the term."""
        return self.comparison.name

    @property
    def powers(self) -> dict[str, float]:
        """The name of T_s, with the power of a temperature that it is (one)."""
        return {self.comparison.temperature: 1.0}

    @property
    def independent_points(self) -> Scalar:
        """The number of independent quadrature points that the likelihood assumes."""
        return self.independent_share * len(self.positions)

    def temperature(self, values: Values) -> Scalar:
        """Return the temperature T_s."""
        return values[self.comparison.temperature]

    def log(self, state: State) -> Scalar:
        """Return the tempered −E_s / T_s, plus the log normaliser if T_s is inferred."""
        return self.likelihood(state).log_prob(self.fixed_values)

    def observed(self) -> Float[AnyArray, "points"]:
        """Return the observed intensities f(x_q)."""
        return self.fixed_values

    def likelihood(self, state: State) -> ImageLikelihood:
        """Return the distribution of f(x_q), given m(x_q + u(x_q))."""
        u, values = _cast((state.u, dict(state.values)), self.positions.dtype)
        # Without the barrier, XLA interpolates twice: for the density and for the record.
        compared = jax.lax.optimization_barrier(self.compared(self.places(u), values))
        return ImageLikelihood(self, compared, self.temperature(values))

    def places(self, u: Float[AnyArray, "nodes 3"]) -> Float[AnyArray, "points 3"]:
        """Return the displaced points x_q + u(x_q), mm."""
        return self.positions + self.quadrature.interpolation(u)

    def predicted(self, u: Float[AnyArray, "nodes 3"], values: Values = NOTHING) -> Float[AnyArray, "points"]:
        """Return m(x_q + u(x_q)), minus the shading if it is inferred; `values` must then hold its coefficients."""
        return self.without_shading(self.moving(self.places(u)), values)

    def without_shading(self, moving: Float[AnyArray, "points"], values: Values) -> Float[AnyArray, "points"]:
        """Subtract the shading from values of m, if a shading is inferred."""
        return moving if self.shading is None else moving - self.shading @ values[shading_name(self.name)]

    def compared(self, places: Float[AnyArray, "points 3"], values: Values = NOTHING) -> Intensities:
        """Return f(x_q), m at some points, mm, and the share of each point that is compared."""
        predicted = self.without_shading(self.moving(places), values)
        share = None if self.visible is None else self.visible(places)
        return Intensities(self.fixed_values, predicted, self.quadrature.weights, share)

    def residuals(self, u: Float[AnyArray, "nodes 3"], values: Values = NOTHING) -> Float[AnyArray, "points"]:
        """Return the part of f(x_q) that noise explains, such as f(x_q) − m(x_q + u(x_q)); zero where m is ignored."""
        pair = self.compared(self.places(u), values)
        return pair.shares * self.similarity.residuals(pair)

    def scaled_residual(self, u: Float[AnyArray, "nodes 3"], values: Values) -> Float[AnyArray, "points"]:
        """Return `residuals` in units of their scale √(T_s / 2w); they follow `standardised_noise` in the model."""
        return self.residuals(u, values) * jnp.sqrt(2 * self.quadrature.weights / self.temperature(values))

    def standardised_residual(self, state: State) -> Float[AnyArray, "points"]:
        """Return `residuals` in units of their standard deviation."""
        return self.scaled_residual(state.u, state.values) / jnp.sqrt(self.similarity.variance())

    def standardised_noise(
        self, key: AnyArray, u: Float[AnyArray, "nodes 3"], values: Values = NOTHING
    ) -> Float[AnyArray, "points"]:
        """Draw residuals from the model in units of their scale √(T_s / 2w), one for each quadrature point."""
        pair = self.compared(self.places(u), values)
        return pair.shares * self.similarity.draw(key, pair)

    def noise_sd(self, t_similarity: float) -> float:
        """Return the noise sd that T_s implies at a point of average weight w: √(T_s / 2w) if it is Gaussian."""
        variance = self.similarity.variance() * t_similarity
        return float(np.sqrt(variance / (2 * np.mean(self.quadrature.weights))))

    def scores(self, u: Float[AnyArray, "nodes 3"], values: Values) -> Float[AnyArray, "points 3"]:
        """Return −∂E_s/∂x at every point x_q + u(x_q): the force of the images there."""
        return _scores(self, u, dict(values))

    def count_by_blocks(self, u: Float[AnyArray, "nodes 3"], values: Values, blocks: Int[AnyArray, "points"]) -> float:
        """Count the independent points from the forces on blocks of points, see `independent_blocks`."""
        forces = np.asarray(self.scores(u, values)) * float(self.independent_share / self.temperature(values))
        share = independent_blocks(forces, self.gauss_newton(u, values), np.asarray(blocks))
        return float(np.clip(share * self.independent_points, 1.0, len(self.positions)))

    @property
    def is_pointwise(self) -> bool:
        """Whether the similarity compares the images point by point."""
        return isinstance(self.similarity, Pointwise)

    def count_by_patches(
        self, u: Float[AnyArray, "nodes 3"], values: Values, curvature: Float[np.ndarray, "unknowns unknowns"]
    ) -> float:
        """Count the independent points from the forces on patches at a mode, see `excess_of_patches`.

        `curvature` is that of minus the log posterior in all displacements there.
        """
        forces = np.asarray(self.scores(u, values)) * float(self.independent_share / self.temperature(values))
        excess = excess_of_patches(forces, self.gauss_newton(u, values), curvature)
        return float(np.clip(self.independent_points / excess, 1.0, len(self.positions)))

    def with_independent_points(self, count: float) -> ComparedImages:
        """Return the term with the likelihood tempered to this number of independent points."""
        return self._replace(independent_share=jnp.asarray(count / len(self.positions)))

    def in_single_precision(self) -> ComparedImages:
        """Return the term with its arrays in single precision; it sums the log density in double precision."""
        return _cast(self, jnp.float32)

    def gauss_newton(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Return the tempered Gauss–Newton curvature of E_s / T_s; for eq. (1) it is 2 w ∇m ∇mᵀ / T_s, 1/mm²."""
        return _gauss_newton(self, u, dict(values))

    def remainder(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Return the rest of the exact curvature of E_s / T_s, 1/mm²."""
        return _remainder(self, u, dict(values))


class ImageLikelihood(dist.Distribution):
    """The distribution of the fixed intensities at the quadrature points, given the moving intensities there.

    Where m is ignored, it may have any intensity that f has in the organ.

    Parameters
    ----------
    term : ComparedImages
    compared : Intensities
        f(x_q) beside m(x_q + u(x_q)).
    temperature : scalar
        T_s, mm³ times squared intensity.
    """

    support = constraints.real_vector

    def __init__(self, term: ComparedImages, compared: Intensities, temperature: Scalar) -> None:
        self.term, self.compared, self.temperature = term, compared, temperature
        super().__init__(event_shape=jnp.shape(compared.moving), validate_args=False)

    def energy(self, value: Float[AnyArray, "points"]) -> Scalar:
        """Return the energy E_s, mm³ times squared intensity."""
        return self.term.similarity.energy(self.compared._replace(fixed=value), self.temperature)

    def sample(self, key: AnyArray, sample_shape: tuple[int, ...] = ()) -> Float[AnyArray, "*sample points"]:
        """Draw replicates of the fixed image; the tempering by `independent_share` does not change them."""
        replicates = jax.vmap(self._replicate)(jax.random.split(key, sample_shape).ravel())
        return replicates.reshape(*sample_shape, *self.event_shape)

    def _replicate(self, key: AnyArray) -> Float[AnyArray, "points"]:
        similarity, pair = self.term.similarity, self.compared
        key_seen, key_hidden, key_choice = jax.random.split(key, 3)
        scale = jnp.sqrt(self.temperature / (2 * pair.weights))
        replicate = pair.fixed - similarity.residuals(pair) + scale * similarity.draw(key_seen, pair)
        if pair.share is None:
            return replicate
        hidden = self._hidden_pair(pair)
        scale = jnp.sqrt(self.temperature / (2 * hidden.weights))
        hidden_replicate = hidden.moving + scale * similarity.of_one_point().draw(key_hidden, hidden)
        return jnp.where(jax.random.uniform(key_choice, replicate.shape) < pair.share, replicate, hidden_replicate)

    def log_prob(self, value: Float[AnyArray, "points"]) -> Scalar:
        """Return the tempered log density, with its normaliser if T_s is inferred or a part of m is ignored."""
        pair = self.compared._replace(fixed=value)
        log_density = -self.energy(value) / self.temperature
        if self.term.comparison.normalised or pair.share is not None:
            log_density += self.term.similarity.log_normaliser(pair, self.temperature)
        if pair.share is not None:
            log_density += self._log_hidden(pair)
        return self.term.independent_share * log_density

    def _hidden_pair(self, pair: Intensities) -> Intensities:
        """Pair an ignored m with f: replace m by the mean of f in the organ, and add the variance of f to the noise."""
        mean, variance = self.term.fixed_values.mean(), self.term.fixed_values.var()
        # A point with this weight has T_s / (2 w) equal to the noise variance plus the variance of m.
        weights = pair.weights / (1 + 2 * pair.weights * variance / self.temperature)
        return Intensities(pair.fixed, jnp.full_like(pair.fixed, mean), weights, 1 - pair.shares)

    def _log_hidden(self, pair: Intensities) -> Scalar:
        """Return the log density of f where m is ignored."""
        hidden, noise = self._hidden_pair(pair), self.term.similarity.of_one_point()
        return (
            noise.log_normaliser(hidden, self.temperature) - noise.energy(hidden, self.temperature) / self.temperature
        )


@jax.jit
def _scores(term: ComparedImages, u: Float[AnyArray, "nodes 3"], values: Values) -> Float[AnyArray, "points 3"]:
    displaced_points = term.places(u)
    pair = term.compared(displaced_points, values)
    slope = jax.grad(term.similarity.energy)(pair, term.temperature(values)).moving
    return -slope[:, None] * _slope(term, displaced_points)


@jax.jit
def _gauss_newton(term: ComparedImages, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
    """Compute the Gauss–Newton curvature at every point x_q + u(x_q), with fixed shares of comparison."""
    displaced_points = term.places(u)
    pair = term.compared(displaced_points, values)
    convexity = term.similarity.convexity(pair, term.temperature(values))
    return _chain(term, convexity, _expected_slope(term, displaced_points, pair), term.temperature(values))


@jax.jit
def _remainder(term: ComparedImages, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
    """Compute ∇m E″ ∇mᵀ + E′ ∇²m, with the exact E″ in the values m_q, minus the Gauss–Newton curvature."""
    displaced_points, similarity, t_similarity = term.places(u), term.similarity, term.temperature(values)
    slope = partial(_slope, term)
    columns = [
        jax.jvp(slope, (displaced_points,), (jnp.broadcast_to(axis, displaced_points.shape),))[1] for axis in jnp.eye(3)
    ]
    pair = term.compared(displaced_points, values)
    first = jax.grad(similarity.energy)(pair, t_similarity).moving
    exact = _chain(term, similarity.curvature(pair, t_similarity), slope(displaced_points), t_similarity)
    expected_slope = _expected_slope(term, displaced_points, pair)
    curvature = _subtract(exact, _chain(term, similarity.convexity(pair, t_similarity), expected_slope, t_similarity))
    bent = first[:, None, None] * jnp.stack(columns, axis=-1)
    return curvature._replace(matrices=curvature.matrices + term.independent_share / t_similarity * bent)


def _chain(
    term: ComparedImages, values: ValueCurvature, slope: Float[AnyArray, "points 3"], t_similarity: Scalar
) -> PointCurvature:
    """Compute the tempered ∇m E″ ∇mᵀ / T_s."""
    share = term.independent_share / t_similarity
    matrices = (share * values.diagonal)[:, None, None] * slope[:, :, None] * slope[:, None]
    shared = values.shared
    if shared is not None:
        shared = shared._replace(vectors=jnp.sqrt(share) * shared.vectors[:, :, None] * slope)
    return PointCurvature(term.nodes, term.quadrature.barycentric, matrices, shared)


def _subtract(minuend: PointCurvature, subtrahend: PointCurvature) -> PointCurvature:
    """Subtract one curvature from another; both have the same groups, or neither has groups."""
    matrices = minuend.matrices - subtrahend.matrices
    if minuend.shared is None or subtrahend.shared is None:
        return minuend._replace(matrices=matrices)
    vectors = jnp.concatenate([minuend.shared.vectors, subtrahend.shared.vectors])
    signs = jnp.concatenate([minuend.shared.signs, -subtrahend.shared.signs])
    return minuend._replace(matrices=matrices, shared=SharedCurvature(minuend.shared.groups, vectors, signs))


def _expected_slope(term: ComparedImages, places: AnyArray, pair: Intensities) -> AnyArray:
    """Return the gradient of m without its noise, as f predicts it; else ∇m, as if m had none."""
    expected_slope = term.similarity.expected_slope(pair)
    return _slope(term, places) if expected_slope is None else expected_slope


def _slope(term: ComparedImages, places: AnyArray) -> AnyArray:
    """Compute the gradient ∇m."""
    return jax.grad(lambda x: term.moving(x).sum())(places)


def _cast(tree: Any, dtype: Any) -> Any:
    """Convert all floating-point arrays of a pytree to a type."""
    return jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


def images_of(problem: Any) -> ComparedImages | None:
    """Return the first pair of images of a `Problem`; None if there is none."""
    return next((term for term in problem.terms.values() if isinstance(term, ComparedImages)), None)


def shading_name(name: str) -> str:
    """Return the name of the coefficients of the shading of a pair of images."""
    return f"{name}_shading"
