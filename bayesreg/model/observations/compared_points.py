"""The term of pairs of points on a mesh."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Float, Int

from bayesreg.model.blocks import Blocks, Values
from bayesreg.model.observations.point_noise import Adjusted, NormalNoise
from bayesreg.model.state import State
from bayesreg.model.term import Label, PointCurvature
from bayesreg.types import AnyArray, Scalar


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
        known_part = self.noise.distribution(jnp.zeros_like(known_sd), known_sd).log_prob(0.0 * mean)
        return Adjusted(whole, constant=known_part)

    def predicted(self, state: State) -> Float[AnyArray, "k 3"]:
        """Return the predicted displacement u(p), mm."""
        return self.interpolate(state.u)

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
        push = (self.shift - self.interpolate(u)) / sd**2
        bend = self.noise.bend(self.squares(u, sd))
        return PointCurvature(self.nodes, self.weights, bend[:, None, None] * push[:, :, None] * push[:, None, :])

    def score(self, u: Float[AnyArray, "nodes 3"], values: Values) -> Float[AnyArray, "k 3"]:
        """Return the slope of the log density in the displacement of every point, 1/mm."""
        sd = self.sd(values)
        return self.noise.weight(self.squares(u, sd))[:, None] * (self.shift - self.interpolate(u)) / sd**2

    def squares(self, u: Float[AnyArray, "nodes 3"], sd: Float[AnyArray, "k 3"]) -> Float[AnyArray, "k"]:
        """Return z², the squared distance of every landmark from its predicted place, in units of sd."""
        return (((self.shift - self.interpolate(u)) / sd) ** 2).sum(axis=1)

    def draw_weights(
        self, key: AnyArray, values: Values, blocks: Blocks
    ) -> tuple[Float[AnyArray, "k"], dict[str, AnyArray]]:
        """Draw the weight τ of every point given all values, where every node is sampled, and sds with the weights.

        The weights determine an sd that is inferred so narrowly that both would move each other in small steps only.
        Every such sd is therefore multiplied by one factor c and the weights by c², which leaves the errors' variances
        as they are (Yu and Meng 2011). The prior of the weights alone gives c² ~ Gamma(k ν/2, ν Σ τ / 2), a proposal
        that Metropolis accepts by all other factors.

        Returns
        -------
        weights : (k,) array
            One for Normal errors.
        scales : dict
            The sds that are inferred.
        """
        key_weights, key_factor, key_accept = jax.random.split(key, 3)
        residual, scales = self.shift - self.interpolate(values["u_boundary"]), self.hyperparameters
        weights = self.noise.draw_weights(key_weights, ((residual / self.sd(values)) ** 2).sum(axis=1))
        if not scales or isinstance(self.noise, NormalNoise):
            return weights, {}

        def others(factor: Scalar) -> Scalar:
            scaled = {name: factor * values[name] for name in scales}
            sd = self.sd({**values, **scaled}) / (factor * jnp.sqrt(weights)[:, None])
            priors = sum(blocks[name].prior().log_prob(scale) + jnp.log(scale) for name, scale in scaled.items())
            return priors + dist.Normal(0.0, sd).log_prob(residual).sum()

        nu = self.noise.nu
        square = 2 * jax.random.gamma(key_factor, nu * len(weights) / 2) / (nu * weights.sum())
        gain = others(jnp.sqrt(square)) - others(jnp.ones(()))
        factor = jnp.where(jnp.log(jax.random.uniform(key_accept)) < gain, jnp.sqrt(square), 1.0)
        return factor**2 * weights, {name: factor * values[name] for name in scales}

    def interpolate(self, u: Float[AnyArray, "nodes *shape"]) -> Float[AnyArray, "k *shape"]:
        """Interpolate nodal values, such as displacements, at the points."""
        return jnp.einsum("ka,ka...->k...", self.weights, jnp.asarray(u)[self.nodes])

    def _with_distance(self, sd: Float[AnyArray, "k 3"]) -> Float[AnyArray, "k 3"]:
        return jnp.sqrt(sd**2 + self.beyond[:, None] ** 2)


# Searches for hyperparameters ask for it many times.
@jax.jit
def _weighted_precision(
    term: ComparedPoints, u: Float[AnyArray, "nodes 3"], values: Values
) -> Float[AnyArray, "k 3 3"]:
    sd = term.sd(values)
    return term.noise.weight(term.squares(u, sd))[:, None, None] * jnp.eye(3) / sd[:, None, :] ** 2
