"""Pairs of points as an observation: where some places of the organ are in the other space."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Float, Int

from bayesreg.fem.location import interpolation_at
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Scale, Values
from bayesreg.model.options import ScalePrior
from bayesreg.model.state import State
from bayesreg.model.terms.term import Label, PointCurvature
from bayesreg.printable import require_printable
from bayesreg.types import AnyArray, InputError, Scalar


class Landmarks:
    """Pairs of points that show the same place of the organ, each with an isotropic Normal error.

    log p = −Σ |q − p − u(p)|² / (2 sd²), and −3k log(sd) where the sd is inferred.

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
        Its name in tables and in the NumPyro program.
    labels : sequence of str, optional
        What to call each pair in the report; the default is its number.

    Raises
    ------
    InputError
        If shapes differ, a number is not finite, an sd is not positive, or a label cannot be printed.
    """

    def __init__(
        self,
        fixed_points: Any,
        moving_points: Any,
        sd: Any,
        name: str = "landmarks",
        labels: Sequence[str] | None = None,
    ) -> None:
        self.fixed_points, self.moving_points = (_points(given, name) for given in (fixed_points, moving_points))
        shapes = self.fixed_points.shape, self.moving_points.shape
        if shapes[0] != shapes[1] or len(shapes[0]) != 2 or shapes[0][1] != 3 or not shapes[0][0]:
            raise InputError(f"{name}: fixed_points and moving_points must both have shape (k, 3), got {shapes}")
        count = shapes[0][0]
        if not all(np.isfinite(part).all() for part in (self.fixed_points, self.moving_points)):
            raise InputError(f"{name}: every coordinate must be a finite number")
        if isinstance(labels, str) or (labels is not None and len(labels) != count):
            raise InputError(f"{name}: labels must be a list of {count}, one for each point; got {labels!r:.60}")
        self.name, self.labels = name, tuple(map(str, range(1, count + 1) if labels is None else labels))
        require_printable(self.labels, f"{name}: labels")
        self.prior = sd if isinstance(sd, ScalePrior) else None
        self.sd = _known_sd(self.prior.median if self.prior else sd, count, name)

    @property
    def blocks(self) -> dict[str, Scale]:
        """The unknowns that it brings: its sd, where that is inferred."""
        if self.prior is None:
            return {}
        return {f"{self.name}_sd": Scale(jnp.asarray(self.prior.median), jnp.asarray(self.prior.log_sd))}

    def on(self, mesh: TetMesh) -> ComparedPoints:
        """The term on a mesh; InputError if a fixed point lies outside it."""
        labels = [f"{self.name}: point {label}" for label in self.labels]
        nodes, weights = interpolation_at(mesh, self.fixed_points, labels)
        return ComparedPoints(
            label=Label(self.name),
            scale=None if self.prior is None else Label(f"{self.name}_sd"),
            nodes=jnp.asarray(nodes),
            weights=jnp.asarray(weights),
            shift=jnp.asarray(self.moving_points - self.fixed_points),
            known_sd=jnp.asarray(self.sd),
        )


def _points(given: Any, name: str) -> np.ndarray:
    try:
        return np.asarray(given, float)
    except (TypeError, ValueError):
        raise InputError(f"{name}: points must be numbers in an array of shape (k, 3)") from None


def _known_sd(sd: Any, count: int, name: str) -> Float[np.ndarray, "k"]:
    try:
        sd = np.asarray(sd, float)
    except (TypeError, ValueError):
        raise InputError(f"{name}: sd must be a number, {count} numbers or a ScalePrior; got {sd!r}") from None
    if np.ndim(sd) and np.shape(sd) != (count,):
        raise InputError(f"{name}: sd must be one number or {count}, one for each point; got {np.shape(sd)}")
    found = np.broadcast_to(sd, (count,)).copy()
    if np.isnan(found).all():
        raise InputError(f"{name}: sd is not a number; give one, mm, or a ScalePrior to have it inferred")
    if not (np.isfinite(found) & (found > 0)).all():
        raise InputError(f"{name}: every sd must be positive, mm; got {found.tolist()}")
    return found


class ComparedPoints(NamedTuple):
    """Landmarks on a mesh (a pytree).

    Attributes
    ----------
    label : Label
    scale : Label or None
        Name of the block with the sd of all points; None where it is known.
    nodes : (k, 4) int array
        Nodes of the cell that holds each point.
    weights : (k, 4) array
        Barycentric coordinates there.
    shift : (k, 3) array
        q − p, mm.
    known_sd : (k,) array
        mm; the median of its prior where it is inferred.
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

    def sd(self, values: Values) -> Float[AnyArray, "k"]:
        """The sd of every point, mm."""
        return self.known_sd if self.scale is None else jnp.full(self.known_sd.shape, values[self.scale.name])

    def log(self, state: State) -> Scalar:
        """−Σ |q − p − u(p)|² / (2 sd²), and the part of the normaliser that is not known."""
        return self.likelihood(state).log_prob(self.shift).sum()

    def observed(self) -> AnyArray:
        """q − p, mm."""
        return self.shift

    def likelihood(self, state: State) -> dist.Distribution:
        """N(u(p), sd²), up to the part of its normaliser that is known."""
        sd = self.sd(state.values)
        return PartlyNormalised(self.predicted(state), sd[:, None], self.known_sd[:, None])

    def predicted(self, state: State) -> Float[AnyArray, "k 3"]:
        """u(p), mm."""
        return jnp.einsum("ka,kai->ki", self.weights, state.u[self.nodes])

    def standardised_residual(self, state: State) -> Float[AnyArray, "k 3"]:
        """(q − p − u(p)) / sd: independent standard Normal numbers where the model holds."""
        return (self.shift - self.predicted(state)) / self.sd(state.values)[:, None]

    def gauss_newton(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """1 / sd² in every coordinate of every point, 1/mm²."""
        return PointCurvature(self.nodes, self.weights, jnp.eye(3) / self.sd(values)[:, None, None] ** 2)

    def remainder(self, u: Float[AnyArray, "nodes 3"], values: Values) -> PointCurvature:
        """Nothing: the density is Gaussian in the displacements."""
        return PointCurvature(self.nodes, self.weights, jnp.zeros((len(self.known_sd), 3, 3)))


class PartlyNormalised(dist.Normal):
    """A Normal distribution whose log density leaves out the normaliser of a known scale."""

    def __init__(self, loc: Any, scale: Any, known_scale: Any) -> None:
        self.known_scale = known_scale
        super().__init__(loc, scale)

    def log_prob(self, value: AnyArray, intermediates: None = None) -> AnyArray:
        """−(value − loc)² / (2 scale²) − log(scale / known scale)."""
        return -0.5 * ((value - self.loc) / self.scale) ** 2 - jnp.log(self.scale / self.known_scale)
