"""Pairs of points as an observation: the places of some points of the organ in both images."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import xarray as xr
from jaxtyping import Float, Int

from bayesreg.fem.location import locate, nearest_on_surface
from bayesreg.io.point_formats import PointPairs
from bayesreg.io.points import read_point_pairs
from bayesreg.io.records import Inputs
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Values, scale_block
from bayesreg.model.observations.landmarks_report import distance_figure, landmark_table
from bayesreg.model.observations.left_out import leave_out
from bayesreg.model.observations.observation import Placed, Recorded
from bayesreg.model.observations.point_noise import Noise, NormalNoise, PartlyNormalised, StudentTNoise
from bayesreg.model.observations.section import Arrays, Name, ObservationSection, ReportFigure, ReportTable
from bayesreg.model.state import State
from bayesreg.model.term import Label, PointCurvature
from bayesreg.printable import require_printable
from bayesreg.settings import FoundFile, KnownOrInferred, ScalePrior
from bayesreg.types import AnyArray, InputError, Scalar

ROBUST = StudentTNoise()
# The name of the array with the second reading of the moving points.
SECOND = "second"
# The prior of an sd of which nothing is told, mm: its 95 % interval is 0.02 to 50 mm.
UNKNOWN_SD = ScalePrior(median=1.0, log_sd=2.0)
# The sd of the displacement's change over a distance outside the mesh, over this distance: a strain that tissue has.
STRAIN = 0.2
# The least number of landmarks if others lie too far outside the mesh.
FEWEST = 4
# The greatest number of landmarks that are left out in turn, and of unknowns for which the memory suffices.
MOST_LEFT_OUT, MOST_UNKNOWNS = 60, 12_000


_log = logging.getLogger(__name__)


class Landmarks:
    """Pairs of points that show the same place of the organ, each with an error of its own.

    log p = −Σ_k (ν + 3)/2 log(1 + z_k²/ν) for errors of Student's t, and −Σ_k z_k² / 2 for Normal ones. Here
    z_k² = Σ_i (q − p − u(p))_ki² / sd_ki². Every sd that is inferred adds −log(sd) for each of its coordinates.

    Parameters
    ----------
    fixed_points : (k, 3) array
        p, world RAS mm, in the space of the fixed image. A point outside the mesh by less than the length of an edge
        takes the displacement of the nearest place of the mesh, and its sd is wider by `STRAIN` times the distance; one
        further off is left out.
    moving_points : (k, 3) array
        q, world RAS mm, in the space of the moving image.
    sd : float, (k,), (k, 3) or (1, 3) array, ScalePrior, or three numbers and priors
        Standard deviation of the error of each coordinate, mm, positive; or the prior of one sd for all points, which
        is then inferred as "<name>_sd"; or a sequence with at least one prior for the axes x, y and z, inferred as
        "<name>_sd_x" and so on. Errors of Student's t have this scale, and are wider by √(ν / (ν − 2)).
    name : str, default "landmarks"
        The name of the observation in tables and in the NumPyro program.
    labels : sequence of str, optional
        The name of each pair in the report; the default is its number.
    noise : StudentTNoise or NormalNoise, default StudentTNoise(nu=4)

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
        noise: NormalNoise | StudentTNoise = ROBUST,
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
        self.name, self.labels, self.noise = name, tuple(map(str, labels or range(1, count + 1))), noise
        require_printable(self.labels, f"{name}: labels")
        priors = sd if _has_prior(sd) else [sd] * 3 if isinstance(sd, ScalePrior) else [None] * 3
        scale_names = [f"{name}_sd"] * 3 if isinstance(sd, ScalePrior) else [f"{name}_sd_{axis}" for axis in "xyz"]
        self.scales = {
            axis: (scale, prior)
            for axis, (scale, prior) in enumerate(zip(scale_names, priors, strict=True))
            if isinstance(prior, ScalePrior)
        }
        medians = [prior.median if isinstance(prior, ScalePrior) else prior for prior in priors]
        self.sd = _known_sd([medians] if self.scales else sd, count, name)

    def on(self, mesh: TetMesh, preset: str = "paper") -> Placed:
        """Place the landmarks on a mesh, with every sd that is inferred.

        Raises
        ------
        InputError
            If points lie so far outside of the mesh that fewer than `FEWEST` are left.
        """
        nodes, weights, distance = nearest_places(mesh, self.fixed_points)
        observation = self._within(distance, mesh.boundary_edge)
        near = distance <= mesh.boundary_edge
        term = ComparedPoints(
            label=Label(self.name),
            noise=self.noise,
            scales=tuple(Label(self.scales[axis][0]) if axis in self.scales else None for axis in range(3)),
            nodes=jnp.asarray(nodes[near]),
            weights=jnp.asarray(weights[near]),
            shift=jnp.asarray(observation.moving_points - observation.fixed_points),
            known_sd=jnp.asarray(observation.sd),
            beyond=jnp.asarray(STRAIN * distance[near]),
        )
        return Placed(observation, term, {scale: scale_block(prior) for scale, prior in self.scales.values()})

    def _within(self, distance: Float[np.ndarray, "k"], reach: float) -> Landmarks:
        """Return the landmarks that lie no further outside the mesh than `reach`, mm; say which do not."""
        far = distance > reach
        if far.any():
            names = [self.labels[k] for k in np.flatnonzero(far)]
            sentence = (
                f"{self.name}: {far.sum()} of {len(far)} points lie {distance[far].min():.3g} mm or more outside the "
                f"mesh, further than the length of its edges ({reach:.3g} mm): {', '.join(names[:8])}"
                f"{', …' * (len(names) > 8)}"
            )
            if (~far).sum() < FEWEST:
                raise InputError(
                    f"{sentence}; fewer than {FEWEST} points are left; are they in the space of the fixed image "
                    "(world RAS, mm), and is the organ meshed whole?"
                )
            _log.warning("%s; they are left out", sentence)
        observation = copy(self)
        observation.fixed_points, observation.moving_points = self.fixed_points[~far], self.moving_points[~far]
        observation.sd, observation.labels = self.sd[~far], tuple(np.array(self.labels)[~far].tolist())
        return observation

    def summarise(self, posterior: Any, state: State) -> dict[str, np.ndarray]:
        """Summarise the residuals at a state, and for few landmarks their predictions by all other observations."""
        term = posterior.data.terms[self.name]
        summary = {
            "names": np.array(self.labels),
            "points": self.fixed_points,
            "sd": np.sqrt((np.asarray(term.sd(state.values)) ** 2).mean(axis=1)),
            "residual": np.asarray(term.shift - term.predicted(state)),
        }
        if (wrong := term.probability_of_wrong(state)) is not None:
            summary["wrong"] = wrong
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


def _sd_of_readings(arrays: Arrays) -> tuple[ScalePrior, ...] | None:
    """Make the prior of the sd along each axis from how far two readings differ; None without a second one."""
    if SECOND not in arrays:
        return None
    difference = arrays["moving"] - arrays[SECOND]
    # The median size of a Normal error is 0.674 of its sd. Most points may be read alike along an axis.
    sizes = np.median(np.abs(difference), axis=0) / 0.674 / np.sqrt(2)
    sizes = np.maximum(sizes, np.sqrt((difference**2).mean(axis=0) / 2) / 2)
    return tuple(ScalePrior(median=float(max(size, 1e-3))) for size in sizes)


def _has_prior(sd: Any) -> bool:
    """Check whether an sd is one number or prior for each axis, with a prior among them."""
    return isinstance(sd, list | tuple) and len(sd) == 3 and any(isinstance(prior, ScalePrior) for prior in sd)


def _known_sd(sd: Any, count: int, name: str) -> Float[np.ndarray, "k 3"]:
    try:
        sd = np.asarray(sd, float)
    except (TypeError, ValueError):
        raise InputError(f"{name}: sd must be a number, {count} numbers or a ScalePrior; got {sd!r}") from None
    if sd.shape not in ((), (count,), (1, 3), (count, 3)):
        raise InputError(
            f"{name}: sd must be one number, {count}, one for each point, or three for each; got shape {sd.shape}"
        )
    known_sd = np.broadcast_to(sd[:, None] if sd.ndim == 1 else sd, (count, 3)).copy()
    if np.isnan(known_sd).all():
        raise InputError(f"{name}: sd is not a number; give one, mm, or a ScalePrior to have it inferred")
    if not (np.isfinite(known_sd) & (known_sd > 0)).all():
        raise InputError(f"{name}: every sd must be positive, mm; got {sd.tolist()}")
    return known_sd


def nearest_places(
    mesh: TetMesh, points: Float[np.ndarray, "k 3"]
) -> tuple[Int[np.ndarray, "k 4"], Float[np.ndarray, "k 4"], Float[np.ndarray, "k"]]:
    """Find the place of the mesh that is nearest to each point.

    Returns
    -------
    nodes : (k, 4) int array
        Nodes of the cell that holds the place; of a place on the surface, of a triangle and one of them again.
    weights : (k, 4) array
        Barycentric coordinates there.
    distance : (k,) array
        The distance from the point, mm; zero inside.
    """
    cell, weights = locate(mesh.points, mesh.cells, points, tolerance=1e-6)
    nodes, distance, outside = mesh.cells[cell], np.zeros(len(points)), cell < 0
    if outside.any():
        face, on_face = nearest_on_surface(mesh.points, mesh.boundary_faces, points[outside])
        corners = mesh.boundary_faces[face]
        nodes[outside], weights[outside] = np.c_[corners, corners[:, 0]], np.c_[on_face, np.zeros(len(face))]
        places = np.einsum("ka,kai->ki", on_face, mesh.points[corners])
        distance[outside] = np.linalg.norm(points[outside] - places, axis=1)
    return nodes, weights, distance


class ComparedPoints(NamedTuple):
    """Landmarks on a mesh (a pytree).

    Attributes
    ----------
    label : Label
    noise : StudentTNoise or NormalNoise
    scales : three of Label or None
        Name of the block with the sd along each axis; None if it is known.
    nodes : (k, 4) int array
        Nodes of the cell that holds each point.
    weights : (k, 4) array
        Barycentric coordinates there.
    shift : (k, 3) array
        q − p, mm.
    known_sd : (k, 3) array
        The sd, mm; if it is inferred, the median of its prior.
    beyond : (k,) array
        The sd for the distance of each point from the mesh, mm; zero inside.
    """

    label: Label
    noise: Any
    scales: tuple[Label | None, ...]
    nodes: Int[AnyArray, "k 4"]
    weights: Float[AnyArray, "k 4"]
    shift: Float[AnyArray, "k 3"]
    known_sd: Float[AnyArray, "k 3"]
    beyond: Float[AnyArray, "k"]

    @property
    def name(self) -> str:
        """The name of the term."""
        return self.label.name

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        """The name of every sd that is inferred: its joint mode with the displacements misleads."""
        return tuple(dict.fromkeys(scale.name for scale in self.scales if scale is not None))

    def sd(self, values: Values) -> Float[AnyArray, "k 3"]:
        """Return the sd of every coordinate, mm."""
        columns = [
            self.known_sd[:, axis] if scale is None else jnp.full(len(self.known_sd), values[scale.name])
            for axis, scale in enumerate(self.scales)
        ]
        return self._with_distance(jnp.stack(columns, axis=1))

    def log(self, state: State) -> Scalar:
        """Return the log density of all points, with the unknown part of its normaliser."""
        return self.likelihood(state).log_prob(self.shift).sum()

    def observed(self) -> AnyArray:
        """Return the observed q − p, mm."""
        return self.shift

    def likelihood(self, state: State) -> dist.Distribution:
        """Return the distribution about u(p), without the known part of its normaliser."""
        mean, known_sd = self.predicted(state), self._with_distance(self.known_sd)
        whole = self.noise.distribution(mean, self.sd(state.values))
        return PartlyNormalised(whole, self.noise.distribution(jnp.zeros_like(known_sd), known_sd).log_prob(0.0 * mean))

    def predicted(self, state: State) -> Float[AnyArray, "k 3"]:
        """Return the predicted displacement u(p), mm."""
        return self._at_points(state.u)

    def pointwise_log_likelihood(self, state: State) -> Float[AnyArray, "k"]:
        """Return the log likelihood of every landmark with its normaliser, for leave-one-out."""
        return self.noise.distribution(self.predicted(state), self.sd(state.values)).log_prob(self.shift)

    def standardised_residual(self, state: State) -> Float[AnyArray, "k 3"]:
        """Return (q − p − u(p)) / sd, times the root of its weight: of mean square one if the model holds."""
        residual = (self.shift - self.predicted(state)) / self.sd(state.values)
        return residual * jnp.sqrt(self.noise.weight((residual**2).sum(axis=1)))[:, None]

    def probability_of_wrong(self, state: State) -> Float[np.ndarray, "k"] | None:
        """Return the probability that a pair is wrong, given u and sd; None with Normal errors."""
        residual = (self.shift - self.predicted(state)) / self.sd(state.values)
        return self.noise.probability_of_wrong(np.asarray((residual**2).sum(axis=1)))

    def gauss_newton(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Return w / sd² in every coordinate of every point, 1/mm², with its weight w."""
        own_values = {name: values[name] for name in self.hyperparameters}
        return PointCurvature(self.nodes, self.weights, _weighted_precision(self, jnp.asarray(u), own_values))

    def remainder(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Return what the change of the weights adds; zero with Normal errors."""
        sd = self.sd(values)
        push = (self.shift - self._at_points(u)) / sd**2
        bend = self.noise.bend(self.squares(u, sd))
        return PointCurvature(self.nodes, self.weights, bend[:, None, None] * push[:, :, None] * push[:, None, :])

    def squares(self, u: Float[AnyArray, "nodes 3"], sd: Float[AnyArray, "k 3"]) -> Float[AnyArray, "k"]:
        """Return z², the squared distance of every landmark from its predicted place, in units of sd."""
        return (((self.shift - self._at_points(u)) / sd) ** 2).sum(axis=1)

    def _at_points(self, u: Float[AnyArray, "nodes 3"]) -> Float[AnyArray, "k 3"]:
        return jnp.einsum("ka,kai->ki", self.weights, jnp.asarray(u)[self.nodes])

    def _with_distance(self, sd: Float[AnyArray, "k 3"]) -> Float[AnyArray, "k 3"]:
        return jnp.sqrt(sd**2 + self.beyond[:, None] ** 2)


# Searches for hyperparameters ask for it many times.
@jax.jit
def _weighted_precision(
    term: ComparedPoints, u: Float[AnyArray, "nodes 3"], values: Values
) -> Float[AnyArray, "k 3 3"]:
    sd = term.sd(values)
    return term.noise.weight(term.squares(u, sd))[:, None, None] * jnp.eye(3) / sd[:, None, :] ** 2


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
    second_file: FoundFile | None = None
    """The same pairs, in the same order, by another reading of the moving points; how far the readings differ is the
    median of the sd's prior, by axis, unless `sd` is given."""
    sd: KnownOrInferred | tuple[KnownOrInferred, KnownOrInferred, KnownOrInferred] | None = None
    """Sd of the error of each coordinate, mm, or its prior, or three of these for the axes x, y and z; null takes the
    column sd of the file, and without one infers it."""
    noise: Noise = ROBUST
    """The distribution of the errors: student_t, with a few large ones, or normal."""

    def read(self) -> dict[str, np.ndarray]:
        """Read the points from the files, world RAS mm."""
        pairs = read_point_pairs(self.file, self.moving_file)
        if self.second_file is None:
            return pairs.as_arrays()
        second = read_point_pairs(self.second_file)
        if len(second.moving) != len(pairs.moving):
            raise InputError(
                f"{self.second_file} holds {len(second.moving)} pairs and {self.file} {len(pairs.moving)}: expected "
                "two readings of the same pairs"
            )
        return pairs.as_arrays() | {SECOND: second.moving}

    def observe(self, inputs: Inputs) -> Sequence[Landmarks]:
        """Make the landmarks; those of the moving image are transformed into the world of the fixed one."""
        pairs = PointPairs.of_arrays(inputs.observed[self.name])
        labels = [name or str(index) for index, name in enumerate(pairs.names, start=1)] or None
        sd = next(
            (sd for sd in (self.sd, pairs.sd, _sd_of_readings(inputs.observed[self.name])) if sd is not None),
            UNKNOWN_SD,
        )
        if isinstance(sd, tuple) and not any(isinstance(prior, ScalePrior) for prior in sd):
            sd = np.array([sd])
        moving = inputs.matching.pose.inverse.place(pairs.moving)
        return [Landmarks(pairs.fixed, moving, sd, self.name, labels, self.noise)]

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
