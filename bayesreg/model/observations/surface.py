"""A surface as an observation: points that were measured on the moved surface of an organ, without partners.

A stereo camera, a laser scanner or a tracked pointer measures where a part of the surface is now, and not which place
of the organ is there. `bayesreg.model.observations.measured_surface` has the term.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Bool, Float
from pydantic import Field
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from bayesreg.image import Image
from bayesreg.io.points import read_points
from bayesreg.io.records import Inputs
from bayesreg.io.surface_files import SUFFIXES, read_surface
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Values, scale_block
from bayesreg.model.observations.landmarks import MOST, ROBUST
from bayesreg.model.observations.level_set import cell_table, distance_from_mask, distance_from_mesh, grid_around
from bayesreg.model.observations.measured_surface import MeasuredSurface
from bayesreg.model.observations.observation import Placed, Recorded
from bayesreg.model.observations.odd_points import lie_near, other_readings, require_extent, suspect_reading
from bayesreg.model.observations.point_noise import Noise
from bayesreg.model.observations.section import Arrays, Name, ObservationSection, ReportFigure, ReportTable
from bayesreg.model.observations.surface_report import describe_far_surface, height_figure, surface_table
from bayesreg.model.state import State
from bayesreg.model.term import Label
from bayesreg.settings import FoundFile, KnownOrInferred, ScalePrior
from bayesreg.tissues import is_fluid
from bayesreg.types import InputError

BOUNDARY = "boundary"
# The prior of an sd of which nothing is told, mm: its 95 % interval is 0.1 to 5 mm.
UNKNOWN_SD = ScalePrior(median=0.7, log_sd=1.0)
# The least number of points, and the greatest number whose pairs are compared, chosen at random.
FEWEST, MOST_COMPARED = 10, 3000
# The number of steps of distance over which the correlation of residuals is looked for.
LAGS = 60


class Surface:
    """Points on the moved surface of the organ, or of some of its tissues, without partners.

    log p = κ Σ_k log t(φ_k / sd), with Student's t or a Normal density. φ_k is the signed distance from the surface at
    rest of the place that the displacement takes to point k. Neighbouring points share the inexactness of the surface
    at rest and of the mesh. Their residuals determine κ, the share of points that are independent.

    Parameters
    ----------
    points : (k, 3) array
        World RAS mm, in the space of the moving image; at least `FEWEST`.
    of : str or sequence of str, default "boundary"
        The names of tissues whose common surface is meant; "boundary" is that of the whole organ without the fluid
        around it. Folds are bridged (`bayesreg.model.observations.level_set`).
    sd : float or ScalePrior
        Standard deviation of the error along the normal, mm, the inexactness of the surface at rest included; or its
        prior, to infer it as "<name>_sd".
    noise : StudentTNoise or NormalNoise, default Student's t with ν = 4
        The distribution of the errors.
    tissue : Image, optional
        Labels in the space of the fixed image: 0 outside, 1 + index into the names of the mesh's tissues inside. Their
        surface is more exact than that of the mesh, which is taken without them.
    name : str, default "surface"

    Raises
    ------
    InputError
        If the points are no finite numbers of shape (k, 3), or too few, or an sd is not positive.
    """

    kind = "surface"
    is_tempered_by_residuals = True

    def __init__(
        self,
        points: Any,
        of: str | Sequence[str] = BOUNDARY,
        sd: float | ScalePrior = UNKNOWN_SD,
        noise: Noise = ROBUST,
        tissue: Image | None = None,
        name: str = "surface",
    ) -> None:
        self.points = np.asarray(points, float)
        if self.points.ndim != 2 or self.points.shape[1] != 3 or len(self.points) < FEWEST:
            raise InputError(
                f"{name}: expected {FEWEST} points or more, in an array of shape (k, 3); got one of {self.points.shape}"
            )
        if not np.isfinite(self.points).all():
            raise InputError(f"{name}: every coordinate must be a finite number")
        if (distinct := len(np.unique(self.points, axis=0))) < FEWEST:
            raise InputError(f"{name}: expected {FEWEST} different points or more, got {distinct}")
        self.prior = sd if isinstance(sd, ScalePrior) else None
        self.sd = sd.median if isinstance(sd, ScalePrior) else float(sd)
        if not (np.isfinite(self.sd) and self.sd > 0):
            raise InputError(f"{name}: sd must be positive, mm; got {sd}")
        self.of = (of,) if isinstance(of, str) else tuple(of)
        self.noise, self.tissue, self.name = noise, tissue, name

    def on(self, mesh: TetMesh, preset: str = "paper") -> Placed:
        """Place the points around a mesh.

        Raises
        ------
        InputError
            If the mesh has no such tissue, or no point lies near it.
        """
        chosen = self._tissues(mesh.names)
        self._require_near(mesh)
        grid = grid_around(mesh, self.points)
        if self.tissue is None:
            distance = distance_from_mesh(mesh, chosen[mesh.tissue], grid)
        else:
            distance = distance_from_mask(self.mask(self.tissue, mesh.names))
        scale = f"{self.name}_sd"
        term = MeasuredSurface(
            label=Label(self.name),
            noise=self.noise,
            scale=None if self.prior is None else Label(scale),
            points=jnp.asarray(self.points),
            distance=distance,
            table=cell_table(mesh, grid),
            cells=jnp.asarray(mesh.cells),
            rest=jnp.asarray(mesh.points),
            known_sd=jnp.asarray(self.sd),
            wider=jnp.zeros(()),
            independent_points=jnp.asarray(float(len(self.points))),
        )
        return Placed(self, term, {} if self.prior is None else {scale: scale_block(self.prior)})

    def _require_near(self, mesh: TetMesh) -> None:
        """Raise InputError if most points lie further from the organ than half of its size, or near it if read anew."""
        require_extent(self.name, mesh, self.points)
        grids = {} if self.tissue is None else {"the labels": self.tissue}
        near = lie_near(mesh, self.points)
        suspicion = suspect_reading(near, other_readings(mesh, self.points, grids))
        away = float(np.median(cKDTree(mesh.points).query(self.points)[0]))
        is_far = away > np.ptp(mesh.points, axis=0).max() / 2
        if is_far or (suspicion and near.mean() < MOST):
            question = "are they in mm, and in the coordinates of its image"
            raise InputError(
                f"{self.name}: half of its points lie more than {away:.0f} mm away from the organ; "
                f"{suspicion or question}; data.pose: unknown aligns a surface of other coordinates"
            )

    def mask(self, tissue: Image, names: Sequence[str]) -> Image:
        """Mark the tissues whose surface is meant, in labels that are 0 outside and 1 + index into the names inside."""
        return tissue.with_voxels(np.append(False, self._tissues(names))[np.asarray(tissue.voxels, int)])

    def _tissues(self, names: Sequence[str]) -> Bool[np.ndarray, "tissues"]:
        if self.of == (BOUNDARY,):
            solid = np.array([not is_fluid(name) for name in names])
            return solid if solid.any() else ~solid
        if unknown := [name for name in self.of if name not in names]:
            raise InputError(
                f"{self.name}: of: the mesh has no tissue {unknown[0]}; expected {BOUNDARY} or some of "
                f"{', '.join(names)}"
            )
        return np.isin(names, self.of)

    def smoothed_term(self, term: MeasuredSurface, sd: float) -> MeasuredSurface:
        """Return the term with a wider error: the points draw the surface from further off."""
        return term._replace(wider=jnp.asarray(sd))

    def count_independent_points(self, term: MeasuredSurface, u: Float[np.ndarray, "nodes 3"], values: Values) -> float:
        """Count the independent points, from the correlation of their forces on the displacement."""
        return count_independent(np.asarray(term.score(jnp.asarray(u), values)), self.points)

    def summarise(self, posterior: Any, state: State, draws: Values) -> dict[str, np.ndarray]:
        """Summarise the heights of the points over the surface at rest and at a state, and which points are wrong."""
        term = posterior.data.terms[self.name]
        height = np.asarray(term.height(state.u))
        sd = float(term.sd(state.values))
        summary = {
            "points": self.points,
            "height": height,
            "height_at_rest": np.asarray(term.height(jnp.zeros_like(term.rest))),
            "sd": np.asarray(sd),
            "independent": np.asarray(term.independent_points),
        }
        wrong = self.noise.probability_of_wrong((height / sd) ** 2, 1)
        return summary if wrong is None else summary | {"wrong": wrong}

    def doubts(self, summary: Mapping[str, np.ndarray]) -> list[str]:
        """Say so where many points do not lie on the moved surface, for the terminal and the report's first page."""
        return describe_far_surface(self.name, summary)

    def recorded(self, term: MeasuredSurface) -> Recorded:
        """Return the observed zeros: every point lies on the surface."""
        coords = {f"{self.name}_point": np.arange(1, len(self.points) + 1)}
        attributes = {"units": "mm", "long_name": "error of the points along the normal of the surface"}
        return Recorded(xr.DataArray(np.zeros(len(self.points)), coords, list(coords), attrs=attributes))


def count_independent(scores: Float[np.ndarray, "k axes"], points: Float[np.ndarray, "k 3"]) -> float:
    """Count the independent points of a sum of scores: k over 1 + (k − 1) ρ̄, from the variance of the sum.

    ρ̄ is the mean over all pairs of the correlation at their distance, summed over the axes, up to the first distance at
    which it is not positive (as `bayesreg.model.observations.images.independence.independent_scores` has it on grids).

    Raises
    ------
    InputError
        If all scores are zero.
    """
    count = len(points)
    if count > MOST_COMPARED:
        compared = np.random.default_rng(0).choice(count, MOST_COMPARED, replace=False)
        scores, points = scores[compared], points[compared]
    variance = (scores**2).sum(axis=1).mean()
    if not variance > 0:
        raise InputError("the residual is zero at every point: nothing tells how it is correlated")
    distances = pdist(points)
    first, second = np.triu_indices(len(points), 1)
    products = np.einsum("pi,pi->p", scores[first], scores[second])
    lag = np.minimum((distances / distances.max() * LAGS).astype(int), LAGS - 1)
    by_lag = np.bincount(lag, products, LAGS)
    gaps = np.flatnonzero(by_lag <= 0)
    mean_correlation = by_lag[: gaps[0] if len(gaps) else LAGS].sum() / len(products) / variance
    return float(count / (1 + (count - 1) * max(mean_correlation, 0.0)))


class SurfaceSection(ObservationSection):
    """Points on the moved surface of the organ or of a tissue, without partners."""

    title = "points on a surface"

    kind: Literal["surface"] = "surface"
    name: Name = "surface"
    """The name of the observation in tables; two observations need two."""
    file: FoundFile
    """Points or a mesh of the surface in the space of the moving image (.ply, .stl, .vtk, .vtp, .obj, .csv, .fcsv,
    .mrk.json)."""
    of: str | Annotated[list[str], Field(min_length=1)] = BOUNDARY
    """The tissues whose common surface was measured; boundary is the surface of the whole organ."""
    sd: KnownOrInferred = UNKNOWN_SD
    """Sd of the error along the normal of the surface, mm, or its prior."""
    noise: Noise = ROBUST
    """The distribution of the errors: student_t, with a few large ones, or normal."""

    def read(self) -> dict[str, np.ndarray]:
        """Read the points, world RAS mm; points of a mesh that coincide count once."""
        if self.file.suffix.lower() in SUFFIXES:
            return {"points": np.unique(read_surface(self.file).points, axis=0)}
        return {"points": read_points(self.file).points}

    def observe(self, inputs: Inputs) -> Sequence[Surface]:
        """Make the surface; its points are transformed into the world of the fixed image."""
        points = inputs.matching.pose.inverse.place(inputs.observed[self.name]["points"])
        return [Surface(points, self.of, self.sd, self.noise, inputs.tissue, self.name)]

    @classmethod
    def explain(cls, name: str, described: Mapping[str, Any]) -> str:
        """Return a sentence that explains the term."""
        return (
            f"{name}: the place of the organ that has moved to a measured point lies on the surface at rest, up to an "
            "error along the normal; no partner is told"
        )

    @classmethod
    def tables(cls, name: str, summary: Arrays) -> list[ReportTable]:
        """Return a table of the distances from the surface, before and after."""
        return [surface_table(name, summary)] if "height" in summary else []

    @classmethod
    def figures(
        cls, name: str, summary: Arrays, tissues: Sequence[str], described: Mapping[str, Any]
    ) -> list[ReportFigure]:
        """Return a map of the heights of the points over the moved surface."""
        return [height_figure(name, summary)] if "height" in summary else []
