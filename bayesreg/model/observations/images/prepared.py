"""A pair of images with complete options, prepared for comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Float

from bayesreg.image import Image
from bayesreg.interpolation import Interpolator
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Blocks, Coefficients, Values, scale_block
from bayesreg.model.observations.images.contrast import contrast_functions
from bayesreg.model.observations.images.discrepancies import discrepancies
from bayesreg.model.observations.images.independence import independent_scores
from bayesreg.model.observations.images.intensity_map import SHARE, shading_basis
from bayesreg.model.observations.images.likelihood import ComparedImages, Comparison, shading_name
from bayesreg.model.observations.images.linear_combination import PatchRegression
from bayesreg.model.observations.images.options import ImageOptions
from bayesreg.model.observations.images.points import (
    is_seen,
    quadrature_of,
    require_overlap,
    seen_points,
    visibility,
)
from bayesreg.model.observations.images.pointwise import Intensities
from bayesreg.model.observations.images.self_similarity import AlternatingImages, describe_self_similarity
from bayesreg.model.observations.images.unsupported import (
    NOT_COMPARED,
    Points,
    explain_unsupported,
    find_unsupported,
    mark_places,
    misfit_file,
    support_at,
    support_file,
)
from bayesreg.model.observations.observation import Maps, Placed, Recorded
from bayesreg.model.state import State
from bayesreg.settings import is_inferred
from bayesreg.types import AnyArray, InputError

# The number of quadrature points at which observed and replicated intensities are stored for ArviZ.
MOST_POINTS = 1000


@dataclass(frozen=True, eq=False)
class PreparedPair:
    """A pair of images, prepared for comparison.

    Attributes
    ----------
    fixed, moving : Image
    name : str
    fixed_ignore, moving_ignore : Image or None
    options : ImageOptions
    """

    fixed: Image
    moving: Image
    name: str
    fixed_ignore: Image | None
    moving_ignore: Image | None
    options: ImageOptions

    kind: ClassVar[str] = "images"

    def fixed_at(self, positions: Float[np.ndarray, "points 3"]) -> Float[AnyArray, "points"]:
        """Return the compared values of the fixed image at all quadrature points, mm."""
        return self.fixed.interpolate(positions, self.options.interpolation)

    def moving_function(self) -> Interpolator | AlternatingImages:
        """Return the compared values of the moving image as a function of the places of all quadrature points."""
        return self.moving.interpolator(self.options.interpolation)

    def smoothed(self, sd: float) -> PreparedPair:
        """Return the pair with smoothed images, sd in mm."""
        # SciPy's filters let other threads run.
        with ThreadPoolExecutor() as pool:
            fixed, moving = pool.map(lambda image: image.smoothed(sd), (self.fixed, self.moving))
        return replace(self, fixed=fixed, moving=moving)

    def functions(self, positions: Float[np.ndarray, "points 3"], sd: float) -> Float[np.ndarray, "points functions"]:
        """Return functions, besides a shading, whose amounts may differ between m and f, smoothed by sd, mm."""
        return np.zeros((len(positions), 0))

    def compared_at(
        self, positions: Float[np.ndarray, "points 3"], weights: Float[AnyArray, "points"], blur: float
    ) -> dict[str, Any]:
        """Return the images at all quadrature points and their similarity, by their names in `ComparedImages`.

        `blur` is the sd of the smoothing that the images have, mm.
        """
        moving, fixed_values = self.moving_function(), self.fixed_at(positions)
        rest = Intensities(fixed_values, moving(jnp.asarray(positions)), weights)
        fixed = self.fixed.interpolator(self.options.interpolation)
        similarity = self.options.similarity.on(positions, rest, fixed, blur)
        return {"moving": moving, "fixed_values": fixed_values, "similarity": similarity}

    def compared_points(self, mesh: TetMesh) -> Any:
        """Return the quadrature points that are compared.

        Raises
        ------
        InputError
            If the mesh does not overlap an image, or nothing of it is left to compare.
        """
        pair_suffix = "" if self.name == "images" else f" of {self.name!r}"
        require_overlap(mesh, self.fixed, f"fixed image{pair_suffix}")
        require_overlap(mesh, self.moving, f"moving image{pair_suffix}")
        return seen_points(mesh, quadrature_of(mesh, self.fixed, self.options), self.moving, self._visible_of_fixed)

    @property
    def _visible_of_fixed(self) -> Interpolator | None:
        return None if self.fixed_ignore is None else visibility(self.fixed, self.fixed_ignore)

    def on(self, mesh: TetMesh) -> Placed:
        """Place the pair on a mesh; see `ImagePair.on`."""
        quadrature, options = self.compared_points(mesh), self.options
        positions = quadrature.positions(mesh)
        compared = self._smoothed_by_options().compared_at(positions, quadrature.weights, self._smoothing_sd)
        term = ComparedImages(
            comparison=Comparison(self.name, is_inferred(options.similarity.temperature), self.temperature_name),
            **compared,
            quadrature=quadrature,
            nodes=jnp.asarray(mesh.cells[np.asarray(quadrature.cells)]),
            positions=jnp.asarray(positions),
            independent_share=jnp.asarray(_independent_share(self.name, options, len(positions))),
            shading=self._shading(np.asarray(compared["fixed_values"]), positions),
            visible=None if self.moving_ignore is None else visibility(self.moving, self.moving_ignore),
        )
        blocks = self._blocks(term)
        if self.is_tempered_by_residuals and options.similarity.has_noisy_slopes:
            # A search without tempering would follow the noise.
            values = {self.temperature_name: blocks[self.temperature_name].reference()}
            count = self.count_independent_points(term, jnp.zeros(mesh.points.shape), values)
            term = term.with_independent_points(count)
        return Placed(self, term, blocks)

    @property
    def temperature_name(self) -> str:
        """The name of the block of T_s."""
        return "t_similarity" if self.name == "images" else f"{self.name}_t_similarity"

    def _blocks(self, term: ComparedImages) -> Blocks:
        """Make the block of T_s, and the block of the coefficients of a shading if there is one."""
        blocks: Blocks = {self.temperature_name: scale_block(self.options.similarity.temperature)}
        if term.shading is not None:
            blocks[shading_name(self.name)] = Coefficients(jnp.full(term.shading.shape[1], SHARE))
        return blocks

    def _shading(
        self, fixed_values: Float[np.ndarray, "points"], positions: Float[np.ndarray, "points 3"]
    ) -> Float[AnyArray, "points coefficients"] | None:
        degree, functions = self.options.intensity_map, self.functions(positions, self._smoothing_sd)
        if degree is None and not functions.shape[1]:
            return None
        return jnp.asarray(shading_basis(fixed_values, positions, degree or 0, functions))

    @property
    def _smoothing_sd(self) -> float:
        """The sd of the smoothing of both images that the options ask for, mm."""
        return self.options.smoothing * max(image.voxel_volume for image in (self.fixed, self.moving)) ** (1 / 3)

    def _smoothed_by_options(self) -> PreparedPair:
        return _kept_smoothed(self, self._smoothing_sd) if self.options.smoothing else self

    # For the judgement of the fit

    def describe(self, term: ComparedImages, state: State) -> dict[str, float]:
        """Describe the noise and the residual at a state.

        "noise_sd" is the sd that T_s implies at a point of average weight; "residual_sd" is that of the residual.
        "residual_to_noise" is the ratio of the residual to the noise that T_s implies: a ratio of sds, or of medians
        with heavy tails, since a few outliers with small weights would dominate the sd.
        """
        z = np.asarray(term.scaled_residual(state.u, state.values))
        similarity = self.options.similarity
        if similarity.has_heavy_tails:
            ratio = np.median(np.abs(z)) / similarity.noise()[1].ppf(0.75)
        else:
            ratio = np.std(z) / np.sqrt(term.similarity.variance())
        return {
            "noise_sd": term.noise_sd(float(term.temperature(state.values))),
            "residual_sd": float(np.std(term.residuals(state.u, state.values))),
            "residual_to_noise": float(ratio),
        }

    def check_draw(self, term: ComparedImages, state: State, key: AnyArray) -> dict[str, AnyArray]:
        """Compute the discrepancies of the residuals at a draw, "observed", and of simulated noise, "replicated"."""
        mesh, cells = state.mesh, term.quadrature.cells
        z = term.scaled_residual(state.u, state.values)
        noise = term.standardised_noise(key, state.u, state.values)
        return {
            name: discrepancies(x, cells, jnp.asarray(mesh.neighbours), len(mesh.cells))
            for name, x in (("observed", z), ("replicated", noise))
        }

    def summarise(self, posterior: Any, state: State, draws: Values) -> dict[str, np.ndarray]:
        """Return the residual at a state, in units of the noise, the tissue of each of its points, and their support.

        For the support see `find_unsupported`; `misfit_places` (k, 3) are the displaced points of the regions of
        misfit, mm.
        """
        mesh, term = posterior.mesh, posterior.data.terms[self.name]
        residual = np.asarray(term.scaled_residual(state.u, state.values))
        places = np.asarray(term.places(state.u))
        share = np.ones(len(places)) if term.visible is None else np.asarray(term.visible(places))
        quadrature = quadrature_of(mesh, self.fixed, self.options)
        seen = is_seen(mesh, quadrature, self.moving, self._visible_of_fixed)
        positions = np.asarray(quadrature.positions(mesh))
        support = find_unsupported(Points.where(seen, positions, residual, share, np.asarray(quadrature.weights)))
        return {
            "residual": residual.astype(np.float32),
            "residual_tissue": mesh.tissue[np.asarray(term.quadrature.cells)].astype(np.int8),
            "misfit_places": places[support_at(support, positions[seen]) > NOT_COMPARED].astype(np.float32),
            **support,
        }

    def doubts(self, summary: Mapping[str, np.ndarray]) -> list[str]:
        """Return sentences on places that the images do not support; see `explain_unsupported`."""
        return explain_unsupported(summary, self.name)

    def maps(self, summary: Mapping[str, np.ndarray]) -> Maps:
        """Return the map of the support, and the mask of the regions of misfit in the moving image if there are any."""
        support = Image(summary["support"], summary["support_affine"])
        places = np.asarray(summary["misfit_places"], float)
        marked = {misfit_file(self.name): mark_places(places, self.moving)} if len(places) else {}
        return Maps({support_file(self.name): support}, marked)

    def recorded(self, term: ComparedImages) -> Recorded:
        """Return the compared intensities of f at up to 1,000 evenly spaced quadrature points."""
        points = np.linspace(0, len(term.positions) - 1, min(len(term.positions), MOST_POINTS)).round().astype(int)
        position_attributes = {"units": "mm", "long_name": "position of the point in the fixed image, world RAS"}
        dim, positions = f"{self.name}_point", zip("xyz", np.asarray(term.positions)[points].T, strict=True)
        coords = {dim: points} | {
            f"{self.name}_{axis}": (dim, position, position_attributes) for axis, position in positions
        }
        attributes = {"units": "1", "long_name": "intensity of the fixed image, as it is compared"}
        return Recorded(xr.DataArray(np.asarray(term.fixed_values)[points], coords, [dim], attrs=attributes), points)

    # For the search for the mode

    def smoothed_term(self, term: ComparedImages, sd: float) -> ComparedImages:
        """Return the term with further smoothed images, sd in mm."""
        smooth = self._smoothed_by_options().smoothed(sd)
        return term._replace(
            **smooth.compared_at(
                np.asarray(term.positions), term.quadrature.weights, math.hypot(sd, self._smoothing_sd)
            )
        )

    @property
    def is_weak(self) -> bool:
        """Whether the images say little about each place, so that the search must not begin with a stiff prior."""
        return self.options.similarity.has_noisy_slopes

    @property
    def is_tempered_by_residuals(self) -> bool:
        """Whether residuals determine the number of independent quadrature points."""
        return self.options.independent_points == "residual"

    def count_independent_points(self, term: ComparedImages, u: Float[AnyArray, "nodes 3"], values: Values) -> float:
        """Count the independent quadrature points, from the residuals at these values.

        See `independent_scores` and, for linear combinations in patches, `independent_blocks`.
        """
        if isinstance(term.similarity, PatchRegression):
            return term.count_by_blocks(u, values, term.similarity.blocks)
        voxels = np.rint(self.fixed.world_to_voxel(np.asarray(term.positions))).astype(int)
        return independent_scores(np.asarray(term.scores(u, values)), voxels, self.fixed)


@dataclass(frozen=True, eq=False)
class MappedPair(PreparedPair):
    """A pair whose fixed image was converted to the contrast of the moving one.

    Attributes
    ----------
    source : Image
        The fixed image itself, of whose intensities the map is a function.
    tissue : Image or None
    """

    source: Image
    tissue: Image | None

    def functions(self, positions: Float[np.ndarray, "points 3"], sd: float) -> Float[np.ndarray, "points functions"]:
        """Return the functions of the map; their amounts are inferred with all other unknowns."""
        return contrast_functions(self.source, positions, sd, self.tissue)


@dataclass(frozen=True, eq=False)
class SelfSimilarPair(PreparedPair):
    """A pair that is compared by descriptors of its images (`self_similarity`).

    Attributes
    ----------
    descriptors : tuple of (Image, Image)
        Those of f and of m, which quadrature points compare in turn.
    """

    descriptors: tuple[tuple[Image, Image], ...]

    def fixed_at(self, positions: Float[np.ndarray, "points 3"]) -> Float[AnyArray, "points"]:
        """Return the descriptors of f, one at each point."""
        functions = [fixed.interpolator(self.options.interpolation) for fixed, _ in self.descriptors]
        return AlternatingImages.of(functions)(jnp.asarray(positions))

    def moving_function(self) -> AlternatingImages:
        """Return the descriptors of m, one at each point."""
        return AlternatingImages.of([moving.interpolator(self.options.interpolation) for _, moving in self.descriptors])

    def smoothed(self, sd: float) -> SelfSimilarPair:
        """Return the pair with smoothed descriptors, sd in mm."""
        with ThreadPoolExecutor() as pool:
            smooth = pool.map(lambda two: (two[0].smoothed(sd), two[1].smoothed(sd)), self.descriptors)
            return replace(self, descriptors=tuple(smooth))


@lru_cache(maxsize=4)
def _kept_smoothed(pair: PreparedPair, sd: float) -> PreparedPair:
    return pair.smoothed(sd)


def describe_pair(pair: PreparedPair) -> SelfSimilarPair:
    """Convert a pair to one that is compared by the self-similarity of its images."""
    axes, distance = pair.fixed.axes, max(float(image.voxel_sizes.max()) for image in (pair.fixed, pair.moving))
    fixed, moving = (describe_self_similarity(image, axes, distance) for image in (pair.fixed, pair.moving))
    return SelfSimilarPair(**vars(pair), descriptors=tuple(zip(fixed, moving, strict=True)))


def _independent_share(name: str, options: ImageOptions, points: int) -> float:
    """Return the effective number of independent quadrature points over the number of all.

    Raises
    ------
    InputError
        If there are fewer points than are said to be independent.
    """
    count = options.independent_points
    # The residuals are known later; see `Posterior.count_independent_points`.
    if count is None or count == "residual":
        return 1.0
    if count > points:
        raise InputError(
            f"{name}: independent_points is {count:g}, but the quadrature has {points} points; give at most as many, "
            "or null for all"
        )
    return count / points
