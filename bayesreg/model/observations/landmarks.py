"""Pairs of points as an observation: the places of some points of the organ in both images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import xarray as xr
from jax.scipy.stats import norm
from jaxtyping import Float, Int

from bayesreg.fem.location import interpolation_at
from bayesreg.io.point_formats import PointPairs
from bayesreg.io.points import read_point_pairs
from bayesreg.io.records import Inputs
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Values, scale_block
from bayesreg.model.observations.landmarks_report import distance_figure, landmark_table
from bayesreg.model.observations.left_out import leave_out
from bayesreg.model.observations.observation import Placed, Recorded
from bayesreg.model.observations.section import Arrays, Name, ObservationSection, ReportFigure, ReportTable
from bayesreg.model.state import State
from bayesreg.model.term import Label, PointCurvature
from bayesreg.printable import require_printable
from bayesreg.settings import FoundFile, KnownOrInferred, ScalePrior
from bayesreg.types import AnyArray, InputError, Scalar

# The greatest number of landmarks that are left out in turn, and of unknowns for which the memory suffices.
MOST_LEFT_OUT, MOST_UNKNOWNS = 60, 12_000


class Landmarks:
    """Pairs of points that show the same place of the organ, each with an isotropic Normal error.

    log p = −Σ |q − p − u(p)|² / (2 sd²), and −3k log(sd) if the sd is inferred.

    Parameters
    ----------
    fixed_points : (k, 3) array
        p, world RAS mm, in the space of the fixed image and inside the mesh.
    moving_points : (k, 3) array
        q, world RAS mm, in the space of the moving image.
    sd : float, (k,) array or ScalePrior
        Standard deviation of the error of each coordinate, mm, positive; or the prior of one sd for all points, which
        is then inferred as "<name>_sd".
    name : str, default "landmarks"
        The name of the observation in tables and in the NumPyro program.
    labels : sequence of str, optional
        The name of each pair in the report; the default is its number.

    Raises
    ------
    InputError
        If shapes differ, a number is not finite, an sd is not positive, or a label cannot be printed.
    """

    kind = "landmarks"

    def __init__(
        self,
        fixed_points: Any,
        moving_points: Any,
        sd: Any,
        name: str = "landmarks",
        labels: Sequence[str] | None = None,
    ) -> None:
        self.fixed_points, self.moving_points = (_points(points, name) for points in (fixed_points, moving_points))
        shapes = self.fixed_points.shape, self.moving_points.shape
        if shapes[0] != shapes[1] or len(shapes[0]) != 2 or shapes[0][1] != 3 or not shapes[0][0]:
            raise InputError(f"{name}: fixed_points and moving_points must both have shape (k, 3), got {shapes}")
        count = shapes[0][0]
        if not all(np.isfinite(points).all() for points in (self.fixed_points, self.moving_points)):
            raise InputError(f"{name}: every coordinate must be a finite number")
        if isinstance(labels, str) or (labels is not None and len(labels) != count):
            raise InputError(f"{name}: labels must be a list of {count}, one for each point; got {labels!r:.60}")
        self.name, self.labels = name, tuple(map(str, range(1, count + 1) if labels is None else labels))
        require_printable(self.labels, f"{name}: labels")
        self.prior = sd if isinstance(sd, ScalePrior) else None
        self.sd = _known_sd(self.prior.median if self.prior else sd, count, name)

    def on(self, mesh: TetMesh, preset: str = "paper") -> Placed:
        """Place the landmarks on a mesh, with their sd if it is inferred; InputError if a point lies outside."""
        labels = [f"{self.name}: point {label}" for label in self.labels]
        nodes, weights = interpolation_at(mesh, self.fixed_points, labels)
        scale = f"{self.name}_sd"
        term = ComparedPoints(
            label=Label(self.name),
            scale=None if self.prior is None else Label(scale),
            nodes=jnp.asarray(nodes),
            weights=jnp.asarray(weights),
            shift=jnp.asarray(self.moving_points - self.fixed_points),
            known_sd=jnp.asarray(self.sd),
        )
        return Placed(self, term, {} if self.prior is None else {scale: scale_block(self.prior)})

    def summarise(self, posterior: Any, state: State) -> dict[str, np.ndarray]:
        """Summarise the residuals at a state, and for few landmarks their predictions by all other observations."""
        term = posterior.data.terms[self.name]
        summary = {
            "names": np.array(self.labels),
            "points": self.fixed_points,
            "sd": np.asarray(term.sd(state.values)),
            "residual": np.asarray(term.shift - term.predicted(state)),
        }
        if len(self.labels) > MOST_LEFT_OUT or not len(posterior.sampled) or 3 * len(posterior.sampled) > MOST_UNKNOWNS:
            return summary
        left_out = leave_out(posterior, term, posterior.estimands(state.values))
        return summary | {"left_out_residual": left_out.residual, "left_out_covariance": left_out.covariance}

    def recorded(self, term: ComparedPoints) -> Recorded:
        """Return the displacements of the landmarks, mm."""
        coords = {f"{self.name}_point": list(self.labels), "axis": list("xyz")}
        attributes = {"units": "mm", "long_name": "displacement of the landmarks, world RAS"}
        return Recorded(xr.DataArray(np.asarray(term.shift), coords, list(coords), attrs=attributes))


def _points(points: Any, name: str) -> np.ndarray:
    try:
        return np.asarray(points, float)
    except (TypeError, ValueError):
        raise InputError(f"{name}: points must be numbers in an array of shape (k, 3)") from None


def _known_sd(sd: Any, count: int, name: str) -> Float[np.ndarray, "k"]:
    try:
        sd = np.asarray(sd, float)
    except (TypeError, ValueError):
        raise InputError(f"{name}: sd must be a number, {count} numbers or a ScalePrior; got {sd!r}") from None
    if np.ndim(sd) and np.shape(sd) != (count,):
        raise InputError(f"{name}: sd must be one number or {count}, one for each point; got {np.shape(sd)}")
    known_sd = np.broadcast_to(sd, (count,)).copy()
    if np.isnan(known_sd).all():
        raise InputError(f"{name}: sd is not a number; give one, mm, or a ScalePrior to have it inferred")
    if not (np.isfinite(known_sd) & (known_sd > 0)).all():
        raise InputError(f"{name}: every sd must be positive, mm; got {known_sd.tolist()}")
    return known_sd


class ComparedPoints(NamedTuple):
    """Landmarks on a mesh (a pytree).

    Attributes
    ----------
    label : Label
    scale : Label or None
        Name of the block with the sd of all points; None if the sd is known.
    nodes : (k, 4) int array
        Nodes of the cell that holds each point.
    weights : (k, 4) array
        Barycentric coordinates there.
    shift : (k, 3) array
        q − p, mm.
    known_sd : (k,) array
        The sd, mm; if it is inferred, the median of its prior.
    """

    label: Label
    scale: Label | None
    nodes: Int[AnyArray, "k 4"]
    weights: Float[AnyArray, "k 4"]
    shift: Float[AnyArray, "k 3"]
    known_sd: Float[AnyArray, "k"]

    @property
    def name(self) -> str:
        """The name of the term."""
        return self.label.name

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        """The name of the sd if it is inferred: its joint mode with the displacements misleads."""
        return () if self.scale is None else (self.scale.name,)

    def sd(self, values: Values) -> Float[AnyArray, "k"]:
        """Return the sd of every point, mm."""
        return self.known_sd if self.scale is None else jnp.full(self.known_sd.shape, values[self.scale.name])

    def log(self, state: State) -> Scalar:
        """Return −Σ |q − p − u(p)|² / (2 sd²), and the unknown part of the log normaliser."""
        return self.likelihood(state).log_prob(self.shift).sum()

    def observed(self) -> AnyArray:
        """Return the observed q − p, mm."""
        return self.shift

    def likelihood(self, state: State) -> dist.Distribution:
        """Return the distribution N(u(p), sd²), without the known part of its normaliser."""
        sd = self.sd(state.values)
        return PartlyNormalised(self.predicted(state), sd[:, None], self.known_sd[:, None])

    def predicted(self, state: State) -> Float[AnyArray, "k 3"]:
        """Return the predicted displacement u(p), mm."""
        return jnp.einsum("ka,kai->ki", self.weights, state.u[self.nodes])

    def pointwise_log_likelihood(self, state: State) -> Float[AnyArray, "k"]:
        """Return the log likelihood of every landmark with its normaliser, for leave-one-out."""
        return norm.logpdf(self.shift, self.predicted(state), self.sd(state.values)[:, None]).sum(axis=1)

    def standardised_residual(self, state: State) -> Float[AnyArray, "k 3"]:
        """Return (q − p − u(p)) / sd: independent standard Normal numbers if the model holds."""
        return (self.shift - self.predicted(state)) / self.sd(state.values)[:, None]

    def gauss_newton(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Return 1 / sd² in every coordinate of every point, 1/mm²."""
        return PointCurvature(self.nodes, self.weights, jnp.eye(3) / self.sd(values)[:, None, None] ** 2)

    def remainder(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Return zero: the density is Gaussian in the displacements."""
        return PointCurvature(self.nodes, self.weights, jnp.zeros((len(self.known_sd), 3, 3)))


class PartlyNormalised(dist.Normal):
    """A Normal distribution whose log density omits the normaliser of a known scale."""

    def __init__(self, loc: Any, scale: Any, known_scale: Any) -> None:
        self.known_scale = known_scale
        super().__init__(loc, scale)

    def log_prob(self, value: AnyArray, intermediates: None = None) -> AnyArray:
        """Return −(value − loc)² / (2 scale²) − log(scale / known scale)."""
        return -0.5 * ((value - self.loc) / self.scale) ** 2 - jnp.log(self.scale / self.known_scale)


class LandmarksSection(ObservationSection):
    """Pairs of points that show the same place of the organ."""

    title = "pairs of points"

    kind: Literal["landmarks"] = "landmarks"
    name: Name = "landmarks"
    """The name of the observation in tables; two observations need two."""
    file: FoundFile
    """Both points of each pair (.csv, or .tag of two volumes), or the points in the fixed image (.csv, .fcsv,
    .mrk.json, .tag)."""
    moving_file: FoundFile | None = None
    """The points in the moving image, where they stand in a file of their own."""
    sd: KnownOrInferred | None = None
    """Sd of the error of each coordinate, mm, or its prior; null takes the column sd of the file."""

    def read(self) -> dict[str, np.ndarray]:
        """Read the points from the files, world RAS mm; InputError if neither section nor file has an sd."""
        pairs = read_point_pairs(self.file, self.moving_file)
        if self.sd is None and pairs.sd is None:
            raise InputError(
                f"the observation {self.name!r} has no sd, mm: give its entry in observations an sd, or {self.file} a "
                "column sd"
            )
        return pairs.as_arrays()

    def observe(self, inputs: Inputs) -> Sequence[Landmarks]:
        """Make the landmarks; those of the moving image are transformed into the world of the fixed one."""
        pairs = PointPairs.of_arrays(inputs.observed[self.name])
        labels = [name or str(index) for index, name in enumerate(pairs.names, start=1)] or None
        sd = pairs.sd if self.sd is None else self.sd
        return [Landmarks(pairs.fixed, inputs.matching.pose.inverse.place(pairs.moving), sd, self.name, labels)]

    @classmethod
    def tables(cls, name: str, summary: Arrays) -> list[ReportTable]:
        """Return a table of every landmark."""
        return [landmark_table(name, summary)] if "residual" in summary else []

    @classmethod
    def figures(
        cls, name: str, summary: Arrays, tissues: Sequence[str], described: Mapping[str, Any]
    ) -> list[ReportFigure]:
        """Return a figure of the distances between the landmarks and their predicted places."""
        return [distance_figure(name, summary)] if "residual" in summary else []
