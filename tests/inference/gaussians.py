"""A posterior for the samplers alone: a Gaussian of a few displaced nodes below a wall that bends with the height."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.model.curvature import Curvature

NODES, WALL = 2, 0.6
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


class Walls:
    def clearance(self, data, u, nodes):
        return data.wall + 0.2 * jnp.sin(u[..., 1]) - u[..., 0]

    def without(self, data):
        return data._replace(wall=jnp.asarray(jnp.inf))


class SingleNodes:
    """As if the nodes were independent, and somewhat wider: all of them are moved alone."""

    def log_density(self, data, estimands, which):
        mean, precision = data.mean.reshape(NODES, 3)[which], data.precision.reshape(NODES, 3, NODES, 3)

        def log(u):
            inside = Walls().clearance(data, u[None], which[None])[0] >= 0
            return jnp.where(inside, -0.4 * (u - mean) @ precision[which, :, which] @ (u - mean), -jnp.inf)

        return log

    def equilibrium(self, data, estimands, which):
        return estimands["u_boundary"][which]


class ModeSearch:
    def __init__(self, data):
        self.data = data

    hyperparameters = ()
    approached = tempering = None

    def continuation(self):
        yield self.data

    def curvature(self, data, estimands):
        return Curvature(np.asarray(data.precision), lambda: np.zeros((DIMENSION, DIMENSION)))

    def quadratic_part(self, data):
        return data

    def quadratic_curvature(self, data, estimands, near):
        return np.asarray(data.precision)


class GaussianTarget:
    """N(0, covariance) of "u_boundary", zero where the x of a node exceeds a wall that bends with y.

    With `apart` a mixture of two such, of equal mass, their means so far apart in the y of the first node.
    """

    coordinates, variables, walls, normaliser, single_nodes = Coordinates(), Variables(), Walls(), None, SingleNodes()

    def __init__(self, wall: float = WALL, apart: float = 0.0):
        root = np.random.default_rng(0).normal(size=(DIMENSION, DIMENSION))
        self.covariance = root @ root.T / DIMENSION + 0.3 * np.eye(DIMENSION)
        mean = jnp.zeros(DIMENSION).at[1].set(apart / 2)
        self.data = Data(mean, jnp.asarray(np.linalg.inv(self.covariance)), jnp.asarray(wall))
        self.mode_search = ModeSearch(self.data)

    def height(self, data, u):
        away = jnp.stack([u.ravel() - data.mean, u.ravel() + data.mean])
        heights = -0.5 * jnp.einsum("ci,ij,cj->c", away, data.precision, away)
        return jax.nn.logsumexp(heights)

    def evaluate_estimands(self, data, estimands, guess=None):
        u = estimands["u_boundary"]
        found = Found(jnp.where(self.supports(data, estimands), self.height(data, u), -jnp.inf), u)
        return jax.tree.map(jnp.asarray, found)

    def supports(self, data, estimands):
        return (self.walls.clearance(data, estimands["u_boundary"], jnp.arange(NODES)) >= 0).all()

    def condition(self, estimands, alone=(), quick=False):
        return self.data

    def allowed(self, u):
        """Which nodes (…, node), so displaced, lie before the wall."""
        return np.asarray(self.walls.clearance(self.data, jnp.asarray(u), np.arange(NODES))) >= 0

    def exact_draws(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """(count, nodes, 3), by rejection."""
        kept = np.zeros((0, NODES, 3))
        while len(kept) < count:
            draws = rng.multivariate_normal(np.zeros(DIMENSION), self.covariance, 2 * count)
            draws = (draws + rng.choice([-1, 1], (len(draws), 1)) * np.asarray(self.data.mean)).reshape(-1, NODES, 3)
            kept = np.concatenate([kept, draws[self.allowed(draws).all(axis=1)]])
        return kept[:count]
