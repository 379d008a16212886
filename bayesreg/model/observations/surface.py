"""A surface as an observation: measured points that lie on the moved surface of the organ, without partners.

A stereo camera, a laser scanner or a tracked pointer measures where a part of the surface is now, and not which place
of the organ is there. The places are summed out: a measured point y comes from a place that is equally likely
everywhere on the surface S of area A, with a Normal error of sd, or, with the probability π, from anywhere in a box of
the volume V,

p(y | u) = (1 − π)/A ∫_{S(u)} N(y; x, sd² I) dx + π/V.

The integral over a flat triangle is N(h; 0, sd²) times the share of a Normal density in the plane that falls within the
triangle, h being the distance from the plane. With three distances d_e from the edges, positive inside, this share is
about ∏_e Φ(d_e / sd): exact beside an edge, where the shares of both triangles add up to one. At a node with six
triangles, and within sd of it, the shares add up to 1.5 at most. What was not seen says nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, logsumexp
from jaxtyping import Float, Int
from pydantic import Field
from scipy.spatial import cKDTree

from bayesreg.fem.location import closest_in_triangles
from bayesreg.io.points import read_points
from bayesreg.io.records import Inputs
from bayesreg.io.surface_files import SUFFIXES, read_surface
from bayesreg.mesh import TetMesh, boundary_faces_of
from bayesreg.model.blocks import Values, scale_block
from bayesreg.model.observations.observation import Placed
from bayesreg.model.observations.section import Arrays, Name, ObservationSection, ReportTable
from bayesreg.model.state import State
from bayesreg.model.term import Label, PointCurvature
from bayesreg.settings import FoundFile, KnownOrInferred, ScalePrior
from bayesreg.types import AnyArray, InputError, Scalar

_log = logging.getLogger(__name__)

# The number of triangles that may hold the place of a point: those whose centres are nearest to it at rest. 64 of the
# usual size reach 20 mm along the surface.
CANDIDATES = 64
# The number of triangles, those of the greatest probability, that give a point its curvature.
CURVED = 4
# The box of wrong points is wider than the points and the surface by this share of its sides.
WIDER = 0.1
UNKNOWN_SD = ScalePrior(median=0.7, log_sd=1.0)
BOUNDARY = "boundary"


class Surface:
    """Points on the moved surface of the organ, or of some of its tissues, without partners.

    Parameters
    ----------
    points : (k, 3) array
        Measured points y, world RAS mm, in the space of the moving image.
    of : str or sequence of str, default "boundary"
        The names of tissues whose common surface is meant; "boundary" is the surface of the whole mesh.
    sd : float or ScalePrior
        Standard deviation of the error along the normal, mm, the inexactness of the mesh included; or its prior, to
        infer it as "<name>_sd".
    outliers : float, default 0.05
        π, the share of points that are expected to lie elsewhere, 0 < π < 1.
    name : str, default "surface"

    Raises
    ------
    InputError
        If the points are no finite numbers of shape (k, 3), or a share or an sd is out of range.
    """

    kind = "surface"

    def __init__(
        self,
        points: Any,
        of: str | Sequence[str] = BOUNDARY,
        sd: float | ScalePrior = UNKNOWN_SD,
        outliers: float = 0.05,
        name: str = "surface",
    ) -> None:
        self.points = np.asarray(points, float)
        if self.points.ndim != 2 or self.points.shape[1] != 3 or not len(self.points):
            raise InputError(f"{name}: points must have shape (k, 3), got {self.points.shape}")
        if not np.isfinite(self.points).all():
            raise InputError(f"{name}: every coordinate must be a finite number")
        if not 0 < outliers < 1:
            raise InputError(f"{name}: outliers is a share between 0 and 1, got {outliers}")
        self.prior = sd if isinstance(sd, ScalePrior) else None
        self.sd = sd.median if isinstance(sd, ScalePrior) else float(sd)
        if not (np.isfinite(self.sd) and self.sd > 0):
            raise InputError(f"{name}: sd must be positive, mm; got {sd}")
        self.of = (of,) if isinstance(of, str) else tuple(of)
        self.outliers, self.name = outliers, name

    def on(self, mesh: TetMesh, preset: str = "paper") -> Placed:
        """Place the points beside the surface of a mesh; InputError if it has no such tissue."""
        faces = self._faces(mesh)
        corners = mesh.points[faces]
        count = min(CANDIDATES, len(faces))
        near = cKDTree(corners.mean(axis=1)).query(self.points, k=count)[1].reshape(len(self.points), count)
        area = float(np.linalg.norm(_normals(corners), axis=1).sum() / 2)
        around = np.vstack([self.points, corners.reshape(-1, 3)])
        volume = float(np.prod((1 + WIDER) * np.ptp(around, axis=0)))
        scale = f"{self.name}_sd"
        term = MeasuredSurface(
            label=Label(self.name),
            scale=None if self.prior is None else Label(scale),
            points=jnp.asarray(self.points),
            triangles=jnp.asarray(faces[near]),
            rest=jnp.asarray(mesh.points),
            known_sd=jnp.asarray(self.sd),
            wider=jnp.zeros(()),
            log_inside=jnp.asarray(np.log((1 - self.outliers) / area)),
            log_outside=jnp.asarray(np.log(self.outliers / volume)),
        )
        return Placed(self, term, {} if self.prior is None else {scale: scale_block(self.prior)})

    def _faces(self, mesh: TetMesh) -> Int[np.ndarray, "faces 3"]:
        if self.of == (BOUNDARY,):
            return mesh.boundary_faces
        if unknown := [name for name in self.of if name not in mesh.names]:
            raise InputError(
                f"{self.name}: of: {unknown[0]} is no tissue of the mesh; expected {BOUNDARY} or some of "
                f"{', '.join(mesh.names)}"
            )
        chosen = np.isin(mesh.tissue, [mesh.names.index(name) for name in self.of])
        if not chosen.any():
            raise InputError(f"{self.name}: the mesh has no cells of {', '.join(self.of)}")
        return boundary_faces_of(mesh.cells[chosen])

    def smoothed_term(self, term: MeasuredSurface, sd: float) -> MeasuredSurface:
        """Return the term with a wider error: the surface draws from further off."""
        return term._replace(wider=jnp.asarray(sd))

    def summarise(self, posterior: Any, state: State) -> dict[str, np.ndarray]:
        """Summarise the distances from the surface at rest and at a state, and the probabilities of wrong points."""
        term = posterior.data.terms[self.name]
        return {
            "points": self.points,
            "distance": np.asarray(term.distance(state.u)),
            "distance_at_rest": np.asarray(term.distance(jnp.zeros_like(term.rest))),
            "wrong": np.asarray(1 - jnp.exp(logsumexp(term.log_shares(state.u, state.values), axis=1))),
            "sd": np.asarray(term.sd(state.values)),
        }


class MeasuredSurface(NamedTuple):
    """Measured points beside the surface of a mesh (a pytree).

    Attributes
    ----------
    label : Label
    scale : Label or None
        Name of the block with the sd; None if it is known.
    points : (k, 3) array
        y, mm.
    triangles : (k, t, 3) int array
        Nodes of the triangles on which the place of each point may lie.
    rest : (n, 3) array
        Nodes at rest, mm.
    known_sd : scalar
        The sd, mm; if it is inferred, the median of its prior.
    wider : scalar
        Another sd, added in squares; zero except in the search for a mode.
    log_inside, log_outside : scalars
        log((1 − π)/A) and log(π/V).
    """

    label: Label
    scale: Label | None
    points: Float[AnyArray, "k 3"]
    triangles: Int[AnyArray, "k t 3"]
    rest: Float[AnyArray, "n 3"]
    known_sd: Scalar
    wider: Scalar
    log_inside: Scalar
    log_outside: Scalar

    @property
    def is_nearly_quadratic(self) -> bool:
        """Whether the log is nearly quadratic in the displacements; it is not."""
        return False

    @property
    def name(self) -> str:
        """The name of the term."""
        return self.label.name

    @property
    def powers(self) -> dict[str, float]:
        """The temperatures of this term: none."""
        return {}

    def sd(self, values: Values) -> Scalar:
        """Return the sd, mm."""
        sd = self.known_sd if self.scale is None else jnp.asarray(values[self.scale.name])
        return jnp.sqrt(sd**2 + self.wider**2)

    def log(self, state: State) -> Scalar:
        """Return the log density of all points."""
        return self._log_densities(state.u, state.values)[1].sum()

    def pointwise_log_likelihood(self, state: State) -> Float[AnyArray, "k"]:
        """Return the log density of every point."""
        return self._log_densities(state.u, state.values)[1]

    def log_shares(self, u: Float[AnyArray, "n 3"], values: Values) -> Float[AnyArray, "k t"]:
        """Return the log probability that each point comes from each of its triangles."""
        by_triangle, whole = self._log_densities(u, values)
        return by_triangle - whole[:, None]

    def distance(self, u: Float[AnyArray, "n 3"]) -> Float[AnyArray, "k"]:
        """Return the signed distance of every point from the nearest of its triangles, mm; positive outside."""
        corners = np.asarray((self.rest + u)[self.triangles])
        weights = closest_in_triangles(corners, np.asarray(self.points)[:, None])
        away = np.asarray(self.points)[:, None] - np.einsum("kta,ktai->kti", weights, corners)
        lengths = np.linalg.norm(away, axis=2)
        nearest = lengths.argmin(axis=1)
        rows = np.arange(len(lengths))
        side = np.einsum("ki,ki->k", away[rows, nearest], _normals(corners)[rows, nearest])
        return np.copysign(lengths[rows, nearest], side)

    def standardised_residual(self, state: State) -> Float[AnyArray, "k"]:
        """Return the distance over sd, times the root of the probability that the point is not wrong."""
        right = jnp.exp(logsumexp(self.log_shares(state.u, state.values), axis=1))
        return self.distance(state.u) / self.sd(state.values) * jnp.sqrt(right)

    def gauss_newton(self, u: Float[AnyArray, "n 3"], values: Values) -> PointCurvature:
        """Return p n nᵀ / sd² at the projection on each triangle of the normal n, with its probability p."""
        log_shares, best = jax.lax.top_k(self.log_shares(u, values), min(CURVED, self.triangles.shape[1]))
        triangles = jnp.take_along_axis(self.triangles, best[:, :, None], axis=1).reshape(-1, 3)
        corners = (self.rest + u)[triangles]
        normal = _normals(corners)
        normal /= jnp.linalg.norm(normal, axis=1, keepdims=True)
        points = np.repeat(np.asarray(self.points), best.shape[1], axis=0)
        weights = closest_in_triangles(np.asarray(corners), points)
        stiffness = jnp.exp(log_shares).ravel() / self.sd(values) ** 2
        matrices = stiffness[:, None, None] * normal[:, :, None] * normal[:, None, :]
        return PointCurvature(jnp.c_[triangles, triangles[:, :1]], jnp.c_[weights, jnp.zeros(len(weights))], matrices)

    def remainder(self, u: Float[AnyArray, "n 3"], values: Values) -> PointCurvature:
        """Return zero: the change of normals and probabilities is left out."""
        part = self.gauss_newton(u, values)
        return part._replace(matrices=jnp.zeros_like(part.matrices))

    def _log_densities(
        self, u: Float[AnyArray, "n 3"], values: Values
    ) -> tuple[Float[AnyArray, "k t"], Float[AnyArray, "k"]]:
        """Return the log density of every point by triangle, and that of all triangles and wrong points together."""
        sd, corners = self.sd(values), (self.rest + u)[self.triangles]
        normal = _normals(corners)
        normal = normal / jnp.sqrt((normal**2).sum(axis=-1, keepdims=True) + 1e-24)
        away = self.points[:, None, None] - corners
        height = (away[:, :, 0] * normal).sum(axis=-1)
        edges = jnp.roll(corners, -1, axis=2) - corners
        # The inward normal of an edge in the plane of the triangle.
        inward = jnp.cross(normal[:, :, None], edges)
        from_edges = (away * inward).sum(axis=-1) / jnp.sqrt((inward**2).sum(axis=-1) + 1e-24)
        log_normal = -0.5 * (height / sd) ** 2 - jnp.log(sd) - 0.5 * jnp.log(2 * jnp.pi)
        by_triangle = self.log_inside + log_normal + log_ndtr(from_edges / sd).sum(axis=-1)
        whole = jnp.logaddexp(logsumexp(by_triangle, axis=1), self.log_outside)
        return by_triangle, whole


def _normals(corners: AnyArray) -> AnyArray:
    """Return the outward normal of every triangle, of twice its area in length."""
    edges = corners[..., 1:, :] - corners[..., :1, :]
    package = np if isinstance(corners, np.ndarray) else jnp
    return package.cross(edges[..., 0, :], edges[..., 1, :])


class SurfaceSection(ObservationSection):
    """Points on the moved surface of the organ or of a tissue, without partners."""

    title = "points on a surface"

    kind: Literal["surface"] = "surface"
    name: Name = "surface"
    """The name of the observation in tables; two observations need two."""
    file: FoundFile
    """Points or a mesh of the surface in the space of the moving image (.ply, .stl, .vtk, .vtp, .obj, .csv, .fcsv,
    .mrk.json)."""
    of: str | list[str] = BOUNDARY
    """The tissues whose common surface was measured; boundary is the surface of the whole organ."""
    sd: KnownOrInferred = UNKNOWN_SD
    """Sd of the distance from the surface, mm, or its prior."""
    outliers: Annotated[float, Field(strict=True, gt=0, lt=1)] = 0.05
    """The share of points that are expected to lie elsewhere."""

    def read(self) -> dict[str, np.ndarray]:
        """Read the points, world RAS mm; points of a mesh that coincide count once."""
        if self.file.suffix.lower() in SUFFIXES:
            return {"points": np.unique(read_surface(self.file).points, axis=0)}
        return {"points": read_points(self.file).points}

    def observe(self, inputs: Inputs) -> Sequence[Surface]:
        """Make the surface; its points are transformed into the world of the fixed image."""
        points = inputs.matching.pose.inverse.place(inputs.observed[self.name]["points"])
        return [Surface(points, self.of, self.sd, self.outliers, self.name)]

    @classmethod
    def explain(cls, name: str, described: Mapping[str, Any]) -> str:
        """Return a sentence that explains the term."""
        return (
            f"{name}: each point lies on the moved surface, up to a Normal error, or, if it is wrong, anywhere; the "
            "place of the organ from which it comes is summed out."
        )

    @classmethod
    def tables(cls, name: str, summary: Arrays) -> list[ReportTable]:
        """Return a table of the distances from the surface, before and after."""
        if "distance" not in summary:
            return []
        rows = []
        right = summary["wrong"] < 0.5
        for label, key in (("before", "distance_at_rest"), ("at the posterior mean", "distance")):
            distance = np.abs(summary[key][right])
            rows.append([label, *(float(np.quantile(distance, level)) for level in (0.5, 0.95)), float(distance.max())])
        caption = (
            f"Distances of {right.sum()} of {len(right)} points from the surface, mm; the others are probably wrong. "
            f"The sd of the error is {float(summary['sd']):.2g} mm."
        )
        return [ReportTable(f"Points on the {name}", caption, ["", "Median", "95 %", "Greatest"], rows)]
