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


class GaussianTarget:
    """N(0, covariance) of "u_boundary", zero where the x of a node exceeds a wall that bends with y.

    With `apart` a mixture of two such, of equal mass, their means so far apart in the y of the first node.
    """

    free: ClassVar = {"lam": np.zeros(0, int), "mu": np.zeros(0, int)}
    entry_names = ("tissue",)
    sampled = np.arange(NODES)
    costly_normaliser = False
    knows_neighbourhoods = True

    def __init__(self, wall: float = WALL, apart: float = 0.0):
        root = np.random.default_rng(0).normal(size=(DIMENSION, DIMENSION))
        self.covariance = root @ root.T / DIMENSION + 0.3 * np.eye(DIMENSION)
        mean = jnp.zeros(DIMENSION).at[1].set(apart / 2)
        self.data = Data(mean, jnp.asarray(np.linalg.inv(self.covariance)), jnp.asarray(wall))

    def clearance(self, data, u, nodes):
        return data.wall + 0.2 * jnp.sin(u[..., 1]) - u[..., 0]

    def logdensity_of(self, data, position):
        u = position["u_boundary"]
        away = jnp.stack([u.ravel() - data.mean, u.ravel() + data.mean])
        inside = (self.clearance(data, u, self.sampled) >= 0).all()
        heights = -0.5 * jnp.einsum("ci,ij,cj->c", away, data.precision, away)
        return jnp.where(inside, jax.nn.logsumexp(heights), -jnp.inf)

    def evaluate_estimands(self, data, estimands, guess=None):
        found = Found(self.logdensity_of(data, estimands), estimands["u_boundary"])
        return jax.tree.map(jnp.asarray, found)

    def constrain_of(self, data, position):
        return dict(position)

    def unconstrain_of(self, data, estimands):
        return dict(estimands)

    def estimands(self, values):
        return {"u_boundary": jnp.asarray(values["u_boundary"], float)}

    unconstrain = estimands

    def reference(self):
        return {"u_boundary": jnp.zeros((NODES, 3)), "lam": jnp.ones(1), "mu": jnp.ones(1)}

    def supports(self, data, estimands):
        return jnp.isfinite(self.logdensity_of(data, estimands))

    def allowed(self, u):
        return np.asarray(self.clearance(self.data, jnp.asarray(u), self.sampled)) >= 0

    def constant_data(self):
        return {}

    def conditioned(self, estimands, alone, quick=False):
        return self.data

    def local_logdensity(self, data, estimands, which):
        """As if the nodes were independent, and somewhat wider: all of them are moved alone."""
        mean, precision = data.mean.reshape(NODES, 3)[which], data.precision.reshape(NODES, 3, NODES, 3)

        def log(u):
            inside = self.clearance(data, u[None], which[None])[0] >= 0
            return jnp.where(inside, -0.4 * (u - mean) @ precision[which, :, which] @ (u - mean), -jnp.inf)

        return log

    def local_equilibrium(self, data, estimands, which):
        return estimands["u_boundary"][which]

    def log_normaliser(self, data, estimands):
        return jnp.zeros(())

    def without_normaliser(self, data):
        return data

    def without_walls(self, data):
        return data._replace(wall=jnp.asarray(jnp.inf))

    def continuation(self):
        yield self.data

    def least_curvature(self, data, position):
        return jax.tree.map(jnp.ones_like, position)

    def displacement_curvature(self, data, estimands):
        return Curvature(np.asarray(data.precision), lambda: np.zeros((DIMENSION, DIMENSION)))

    def exact_draws(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """(count, nodes, 3), by rejection."""
        kept = np.zeros((0, NODES, 3))
        while len(kept) < count:
            draws = rng.multivariate_normal(np.zeros(DIMENSION), self.covariance, 2 * count)
            draws = (draws + rng.choice([-1, 1], (len(draws), 1)) * np.asarray(self.data.mean)).reshape(-1, NODES, 3)
            kept = np.concatenate([kept, draws[self.allowed(draws).all(axis=1)]])
        return kept[:count]
