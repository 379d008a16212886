"""Pairs of points as an observation: where some places of the organ are in the other space."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Float, Int

from bayesreg.fem.location import interpolation_at
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Values
from bayesreg.model.state import State
from bayesreg.model.terms.term import Label, PointCurvature
from bayesreg.types import AnyArray, InputError, Scalar


class Landmarks:
    """Pairs of points that show the same place of the organ, each with an isotropic Normal error.

    log p = −Σ |q − p − u(p)|² / (2 sd²).

    Parameters
    ----------
    fixed_points : (k, 3) array
        p, world RAS mm, in the space of the fixed image and inside the mesh.
    moving_points : (k, 3) array
        q, world RAS mm, in the space of the moving image.
    sd : float or (k,) array
        Standard deviation of the error of each coordinate, mm, positive.
    name : str, default "landmarks"
        Its name in tables and in the NumPyro program.

    Raises
    ------
    InputError
        If shapes differ, a number is not finite, or an sd is not positive.
    """

    def __init__(self, fixed_points: Any, moving_points: Any, sd: Any, name: str = "landmarks") -> None:
        self.fixed_points, self.moving_points = np.asarray(fixed_points, float), np.asarray(moving_points, float)
        shapes = self.fixed_points.shape, self.moving_points.shape
        if shapes[0] != shapes[1] or len(shapes[0]) != 2 or shapes[0][1] != 3 or not shapes[0][0]:
            raise InputError(f"{name}: fixed_points and moving_points must both have shape (k, 3), got {shapes}")
        if np.ndim(sd) and np.shape(sd) != shapes[0][:1]:
            raise InputError(f"{name}: sd must be one number or {shapes[0][0]}, one for each point; got {np.shape(sd)}")
        self.sd, self.name = np.broadcast_to(np.asarray(sd, float), shapes[0][:1]).copy(), name
        if not all(np.isfinite(part).all() for part in (self.fixed_points, self.moving_points)):
            raise InputError(f"{name}: every coordinate must be a finite number")
        if not (np.isfinite(self.sd) & (self.sd > 0)).all():
            raise InputError(f"{name}: every sd must be positive, mm; got {self.sd.tolist()}")

    def on(self, mesh: TetMesh) -> PointPairs:
        """The term on a mesh; InputError if a fixed point lies outside it."""
        nodes, weights = interpolation_at(mesh, self.fixed_points)
        return PointPairs(
            label=Label(self.name),
            nodes=jnp.asarray(nodes),
            weights=jnp.asarray(weights),
            shift=jnp.asarray(self.moving_points - self.fixed_points),
            sd=jnp.asarray(self.sd),
        )


class PointPairs(NamedTuple):
    """Landmarks on a mesh (a pytree).

    Attributes
    ----------
    label : Label
    nodes : (k, 4) int array
        Nodes of the cell that holds each point.
    weights : (k, 4) array
        Barycentric coordinates there.
    shift : (k, 3) array
        q − p, mm.
    sd : (k,) array
        mm.
    """

    label: Label
    nodes: Int[AnyArray, "k 4"]
    weights: Float[AnyArray, "k 4"]
    shift: Float[AnyArray, "k 3"]
    sd: Float[AnyArray, "k"]

    @property
    def name(self) -> str:
        """Its name."""
        return self.label.name

    def log(self, state: State) -> Scalar:
        """−Σ |q − p − u(p)|² / (2 sd²)."""
        return -0.5 * (self.standardised_residual(state) ** 2).sum()

    def observed(self) -> AnyArray:
        """q − p, mm."""
        return self.shift

    def likelihood(self, state: State) -> dist.Distribution:
        """N(u(p), sd²), up to its normaliser, which is known."""
        return UnnormalisedNormal(self.predicted(state), self.sd[:, None])

    def predicted(self, state: State) -> Float[AnyArray, "k 3"]:
        """u(p), mm."""
        return jnp.einsum("ka,kai->ki", self.weights, state.u[self.nodes])

    def standardised_residual(self, state: State) -> Float[AnyArray, "k 3"]:
        """(q − p − u(p)) / sd: independent standard Normal numbers where the model holds."""
        return (self.shift - self.predicted(state)) / self.sd[:, None]

    def curvature(self, u: Float[AnyArray, "nodes 3"], values: Values, second_order: bool) -> PointCurvature:
        """1 / sd² in every coordinate of every point; nothing of second order."""
        first = jnp.eye(3) / self.sd[:, None, None] ** 2
        return PointCurvature(self.nodes, self.weights, first, jnp.zeros_like(first))


class UnnormalisedNormal(dist.Normal):
    """A Normal distribution whose log density leaves its constant out."""

    def log_prob(self, value: AnyArray, intermediates: None = None) -> AnyArray:
        """−(value − loc)² / (2 scale²)."""
        return -0.5 * ((value - self.loc) / self.scale) ** 2
