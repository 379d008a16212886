"""A pair of images as an observation, and the points at which it is compared."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from bayesreg.fem.elements import GAUSS_SUBDIVISIONS, Quadrature, gauss_quadrature, quadrature_at
from bayesreg.fem.location import locate
from bayesreg.ignored import fill_ignored, ignored_voxels
from bayesreg.image import Image
from bayesreg.interpolation import Interpolation, Interpolator
from bayesreg.mesh import TetMesh
from bayesreg.model.contrast import contrast_functions, map_contrast
from bayesreg.model.intensity_map import shading_basis
from bayesreg.model.options import OF_ANY_CONTRAST, ModelConfig, TemperaturePrior
from bayesreg.model.pointwise import Intensities
from bayesreg.model.self_similarity import InTurn, describe_self_similarity
from bayesreg.model.similarity import SIMILARITIES
from bayesreg.model.terms.images import ComparedImages, Comparison
from bayesreg.types import AnyArray, InputError


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
        if self.tissue is not None and not (
            self.tissue.shape == self.fixed.shape and np.allclose(self.tissue.affine, self.fixed.affine, atol=1e-3)
        ):
            raise InputError(f"{self.name}: tissue must lie on the grid of the fixed image, and lies on another")
        for which in ("fixed", "moving", "fixed_ignore", "moving_ignore"):
            given = getattr(self, which)
            if not isinstance(given, Image) and (given is not None or which in ("fixed", "moving")):
                raise InputError(f"{self.name}: {which} must be an Image, got {type(given).__name__}; see load_image")

    def prepared(self, mesh: TetMesh, model: ModelConfig) -> ImagePair:
        """The pair as the options compare it: f in the contrast of m, as far as a map tells at rest, or descriptors.

        What is ignored is filled with what lies beside it.

        Raises
        ------
        InputError
            As `on`.
        """
        fixed, moving = fill_ignored(self.fixed, self.fixed_ignore), fill_ignored(self.moving, self.moving_ignore)
        return replace(self, fixed=fixed, moving=moving)._contrasted(mesh, model)

    def _contrasted(self, mesh: TetMesh, model: ModelConfig) -> ImagePair:
        if model.similarity == "mind":
            return _self_similar(self)
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

    def fixed_at(
        self, positions: Float[np.ndarray, "points 3"], interpolation: Interpolation
    ) -> Float[AnyArray, "points"]:
        """What is compared of the fixed image at all quadrature points, mm."""
        return self.fixed.interpolate(positions, interpolation)

    def moving_by(self, interpolation: Interpolation) -> Interpolator | InTurn:
        """What is compared of the moving image, as a function of the places of all quadrature points."""
        return self.moving.interpolator(interpolation)

    def smoothed(self, sd: float) -> ImagePair:
        """The pair with what is compared smoothed, sd in mm."""
        # SciPy's filters let other threads run.
        with ThreadPoolExecutor() as pool:
            fixed, moving = pool.map(lambda image: image.smoothed(sd), (self.fixed, self.moving))
        return replace(self, fixed=fixed, moving=moving)

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
        visible = None if self.fixed_ignore is None else visibility(self.fixed, self.fixed_ignore)
        return seen_points(mesh, quadrature_of(mesh, self.fixed, model), self.moving, visible)

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
        moving = smooth.moving_by(model.interpolation)
        fixed_values = smooth.fixed_at(positions, model.interpolation)
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
            visible=None if self.moving_ignore is None else visibility(self.moving, self.moving_ignore),
        )

    def smoothing_sd(self, model: ModelConfig) -> float:
        """By how much the options smooth both images, mm."""
        return model.smoothing * max(image.voxel_volume for image in (self.fixed, self.moving)) ** (1 / 3)

    def smoothed_as(self, model: ModelConfig) -> ImagePair:
        """The pair with both images smoothed as the options say."""
        return _smoothed_as(self, self.smoothing_sd(model)) if model.smoothing else self

    def smooth_term(self, term: ComparedImages, sd: float, interpolation: Interpolation) -> ComparedImages:
        """The term with what is compared smoothed, sd in mm."""
        smooth = self.smoothed(sd)
        fixed_values = smooth.fixed_at(np.asarray(term.positions), interpolation)
        return term._replace(moving=smooth.moving_by(interpolation), fixed_values=fixed_values)


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


@dataclass(frozen=True, eq=False)
class SelfSimilarPair(ImagePair):
    """A pair that is compared by descriptors of its images (`bayesreg.model.self_similarity`).

    Attributes
    ----------
    descriptors : tuple of (Image, Image)
        Those of f and of m, which quadrature points compare in turn.
    """

    descriptors: tuple[tuple[Image, Image], ...] = ()

    def fixed_at(
        self, positions: Float[np.ndarray, "points 3"], interpolation: Interpolation
    ) -> Float[AnyArray, "points"]:
        """The descriptors of f, one at each point."""
        return InTurn.of([fixed.interpolator(interpolation) for fixed, _ in self.descriptors])(jnp.asarray(positions))

    def moving_by(self, interpolation: Interpolation) -> InTurn:
        """The descriptors of m, one at each point."""
        return InTurn.of([moving.interpolator(interpolation) for _, moving in self.descriptors])

    def smoothed(self, sd: float) -> SelfSimilarPair:
        """The pair with its descriptors smoothed, sd in mm."""
        with ThreadPoolExecutor() as pool:
            smooth = pool.map(lambda two: (two[0].smoothed(sd), two[1].smoothed(sd)), self.descriptors)
            return replace(self, descriptors=tuple(smooth))


def visibility(image: Image, ignore: Image) -> Interpolator:
    """1 where an image is looked at and 0 where it is ignored, as a function of the place.

    The neighbours of an ignored voxel are ignored with it: they may hold some of what it holds.
    """
    ignored = ndimage.binary_dilation(ignored_voxels(image, ignore), ndimage.generate_binary_structure(3, 3))
    return image.with_voxels(1.0 - ignored).interpolator("linear")


@lru_cache(maxsize=4)
def _smoothed_as(pair: ImagePair, sd: float) -> ImagePair:
    return pair.smoothed(sd)


def _self_similar(pair: ImagePair) -> SelfSimilarPair:
    axes, distance = pair.fixed.axes, max(float(image.voxel_sizes.max()) for image in (pair.fixed, pair.moving))
    fixed, moving = (describe_self_similarity(image, axes, distance) for image in (pair.fixed, pair.moving))
    given = {field.name: getattr(pair, field.name) for field in fields(ImagePair)}
    return SelfSimilarPair(**given, descriptors=tuple(zip(fixed, moving, strict=True)))


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


def seen_points(
    mesh: TetMesh, quadrature: Quadrature, moving: Image, visible: Interpolator | None = None
) -> Quadrature:
    """The points that rest on the grid of the moving image, and are visible: what lies beyond has not been seen.

    Which points count must not depend on the displacement: a posterior could do without those that do not fit.

    Raises
    ------
    InputError
        If none is left.
    """
    positions = quadrature.positions(mesh)
    seen = moving.contains(positions)
    if visible is not None:
        seen &= np.asarray(visible(jnp.asarray(positions))) > 0.5
    if not seen.any():
        raise InputError("nothing is left to compare: all of the mesh lies in fixed_ignore, or beyond the moving image")
    if seen.all():
        return quadrature
    kept = (np.asarray(part)[seen] for part in (quadrature.cells, quadrature.barycentric, quadrature.weights))
    return quadrature_at(mesh, *kept)
