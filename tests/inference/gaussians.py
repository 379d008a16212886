"""A posterior for the samplers alone: a Gaussian of a few displaced nodes below a wall that bends with the height."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.model.curvature import Curvature

NODES, WALL, WIDTH = 2, 0.6, 0.2
DIMENSION = 3 * NODES


class Data(NamedTuple):
    mean: Any
    precision: Any
    wall: Any


class Found(NamedTuple):
    logdensity: Any
    u: Any
    similarity_energy: Any = 0.0
    strain_energy: Any = 0.0
    solver_iterations: Any = 0
    solver_failed: Any = False
    outside_support: Any = False


class Coordinates:
    """Positions are estimands."""

    def reference(self):
        return {"u_boundary": jnp.zeros((NODES, 3))}

    def constrain(self, data, position):
        return dict(position), jnp.zeros(())

    def unconstrain(self, data, estimands):
        return dict(estimands)

    def least_curvature(self, data, position):
        return jax.tree.map(jnp.ones_like, position)


class Variables:
    dims: ClassVar = {"u_boundary": ("node", "axis"), "lam": ("tissue",), "mu": ("tissue",)}
    coords: ClassVar = {"node": np.arange(NODES), "axis": list("xyz"), "tissue": ["tissue"]}
    constants: ClassVar = {}
    attributes: ClassVar = {}

    def values(self, estimands):
        shape = (*np.shape(estimands["u_boundary"])[:-2], 1)
        return {"u_boundary": np.asarray(estimands["u_boundary"]), "lam": np.ones(shape), "mu": np.ones(shape)}

    def estimands(self, values):
        return {"u_boundary": np.asarray(values["u_boundary"], float)}


class ModeSearch:
    def __init__(self, data):
        self.data = data

    hyperparameters = ()
    separable = followed = ()
    search_start = tempering = None
    loosening = MappingProxyType({})

    def continuation(self):
        yield self.data

    def curvature(self, data, estimands):
        return Curvature(np.asarray(data.precision), lambda: np.zeros((DIMENSION, DIMENSION)))

    def quadratic_part(self, data):
        return data

    def quadratic_curvature(self, data, estimands, near):
        return np.asarray(data.precision)

    def quadratic_trace(self, data, near, covariance):
        return lambda estimands: 0.0


class GaussianTarget:
    """N(0, covariance) of "u_boundary" before a wall that bends with y, which the x of a node should not exceed.

    A depth of `width` inside it counts as one standard deviation; with 0 the density is zero there. With `apart` a
    mixture of two such, of equal mass, their means so far apart in the y of the first node.
    """

    coordinates, variables, normaliser, surrogate, prepare_marginal = Coordinates(), Variables(), None, None, None

    def __init__(self, wall: float = WALL, apart: float = 0.0, width: float = WIDTH):
        root = np.random.default_rng(0).normal(size=(DIMENSION, DIMENSION))
        self.covariance = root @ root.T / DIMENSION + 0.3 * np.eye(DIMENSION)
        mean = jnp.zeros(DIMENSION).at[1].set(apart / 2)
        self.data = Data(mean, jnp.asarray(np.linalg.inv(self.covariance)), jnp.asarray(wall))
        self.width = width
        self.mode_search = ModeSearch(self.data)
        self.hard_wall = None if width else lambda data, u: gap(data, u) < 0

    @property
    def target(self):
        return self

    def height(self, data, u):
        away = jnp.stack([u.ravel() - data.mean, u.ravel() + data.mean])
        heights = -0.5 * jnp.einsum("ci,ij,cj->c", away, data.precision, away)
        return jax.nn.logsumexp(heights) + self.log_wall(gap(data, u))

    def log_wall(self, gap):
        """The log of the factor of the wall at some distances (…, node) from it."""
        if self.width:
            return -0.5 * (jnp.minimum(gap, 0.0) ** 2).sum(axis=-1) / self.width**2
        return jnp.where((gap >= 0).all(axis=-1), 0.0, -jnp.inf)

    def evaluate_estimands(self, data, estimands, guess=None):
        u = estimands["u_boundary"]
        return jax.tree.map(jnp.asarray, Found(self.height(data, u), u))

    def supports(self, data, estimands):
        return jnp.isfinite(self.log_wall(gap(data, estimands["u_boundary"])))

    def condition(self, estimands):
        return self.data

    def exact_draws(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """(count, nodes, 3), by rejection."""
        accepted = np.zeros((0, NODES, 3))
        while len(accepted) < count:
            draws = rng.multivariate_normal(np.zeros(DIMENSION), self.covariance, 2 * count)
            draws = (draws + rng.choice([-1, 1], (len(draws), 1)) * np.asarray(self.data.mean)).reshape(-1, NODES, 3)
            allowed = np.log(rng.uniform(size=len(draws))) < np.asarray(self.log_wall(gap(self.data, draws)))
            accepted = np.concatenate([accepted, draws[allowed]])
        return accepted[:count]


def gap(data, u):
    """Distance (…, node) of every node, displaced by u (…, node, 3), to the wall."""
    return data.wall + 0.2 * jnp.sin(u[..., 1]) - u[..., 0]
