"""The term of points that were measured on the moved surface of an organ, without partners.

The surface of the organ at rest is the zero level of its signed distance φ. A measured point y lies on the moved
surface if the place x of the organ that has moved there, x + u(x) = y, lies on the surface at rest, φ(x) = 0. The
partner of y is thus no unknown: it is where the displacement takes y back to, and the residual

r = φ(x),  x + u(x) = y

is the distance of y from the moved surface, up to the strain. It is linear in u as far as the surface is flat over the
distances by which points are unsure along it. Points of an organ that was seen in part say nothing about the rest.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Float, Int
from scipy import ndimage

from bayesreg.interpolation import Interpolator
from bayesreg.model.blocks import Blocks, Values
from bayesreg.model.observations.point_noise import Adjusted
from bayesreg.model.state import State
from bayesreg.model.term import Label, PointCurvature
from bayesreg.types import AnyArray, Scalar

# Each step takes a point back by the displacement of the cell in which the last step ended. Its error shrinks by the
# difference of the strains of two neighbouring cells.
STEPS = 2
# Steps of Metropolis for the sd, each of which costs little.
SD_STEPS = 4


class CellTable(NamedTuple):
    """The cell of a mesh that is nearest to each voxel of a grid (a pytree).

    Attributes
    ----------
    cells : (X, Y, Z) int array
    to_voxel : (4, 4) array
        The affine from world RAS, mm, to voxel indices.
    """

    cells: Int[AnyArray, "X Y Z"]
    to_voxel: Float[AnyArray, "4 4"]

    def at(self, points: Float[AnyArray, "k 3"]) -> Int[AnyArray, "k"]:
        """Return the cell at each point, or at the nearest voxel of the grid."""
        voxel = jnp.round(points @ self.to_voxel[:3, :3].T + self.to_voxel[:3, 3]).astype(int)
        voxel = jnp.clip(voxel, 0, jnp.array(self.cells.shape) - 1)
        return self.cells[voxel[:, 0], voxel[:, 1], voxel[:, 2]]


class MeasuredSurface(NamedTuple):
    """Points on the moved surface of a mesh (a pytree).

    Attributes
    ----------
    label : Label
    noise : StudentTNoise or NormalNoise
    scale : Label or None
        Name of the block with the sd; None if it is known.
    points : (k, 3) array
        y, mm.
    distance : Interpolator
        φ, mm, positive outside the organ.
    table : CellTable
    cells : (m, 4) int array
        Nodes of the cells of the mesh.
    rest : (n, 3) array
        Nodes at rest, mm.
    known_sd : scalar
        The sd, mm; if it is inferred, the median of its prior.
    wider : scalar
        Another sd, added in squares; zero except in the search for a mode.
    independent_points : scalar
        The number of independent points that count as much as all of them together.
    """

    label: Label
    noise: Any
    scale: Label | None
    points: Float[AnyArray, "k 3"]
    distance: Interpolator
    table: CellTable
    cells: Int[AnyArray, "m 4"]
    rest: Float[AnyArray, "n 3"]
    known_sd: Scalar
    wider: Scalar
    independent_points: Scalar

    @property
    def name(self) -> str:
        """The name of the term."""
        return self.label.name

    @property
    def powers(self) -> dict[str, float]:
        """The temperatures of this term: none."""
        return {}

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        """The name of the sd, if it is inferred: its joint mode with the displacements misleads."""
        return () if self.scale is None else (self.scale.name,)

    @property
    def share(self) -> Scalar:
        """The share of independent points, by which the log density is multiplied."""
        return self.independent_points / len(self.points)

    def with_independent_points(self, count: float) -> MeasuredSurface:
        """Return the term with another number of independent points."""
        return self._replace(independent_points=jnp.asarray(float(count)))

    def sd(self, values: Values) -> Scalar:
        """Return the sd, mm."""
        sd = self.known_sd if self.scale is None else jnp.asarray(values[self.scale.name])
        return jnp.sqrt(sd**2 + self.wider**2)

    def log(self, state: State) -> Scalar:
        """Return the log density of all points, times the share of independent ones."""
        return self.log_at(state.u, state.values)

    def log_at(self, u: Float[AnyArray, "n 3"], values: Values) -> Scalar:
        """Return the log density of all points at a displacement, times the share of independent ones."""
        return self._likelihood(u, values).log_prob(self.observed()).sum()

    def observed(self) -> AnyArray:
        """Return zero, the error of points that lie on the surface, less the height that a state gives them."""
        return jnp.zeros(len(self.points))

    def likelihood(self, state: State) -> dist.Distribution:
        """Return the distribution of the observed zeros, tempered: an error, less the height at this state."""
        return self._likelihood(state.u, state.values)

    def height(self, u: Float[AnyArray, "n 3"]) -> Float[AnyArray, "k"]:
        """Return φ(x), the height of every point over the moved surface, mm; positive outside."""
        return self.distance(self._place(self._find_cells(u), self.points, u)[0])

    def standardised_residual(self, state: State) -> Float[AnyArray, "k"]:
        """Return φ / sd, times the root of its weight: of mean square one if the model holds."""
        residual = self.height(state.u) / self.sd(state.values)
        return residual * jnp.sqrt(self.noise.weight(residual**2, 1))

    def gauss_newton(self, u: Float[AnyArray, "n 3"], values: Values) -> PointCurvature:
        """Return w / sd² along the direction in which each point's height grows, 1/mm²."""
        squares = (self.height(u) / self.sd(values)) ** 2
        return self._curvature(u, self.share * self.noise.weight(squares, 1) / self.sd(values) ** 2)

    def remainder(self, u: Float[AnyArray, "n 3"], values: Values) -> PointCurvature:
        """Return what the change of the weights adds; the curvature of the surface is left out."""
        squares = (self.height(u) / self.sd(values)) ** 2
        return self._curvature(u, self.share * self.noise.bend(squares, 1) * squares / self.sd(values) ** 2)

    def score(self, u: Float[AnyArray, "n 3"], values: Values) -> Float[AnyArray, "k 3"]:
        """Return the slope of the log density in the displacement of every point's place, 1/mm."""
        height, sd = self.height(u), self.sd(values)
        push = self.noise.weight((height / sd) ** 2, 1) * height / sd**2
        return self.share * push[:, None] * self._directions(u)

    def draw_sd(self, key: AnyArray, values: Values, blocks: Blocks) -> dict[str, AnyArray]:
        """Draw the sd given the displacements, if it is inferred, by some steps of Metropolis in its logarithm."""
        if self.scale is None:
            return {}
        name, height = self.scale.name, self.height(values["u_boundary"])

        def log_density(log_sd: Scalar) -> Scalar:
            sd = jnp.exp(log_sd)
            errors = self.noise.distribution_along(0.0 * height, sd).log_prob(height).sum()
            return blocks[name].prior().log_prob(sd) + log_sd + self.share * errors

        def step(log_sd: Scalar, key: AnyArray) -> tuple[Scalar, None]:
            key_move, key_accept = jax.random.split(key)
            candidate = log_sd + width * jax.random.normal(key_move)
            gain = log_density(candidate) - log_density(log_sd)
            return jnp.where(jnp.log(jax.random.uniform(key_accept)) < gain, candidate, log_sd), None

        # Of k independent Normal errors, log sd has the sd (2 k)^−½; 2.4 times this is the best step.
        width = 2.4 / jnp.sqrt(2 * self.independent_points)
        log_sd, _ = jax.lax.scan(step, jnp.log(values[name]), jax.random.split(key, SD_STEPS))
        return {name: jnp.exp(log_sd)}

    def restricted_to(self, nodes: Int[np.ndarray, "n"]) -> MeasuredSurface:
        """Return the term of some nodes alone: points come from the nearest cells whose nodes are all among them."""
        cells, table = np.asarray(self.cells), np.asarray(self.table.cells)
        is_whole = np.asarray(np.isin(cells, nodes).all(axis=1))
        nearest = ndimage.distance_transform_edt(~is_whole[table], return_distances=False, return_indices=True)
        numbers = np.zeros(len(self.rest), int)
        numbers[nodes] = np.arange(len(nodes))
        return self._replace(
            table=self.table._replace(cells=jnp.asarray(table[tuple(nearest)])),
            cells=jnp.asarray(numbers[np.where(is_whole[:, None], cells, nodes[0])]),
            rest=self.rest[nodes],
        )

    def _likelihood(self, u: Float[AnyArray, "n 3"], values: Values) -> dist.Distribution:
        return Adjusted(self.noise.distribution_along(-self.height(u), self.sd(values)), self.share)

    def _curvature(self, u: Float[AnyArray, "n 3"], stiffness: Float[AnyArray, "k"]) -> PointCurvature:
        cells, directions = self._find_cells(u), self._directions(u)
        matrices = stiffness[:, None, None] * directions[:, :, None] * directions[:, None, :]
        return PointCurvature(self.cells[cells], self._place(cells, self.points, u)[1], matrices)

    def _directions(self, u: Float[AnyArray, "n 3"]) -> Float[AnyArray, "k 3"]:
        """Return ∂φ/∂y; a displacement of the place by δ changes the height by −δ times it."""
        cells = self._find_cells(u)
        return jax.grad(lambda points: self.distance(self._place(cells, points, u)[0]).sum())(self.points)

    def _find_cells(self, u: Float[AnyArray, "n 3"]) -> Int[AnyArray, "k"]:
        """Find the cell from which each point has come."""
        u, places = jax.lax.stop_gradient(u), self.points
        for _ in range(STEPS):
            places, _ = self._place(self.table.at(places), self.points, u)
        return self.table.at(places)

    def _place(
        self, cells: Int[AnyArray, "k"], points: Float[AnyArray, "k 3"], u: Float[AnyArray, "n 3"]
    ) -> tuple[Float[AnyArray, "k 3"], Float[AnyArray, "k 4"]]:
        """Return the place x of each point, and its barycentric coordinates in a cell.

        y has the same barycentric coordinates in the moved cell as x in the cell at rest.
        """
        nodes = self.cells[cells]
        at_rest, moved = self.rest[nodes], (self.rest + u)[nodes]
        a, b, c = (moved[:, corner] - moved[:, 0] for corner in (1, 2, 3))
        away = points - moved[:, 0]
        # Cramer's rule: the volumes of the tetrahedra in which the point takes the place of a corner.
        faces = jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)
        volume = (a * faces[0]).sum(axis=1)
        last_three = jnp.stack([(away * face).sum(axis=1) / volume for face in faces], axis=1)
        weights = jnp.concatenate([1 - last_three.sum(axis=1, keepdims=True), last_three], axis=1)
        return jnp.einsum("ka,kai->ki", weights, at_rest), weights
