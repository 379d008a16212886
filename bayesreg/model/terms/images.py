"""A pair of images as an observation: the likelihood exp(−E_s / T_s) of eqs. (1) and (11)."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from types import MappingProxyType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Float, Int
from numpyro.distributions import constraints
from scipy import ndimage

from bayesreg.fem.elements import GAUSS_SUBDIVISIONS, Quadrature, gauss_quadrature, quadrature_at
from bayesreg.fem.location import locate
from bayesreg.image import Image
from bayesreg.interpolation import Interpolation, Interpolator
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Values
from bayesreg.model.contrast import contrast_functions, map_contrast
from bayesreg.model.intensity_map import shading_basis
from bayesreg.model.options import OF_ANY_CONTRAST, ModelConfig, TemperaturePrior
from bayesreg.model.pointwise import Intensities, ValueCurvature
from bayesreg.model.similarity import SIMILARITIES, Similarity
from bayesreg.model.state import State
from bayesreg.model.terms.term import PointCurvature, SharedCurvature
from bayesreg.types import AnyArray, InputError, Scalar

NOTHING: Values = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class ImagePair:
    """Two images; how they are compared stands in `ModelConfig.similarity`.

    Points that rest beyond the grid of the moving image say nothing.

    Attributes
    ----------
    fixed, moving : Image
        f and m; their intensities are taken as they are.
    name : str, default "images"
        Its name in tables and in the NumPyro program.
    fixed_ignore : Image, optional
        Not zero where the fixed image says nothing: no point is compared there. On any grid, in its world.
    moving_ignore : Image, optional
        Not zero where the moving image says nothing, such as in a cavity: a point that is taken there may have any
        intensity of the organ. On any grid, in its world.
    one_contrast : bool, default True
        False: f is compared through the best map of its intensities to those of m (`bayesreg.model.contrast`).
    tissue : Image, optional
        Labels on the grid of the fixed image, 0 outside: that map is then another one in every tissue.

    Raises
    ------
    InputError
        If one is no image.

    Notes
    -----
    All pairs of a posterior, such as T1 and FLAIR of one visit, share the options of the model. An inferred T_s is each
    pair's own.
    """

    fixed: Image
    moving: Image
    name: str = "images"
    fixed_ignore: Image | None = None
    moving_ignore: Image | None = None
    one_contrast: bool = True
    tissue: Image | None = None

    def __post_init__(self) -> None:
        if self.tissue is not None and self.tissue.shape != self.fixed.shape:
            raise InputError(
                f"{self.name}: tissue must lie on the grid of the fixed image, but has the shape {self.tissue.shape}, "
                f"and not {self.fixed.shape}"
            )
        for which in ("fixed", "moving", "fixed_ignore", "moving_ignore"):
            given = getattr(self, which)
            if not isinstance(given, Image) and (given is not None or which in ("fixed", "moving")):
                raise InputError(f"{self.name}: {which} must be an Image, got {type(given).__name__}; see load_image")

    def in_one_contrast(self, mesh: TetMesh, model: ModelConfig) -> ImagePair:
        """The pair with f in the contrast of m, as far as a map of intensities tells at rest; itself if it is in it.

        Raises
        ------
        InputError
            As `on`.
        """
        if self.one_contrast or model.similarity in OF_ANY_CONTRAST:
            return self
        positions = self.compared_points(mesh, model).positions(mesh)
        return MappedPair(
            map_contrast(self.fixed, self.moving, positions, self.tissue),
            self.moving,
            self.name,
            self.fixed_ignore,
            self.moving_ignore,
            tissue=self.tissue,
            source=self.fixed,
        )

    def functions(self, positions: Float[np.ndarray, "points 3"], sd: float) -> Float[np.ndarray, "points functions"]:
        """Functions, besides those of a shading, of which m may have some more than f, smoothed by sd, mm."""
        return np.zeros((len(positions), 0))

    def compared_points(self, mesh: TetMesh, model: ModelConfig) -> Quadrature:
        """The points that are compared, by the model's rule.

        Raises
        ------
        InputError
            If the mesh does not overlap an image, or nothing of it is left to compare.
        """
        of_pair = "" if self.name == "images" else f" of {self.name!r}"
        require_overlap(mesh, self.fixed, f"fixed image{of_pair}")
        require_overlap(mesh, self.moving, f"moving image{of_pair}")
        return self._seen(mesh, quadrature_of(mesh, self.fixed, model))

    def _seen(self, mesh: TetMesh, quadrature: Quadrature) -> Quadrature:
        return seen_points(mesh, quadrature, self.moving, self.fixed_ignore)

    def on(self, mesh: TetMesh, model: ModelConfig, temperature: str = "t_similarity") -> ComparedImages:
        """The term on a mesh, with a T_s of this name.

        Raises
        ------
        InputError
            If the mesh does not overlap an image, or the quadrature has no points or fewer than are independent.
        """
        quadrature = self.compared_points(mesh, model)
        positions = quadrature.positions(mesh)
        smooth = self.smoothed_as(model)
        moving = smooth.moving.interpolator(model.interpolation)
        fixed_values = smooth.fixed.interpolate(positions, model.interpolation)
        rest = Intensities(fixed_values, moving(jnp.asarray(positions)), quadrature.weights)
        more, shading = self.functions(positions, self.smoothing_sd(model)), None
        if model.intensity_map is not None or more.shape[1]:
            degree = 0 if model.intensity_map is None else model.intensity_map
            shading = jnp.asarray(shading_basis(np.asarray(fixed_values), positions, degree, more))
        return ComparedImages(
            comparison=Comparison(self.name, isinstance(model.t_similarity, TemperaturePrior), temperature),
            similarity=SIMILARITIES[model.similarity].on(model, positions, rest),
            fixed_values=fixed_values,
            moving=moving,
            quadrature=quadrature,
            nodes=jnp.asarray(mesh.cells[np.asarray(quadrature.cells)]),
            positions=jnp.asarray(positions),
            independent_share=jnp.asarray(independent_share(model, len(positions))),
            shading=shading,
            visible=None if self.moving_ignore is None else visibility(self.moving_ignore),
        )

    def smoothing_sd(self, model: ModelConfig) -> float:
        """By how much the options smooth both images, mm."""
        return model.smoothing * max(image.voxel_volume for image in (self.fixed, self.moving)) ** (1 / 3)

    def smoothed_as(self, model: ModelConfig) -> ImagePair:
        """The pair with both images smoothed as the options say."""
        return _smoothed_as(self, self.smoothing_sd(model)) if model.smoothing else self

    def smoothed(self, term: ComparedImages, sd: float, interpolation: Interpolation) -> ComparedImages:
        """The term with both images smoothed, sd in mm."""
        # SciPy's filters let other threads run.
        with ThreadPoolExecutor() as pool:
            fixed, moving = pool.map(partial(_smooth, sd, interpolation), (self.fixed, self.moving))
        return term._replace(moving=moving, fixed_values=fixed(term.positions))

    def at_four_points(self, term: ComparedImages, mesh: TetMesh, interpolation: Interpolation) -> ComparedImages:
        """The term with the images compared at four points of every tetrahedron, without a shading."""
        quadrature = self._seen(mesh, gauss_quadrature(mesh, "gauss4"))
        positions = quadrature.positions(mesh)
        return term._replace(
            similarity=term.similarity.at(positions),
            quadrature=quadrature,
            nodes=jnp.asarray(mesh.cells[np.asarray(quadrature.cells)]),
            positions=jnp.asarray(positions),
            fixed_values=self.fixed.interpolate(positions, interpolation),
            shading=None,
        )


@dataclass(frozen=True, eq=False)
class MappedPair(ImagePair):
    """A pair whose fixed image was mapped into the contrast of the moving one.

    Attributes
    ----------
    source : Image
        The fixed image itself, of whose intensities the map is a function.
    """

    source: Image | None = None

    def functions(self, positions: Float[np.ndarray, "points 3"], sd: float) -> Float[np.ndarray, "points functions"]:
        """The functions that make up the map: how much of each is there is inferred with all else."""
        assert self.source is not None
        return contrast_functions(self.source, positions, sd, self.tissue)


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
    moving : Interpolator
        m.
    quadrature : Quadrature
    nodes : (q, 4) int array
        Nodes of the cell of every quadrature point.
    positions : (q, 3) array
        World positions x_q of the quadrature points, mm.
    independent_share : scalar
        Effective number of independent quadrature points over that of all: tempers the likelihood.
    shading : (q, k) array or None
        Functions of which m has some more than f (`bayesreg.model.intensity_map`).
    visible : Interpolator or None
        1 where the moving image is looked at and 0 where it is ignored; None: it is looked at everywhere.
    """

    comparison: Comparison
    similarity: Similarity
    fixed_values: Float[AnyArray, "points"]
    moving: Interpolator
    quadrature: Quadrature
    nodes: Int[AnyArray, "points 4"]
    positions: Float[AnyArray, "points 3"]
    independent_share: Scalar
    shading: Float[AnyArray, "points coefficients"] | None = None
    visible: Interpolator | None = None

    @property
    def name(self) -> str:
        """Its name."""
        return self.comparison.name

    def temperature(self, values: Values) -> Scalar:
        """T_s."""
        return values[self.comparison.temperature]

    def log(self, state: State) -> Scalar:
        """−E_s / T_s, tempered, and the normaliser where T_s is inferred."""
        return self.likelihood(state).log_prob(self.fixed_values)

    def observed(self) -> Float[AnyArray, "points"]:
        """f(x_q)."""
        return self.fixed_values

    def likelihood(self, state: State) -> ImageLikelihood:
        """The distribution of f(x_q), given m(x_q + u(x_q))."""
        # Without the barrier XLA interpolates twice, for the density and for the record.
        compared = jax.lax.optimization_barrier(self.compared(self.places(state.u), state.values))
        return ImageLikelihood(self, compared, self.temperature(state.values))

    def places(self, u: Float[AnyArray, "nodes 3"]) -> Float[AnyArray, "points 3"]:
        """x_q + u(x_q), mm."""
        return self.positions + self.quadrature.interpolation(u)

    def predicted(self, u: Float[AnyArray, "nodes 3"], values: Values = NOTHING) -> Float[AnyArray, "points"]:
        """m(x_q + u(x_q)), less the shading, if one is inferred: its coefficients must then be among the values."""
        return self.without_shading(self.moving(self.places(u)), values)

    def without_shading(self, moving: Float[AnyArray, "points"], values: Values) -> Float[AnyArray, "points"]:
        """Values of m less what they have more of than f, if a shading is inferred."""
        return moving if self.shading is None else moving - self.shading @ values[shading_name(self.name)]

    def compared(self, places: Float[AnyArray, "points 3"], values: Values = NOTHING) -> Intensities:
        """f(x_q) beside m at some places, mm, and how much of each is looked at."""
        predicted = self.without_shading(self.moving(places), values)
        share = None if self.visible is None else self.visible(places)
        return Intensities(self.fixed_values, predicted, self.quadrature.weights, share)

    def residuals(self, u: Float[AnyArray, "nodes 3"], values: Values = NOTHING) -> Float[AnyArray, "points"]:
        """The part of f(x_q) that noise explains, such as f(x_q) − m(x_q + u(x_q)); zero where m is ignored."""
        pair = self.compared(self.places(u), values)
        return pair.shares * self.similarity.residuals(pair)

    def scaled_residual(self, u: Float[AnyArray, "nodes 3"], values: Values) -> Float[AnyArray, "points"]:
        """`residuals` in units of their scale √(T_s / 2w): where the model holds, as `standardised_noise`."""
        return self.residuals(u, values) * jnp.sqrt(2 * self.quadrature.weights / self.temperature(values))

    def standardised_residual(self, state: State) -> Float[AnyArray, "points"]:
        """`residuals` in units of their standard deviation."""
        return self.scaled_residual(state.u, state.values) / jnp.sqrt(self.similarity.variance())

    def standardised_noise(
        self, key: AnyArray, u: Float[AnyArray, "nodes 3"], values: Values = NOTHING
    ) -> Float[AnyArray, "points"]:
        """Residuals that follow the model in units of their scale √(T_s / 2w), one number for each quadrature point."""
        pair = self.compared(self.places(u), values)
        return pair.shares * self.similarity.draw(key, pair)

    def noise_sd(self, t_similarity: float) -> float:
        """The noise that T_s stands for at a point of average weight w: √(T_s / 2w) if it is Gaussian."""
        variance = self.similarity.variance() * t_similarity
        return float(np.sqrt(variance / (2 * np.mean(self.quadrature.weights))))

    def scores(self, u: Float[AnyArray, "nodes 3"], values: Values) -> Float[AnyArray, "points 3"]:
        """−∂E_s/∂x at every place x_q + u(x_q), by which the images pull there."""
        return _scores(self, u, dict(values))

    def with_independent_points(self, count: float) -> ComparedImages:
        """The term with the likelihood tempered as for so many independent points."""
        return self._replace(independent_share=jnp.asarray(count / len(self.positions)))

    def gauss_newton(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Gauss and Newton's curvature of E_s / T_s, tempered: that of eq. (1) is 2 w ∇m ∇mᵀ / T_s, 1/mm²."""
        return _gauss_newton(self, u, dict(values))

    def remainder(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """The rest of the exact curvature of E_s / T_s, 1/mm²."""
        return _remainder(self, u, dict(values))


class ImageLikelihood(dist.Distribution):
    """Intensities of the fixed image at the quadrature points, given the moving image's there.

    Where m is ignored it may have any intensity that f has in the organ.

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
        """E_s, mm³ times squared intensity."""
        return self.term.similarity.energy(self.compared._replace(fixed=value), self.temperature)

    def sample(self, key: AnyArray, sample_shape: tuple[int, ...] = ()) -> Float[AnyArray, "*sample points"]:
        """Replicates of the fixed image, which the tempering by `independent_share` leaves as they are."""
        similarity, pair = self.term.similarity, self.compared
        explained = pair.fixed - similarity.residuals(pair)
        noise = jax.vmap(lambda one: similarity.draw(one, pair))(jax.random.split(key, sample_shape).ravel())
        scale = jnp.sqrt(self.temperature / (2 * pair.weights))
        return (explained + scale * noise).reshape(*sample_shape, *self.event_shape)

    def log_prob(self, value: Float[AnyArray, "points"]) -> Scalar:
        """The tempered log density; its normaliser is part of it where T_s is inferred or some of m is ignored."""
        pair = self.compared._replace(fixed=value)
        found = -self.energy(value) / self.temperature
        if self.term.comparison.normalised or pair.share is not None:
            found += self.term.similarity.log_normaliser(pair, self.temperature)
        if pair.share is not None:
            found += self._hidden(pair)
        return self.term.independent_share * found

    def _hidden(self, pair: Intensities) -> Scalar:
        """The log density of f where m is ignored: m is then as anywhere in the organ, which is so much more noise."""
        mean, variance = self.term.fixed_values.mean(), self.term.fixed_values.var()
        # T_s / (2 w) of the noise and the variance of m are those of a point with this weight.
        weights = pair.weights / (1 + 2 * pair.weights * variance / self.temperature)
        hidden = Intensities(pair.fixed, jnp.full_like(pair.fixed, mean), weights, 1 - pair.shares)
        noise = self.term.similarity.of_one_point()
        return (
            noise.log_normaliser(hidden, self.temperature) - noise.energy(hidden, self.temperature) / self.temperature
        )


@jax.jit
def _scores(term: ComparedImages, u: Float[AnyArray, "nodes 3"], values: Values) -> Float[AnyArray, "points 3"]:
    moved = term.places(u)
    pair = term.compared(moved, values)
    slope = jax.grad(term.similarity.energy)(pair, term.temperature(values)).moving
    return -slope[:, None] * _slope(term, moved)


@jax.jit
def _gauss_newton(term: ComparedImages, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
    """Gauss and Newton's curvature in every place x_q + u(x_q), the share that is looked at held fixed."""
    moved = term.places(u)
    pair = term.compared(moved, values)
    convexity = term.similarity.convexity(pair, term.temperature(values))
    return _chain(term, convexity, _slope(term, moved), term.temperature(values))


@jax.jit
def _remainder(term: ComparedImages, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
    """The exact curvature, ∇m E″ ∇mᵀ + E′ ∇²m with E″ that in the values m_q, less Gauss and Newton's."""
    moved, similarity, t_similarity = term.places(u), term.similarity, term.temperature(values)
    slope = partial(_slope, term)
    columns = [jax.jvp(slope, (moved,), (jnp.broadcast_to(axis, moved.shape),))[1] for axis in jnp.eye(3)]
    pair = term.compared(moved, values)
    first = jax.grad(similarity.energy)(pair, t_similarity).moving
    second = _subtract(similarity.curvature(pair, t_similarity), similarity.convexity(pair, t_similarity))
    found = _chain(term, second, slope(moved), t_similarity)
    bent = first[:, None, None] * jnp.stack(columns, axis=-1)
    return found._replace(matrices=found.matrices + term.independent_share / t_similarity * bent)


def _chain(
    term: ComparedImages, values: ValueCurvature, slope: Float[AnyArray, "points 3"], t_similarity: Scalar
) -> PointCurvature:
    """∇m E″ ∇mᵀ, tempered and over T_s."""
    share = term.independent_share / t_similarity
    matrices = (share * values.diagonal)[:, None, None] * slope[:, :, None] * slope[:, None]
    shared = values.shared
    if shared is not None:
        shared = shared._replace(vectors=jnp.sqrt(share) * shared.vectors[:, :, None] * slope)
    return PointCurvature(term.nodes, term.quadrature.barycentric, matrices, shared)


def _subtract(one: ValueCurvature, other: ValueCurvature) -> ValueCurvature:
    """One curvature less another; both have the same groups, or neither has any."""
    diagonal = one.diagonal - other.diagonal
    if one.shared is None or other.shared is None:
        return ValueCurvature(diagonal)
    vectors = jnp.concatenate([one.shared.vectors, other.shared.vectors])
    signs = jnp.concatenate([one.shared.signs, -other.shared.signs])
    return ValueCurvature(diagonal, SharedCurvature(one.shared.groups, vectors, signs))


def _slope(term: ComparedImages, places: AnyArray) -> AnyArray:
    """∇m."""
    return jax.grad(lambda x: term.moving(x).sum())(places)


def shading_name(name: str) -> str:
    """The name of the coefficients of the shading of a pair of images."""
    return f"{name}_shading"


def visibility(ignore: Image) -> Interpolator:
    """1 where an image is looked at and 0 where it is ignored, as a function of the place.

    A voxel's neighbours are ignored with it, since smoothing and interpolation mix its intensity into theirs.
    """
    ignored = ndimage.binary_dilation(np.asarray(ignore.voxels) != 0, ndimage.generate_binary_structure(3, 3))
    return ignore.with_voxels(1.0 - ignored).interpolator("linear")


@lru_cache(maxsize=4)
def _smoothed_as(pair: ImagePair, sd: float) -> ImagePair:
    with ThreadPoolExecutor() as pool:
        fixed, moving = pool.map(lambda image: image.smoothed(sd), (pair.fixed, pair.moving))
    return replace(pair, fixed=fixed, moving=moving)


def _smooth(sd: float, interpolation: Interpolation, image: Image) -> Interpolator:
    return image.smoothed(sd).interpolator(interpolation)


def independent_share(model: ModelConfig, points: int) -> float:
    """Effective number of independent quadrature points over the number of all.

    Raises
    ------
    InputError
        If there are fewer points than are said to be independent.
    """
    # What residuals tell is known later, see `Posterior.count_independent_points`.
    if model.independent_points is None or model.independent_points == "residual":
        return 1.0
    if model.independent_points > points:
        raise InputError(
            f"model.independent_points is {model.independent_points:g}, but the quadrature has {points} points; "
            "give at most as many, or null for all"
        )
    return model.independent_points / points


def require_overlap(mesh: TetMesh, image: Image, name: str) -> None:
    """Raise InputError if less than half of the mesh's nodes lie on the image's grid."""
    inside = image.contains(mesh.points)
    if inside.mean() < 0.5:
        corners = image.voxel_to_world(np.array([(0, 0, 0), np.array(image.shape) - 1]))
        raise InputError(
            f"the {name} and the mesh do not overlap: {inside.sum()} of {len(inside)} nodes lie on its grid. It runs "
            f"from {corners[0].round(1).tolist()} to {corners[1].round(1).tolist()} mm (world RAS), the mesh from "
            f"{mesh.points.min(0).round(1).tolist()} to {mesh.points.max(0).round(1).tolist()} mm; "
            "check the affines, or align the images first"
        )


def quadrature_of(mesh: TetMesh, fixed: Image, model: ModelConfig) -> Quadrature:
    """The rule that the options name.

    Raises
    ------
    InputError
        If the rule is "voxels" and no voxel centre lies inside the mesh.
    """
    if model.quadrature in GAUSS_SUBDIVISIONS:
        return gauss_quadrature(mesh, model.quadrature)
    return _voxels_of(mesh, fixed, model.most_points)


@lru_cache(maxsize=4)
def _voxels_of(mesh: TetMesh, fixed: Image, most: int | None) -> Quadrature:
    """The rule of voxel centres; a map of intensities asks for it, too."""
    centres = fixed.grid_points().reshape(-1, 3)
    near = centres[((centres >= mesh.points.min(axis=0)) & (centres <= mesh.points.max(axis=0))).all(axis=1)]
    cells, barycentric = locate(mesh.points, mesh.cells, near)
    inside = cells >= 0
    if not inside.any():
        raise InputError("no voxel centre of the fixed image lies inside the mesh: quadrature 'voxels' has no points")
    kept = np.flatnonzero(inside)
    volume = fixed.voxel_volume * len(kept)
    if most is not None and len(kept) > most:
        kept = np.sort(np.random.default_rng(0).choice(kept, most, replace=False))
    return quadrature_at(mesh, cells[kept], barycentric[kept], np.full(len(kept), volume / len(kept)))


def seen_points(mesh: TetMesh, quadrature: Quadrature, moving: Image, fixed_ignore: Image | None = None) -> Quadrature:
    """The points that rest on the grid of the moving image, and are not ignored: what lies beyond has not been seen.

    Which points count must not depend on the displacement: a posterior could do without those that do not fit.

    Raises
    ------
    InputError
        If none is left.
    """
    positions = quadrature.positions(mesh)
    seen = moving.contains(positions)
    if fixed_ignore is not None:
        seen &= np.asarray(visibility(fixed_ignore)(jnp.asarray(positions))) > 0.5
    if not seen.any():
        raise InputError("nothing is left to compare: all of the mesh lies in fixed_ignore, or beyond the moving image")
    if seen.all():
        return quadrature
    kept = (np.asarray(part)[seen] for part in (quadrature.cells, quadrature.barycentric, quadrature.weights))
    return quadrature_at(mesh, *kept)
