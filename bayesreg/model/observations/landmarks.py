"""Pairs of points as an observation: the places of some points of the organ in both images."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from copy import copy
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from bayesreg.fem.location import nearest_places
from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Values, scale_block
from bayesreg.model.observations.compared_points import ComparedPoints
from bayesreg.model.observations.landmarks_report import (
    describe_readings,
    describe_wrong_pairs,
    doubt_intervals,
)
from bayesreg.model.observations.left_out import Predictions, leave_out, predict_at_draws, predict_at_mean
from bayesreg.model.observations.observation import Placed, Recorded
from bayesreg.model.observations.odd_points import (
    Reading,
    describe_contradictions,
    describe_partners,
    describe_plane,
    first_of_each,
    other_readings,
    require_extent,
    require_partners,
    suspect_reading,
)
from bayesreg.model.observations.point_noise import NormalNoise, StudentTNoise
from bayesreg.model.state import State
from bayesreg.model.term import Label
from bayesreg.printable import join_some, require_printable
from bayesreg.settings import ScalePrior
from bayesreg.types import InputError

ROBUST = StudentTNoise()
# The prior of an sd of which nothing is told, mm: its 95 % interval is 0.02 to 50 mm.
UNKNOWN_SD = ScalePrior(median=1.0, log_sd=2.0)
# The log-sd of the prior of an sd whose median two readings tell: its 95 % interval is a factor of 4 to both sides.
# Readings of one observer share errors, and those of the fixed points and of the model come on top: on DIR-Lab's case 1
# (30 pairs) the run inferred 0.8 to 1.9 times the sd of the readings.
READINGS_LOG_SD = 0.7
# The sd of the displacement's change over a distance outside the mesh, over this distance: a strain that tissue has.
STRAIN = 0.2
# The least number of landmarks if others lie too far outside the mesh, and the least share if more would lie near it by
# another reading.
FEWEST, MOST = 4, 0.5
# The greatest number of unknowns for which the memory suffices to leave landmarks out in turn, and of these unknowns
# times the coordinates of the landmarks.
MOST_UNKNOWNS, MOST_ENTRIES = 12_000, 20_000_000

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
    sd : float, (k,), (k, 3) or (1, 3) array, ScalePrior, three numbers and priors, or None
        Standard deviation of the error of each coordinate, mm, positive; or the prior of one sd for all points, which
        is then inferred as "<name>_sd"; or a sequence with at least one prior for the axes x, y and z, inferred as
        "<name>_sd_x" and so on. None takes the prior from `second_points`: its median for each axis is the root mean
        square difference of both readings over √2, the sd of one reading, and its log-sd is `READINGS_LOG_SD`. Errors
        of Student's t have this scale, and are wider by √(ν / (ν − 2)).
    name : str, default "landmarks"
        The name of the observation in tables and in the NumPyro program.
    labels : sequence of str, optional
        The name of each pair in the report; the default is its number.
    noise : StudentTNoise or NormalNoise, default StudentTNoise(nu=4)
    second_points : (k, 3) array, optional
        q as it was read a second time, world RAS mm. It is not compared with the model.
    grids : mapping of str to Image, optional
        Images in the space of the fixed image, by a name such as "the labels". Points outside the mesh that would lie
        in it as voxel indices of a grid are told to be such.

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
        second_points: Any = None,
        grids: Mapping[str, Image] = MappingProxyType({}),
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
        self.name, self.noise, self.grids = name, noise, grids
        self.remarks: tuple[str, ...] = ()
        self.labels = tuple(map(str, range(1, count + 1) if labels is None else labels))
        require_printable(self.labels, f"{name}: labels")
        self.reading_sd = None if second_points is None else _reading_sd(self.moving_points, second_points, name)
        if sd is None and self.reading_sd is not None:
            sd = tuple(ScalePrior(median=float(median), log_sd=READINGS_LOG_SD) for median in self.reading_sd)
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
            If points lie so far outside of the mesh that fewer than `FEWEST` are left, or if another reading, such as
            voxel indices, fits much better.
        """
        observation = self._counted_once()._near(mesh)._examined(mesh)
        for sentence in observation.remarks:
            _log.warning("%s", sentence)
        nodes, weights, distance = nearest_places(mesh, observation.fixed_points)
        term = ComparedPoints(
            label=Label(self.name),
            noise=self.noise,
            scales=tuple(Label(self.scales[axis][0]) if axis in self.scales else None for axis in range(3)),
            nodes=jnp.asarray(nodes),
            weights=jnp.asarray(weights),
            shift=jnp.asarray(observation.moving_points - observation.fixed_points),
            known_sd=jnp.asarray(observation.sd),
            beyond=jnp.asarray(STRAIN * distance),
        )
        return Placed(observation, term, {scale: scale_block(prior) for scale, prior in self.scales.values()})

    def _counted_once(self) -> Landmarks:
        """Return the landmarks without exact copies of a pair, which are no measurements of their own."""
        kept = np.zeros(len(self.labels), bool)
        kept[first_of_each(self.fixed_points, self.moving_points)] = True
        repeated = join_some([label for label, is_kept in zip(self.labels, kept, strict=True) if not is_kept])
        return self._selected(
            kept, f"{self.name}: these pairs repeat another one exactly, and do not count: {repeated}."
        )

    def _near(self, mesh: TetMesh) -> Landmarks:
        """Return the landmarks that lie no further outside the mesh than its edges are long; say which do not."""
        require_extent(self.name, mesh, self.fixed_points)
        distance, reach = nearest_places(mesh, self.fixed_points)[2], mesh.boundary_edge
        near = distance <= reach
        if near.all():
            return self
        swap = Reading("swapped with their partners", "swap the fixed and moving points", mesh, self.moving_points)
        suspicion = suspect_reading(near, [*other_readings(mesh, self.fixed_points, self.grids), swap])
        labels = join_some([self.labels[k] for k in np.flatnonzero(~near)])
        sentence = (
            f"{self.name}: {(~near).sum()} of {len(near)} points lie {distance[~near].min():.3g} mm or more outside "
            f"the mesh, further than the length of its edges ({reach:.3g} mm): {labels}; "
        )
        if near.sum() < FEWEST:
            question = "are they in the space of the fixed image (world RAS, mm), and is the organ meshed whole?"
            raise InputError(f"{sentence}fewer than {FEWEST} points are left; {suspicion or question}")
        if suspicion and near.mean() < MOST:
            raise InputError(f"{sentence}{suspicion}")
        return self._selected(near, f"{sentence}they are left out{'; ' * bool(suspicion)}{suspicion}.")

    def _selected(self, kept: Bool[np.ndarray, "k"], reason: str) -> Landmarks:
        """Return some of the landmarks, with the reason why others are left out as a remark."""
        if kept.all():
            return self
        observation = copy(self)
        observation.fixed_points, observation.moving_points = self.fixed_points[kept], self.moving_points[kept]
        observation.sd, observation.labels = self.sd[kept], tuple(np.array(self.labels)[kept].tolist())
        observation.remarks = (*self.remarks, reason)
        return observation

    def _examined(self, mesh: TetMesh) -> Landmarks:
        """Return the landmarks with remarks on what remains odd about them."""
        require_partners(self.name, mesh, self.fixed_points, self.moving_points, self.grids)
        observation = copy(self)
        observation.remarks = (
            *self.remarks,
            *describe_contradictions(self.name, self.fixed_points, self.moving_points, self.labels),
            *describe_plane(self.name, self.fixed_points),
            *describe_partners(self.name, mesh, self.fixed_points, self.moving_points),
        )
        return observation

    def summarise(self, posterior: Any, state: State, draws: Values) -> dict[str, np.ndarray]:
        """Summarise the residuals at the mean, and the predictions of landmarks by all other observations."""
        term = posterior.data.terms[self.name]
        summary = {
            "names": np.array(self.labels),
            "points": self.fixed_points,
            "sd": np.sqrt((np.asarray(term.sd(state.values)) ** 2).mean(axis=1)),
            "residual": np.asarray(term.shift - term.predicted(state)),
        }
        if self.reading_sd is not None:
            scales = (None if scale is None else state.values[scale.name] for scale in term.scales)
            inferred = np.array([np.nan if scale is None else float(scale) for scale in scales])
            summary |= {"reading_sd": self.reading_sd, "inferred_sd": inferred}
        if (wrong := term.probability_of_wrong(state)) is not None:
            summary["wrong"] = wrong
        predictions = self._predictions(posterior, term, state, draws)
        if predictions is None:
            return summary
        left_out = leave_out(predictions, self.noise)._asdict()
        return summary | {f"left_out_{name}": array for name, array in left_out.items()}

    def _predictions(self, posterior: Any, term: ComparedPoints, state: State, draws: Values) -> Predictions | None:
        """Predict each landmark by all other observations; None if no node is sampled, or the memory is too small."""
        if (prepare_marginal := posterior.target.prepare_marginal) is not None:
            return predict_at_draws(prepare_marginal(), term, draws)
        unknowns = 3 * len(posterior.sampled)
        if not unknowns or unknowns > MOST_UNKNOWNS or 3 * len(self.labels) * unknowns > MOST_ENTRIES:
            return None
        return predict_at_mean(posterior, term, posterior.estimands(state.values))

    def doubts(self, summary: Mapping[str, np.ndarray]) -> list[str]:
        """Say what is odd about the points, name pairs that are probably wrong, and judge the intervals."""
        wrong, intervals = describe_wrong_pairs(self.name, summary), doubt_intervals(self.name, summary)
        return [*self.remarks, *wrong, *intervals]

    def notes(self, summary: Mapping[str, np.ndarray]) -> list[str]:
        """Put the sd of the readings beside the sd that the run inferred, if the points were read twice."""
        return describe_readings(self.name, summary)

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


def _reading_sd(moving_points: Float[np.ndarray, "k 3"], second: Any, name: str) -> Float[np.ndarray, "3"]:
    """Return the sd of one reading along each axis, mm: differences of two like it have twice its variance."""
    second = _points(second, name)
    if second.shape != moving_points.shape or not np.isfinite(second).all():
        raise InputError(
            f"{name}: second_points must be finite, one for each of {len(moving_points)} pairs; got {second.shape}"
        )
    sd = np.sqrt(((second - moving_points) ** 2).mean(axis=0) / 2)
    if not (sd > 0).all():
        raise InputError(
            f"{name}: both readings of the moving points are equal along {'xyz'[int(sd.argmin())]}, and tell no sd; "
            "give sd, or leave the second reading out"
        )
    return sd


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
