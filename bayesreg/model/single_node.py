"""The density in the displacement of one node, approximately, for moves that the density itself then tests.

Each term that knows how gives its part; the others are left out.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from bayesreg.model.blocks import Values
from bayesreg.model.coordinates import complete
from bayesreg.model.pointwise import Intensities
from bayesreg.model.program import Problem
from bayesreg.model.terms.images import ComparedImages
from bayesreg.model.terms.skull import is_allowed
from bayesreg.types import AnyArray, Scalar


class SingleNodes:
    """The densities of single nodes, as the samplers see them (`bayesreg.inference.target.SingleNodes`)."""

    def log_density(
        self, data: Problem, estimands: Values, which: Int[AnyArray, ""]
    ) -> Callable[[Float[AnyArray, "3"]], Scalar]:
        """See `local_logdensity`."""
        return local_logdensity(data, complete(data.blocks, estimands), which)

    def equilibrium(self, data: Problem, estimands: Values, which: Int[AnyArray, ""]) -> Float[AnyArray, "3"]:
        """See `local_equilibrium`."""
        return local_equilibrium(data, estimands["u_boundary"], which)


def local_logdensity(
    problem: Problem, values: Values, which: Int[AnyArray, ""]
) -> Callable[[Float[AnyArray, "3"]], Scalar]:
    """The log density as a function of the displacement of one node, up to a constant and approximately.

    Parameters
    ----------
    problem : Problem
        With neighbourhoods.
    values : mapping
        Where the other nodes are. Those that have neighbourhoods count as if they were in the middle of theirs, so that
        the sum over these is one function of them all.
    which : scalar integer
        The number of one of the neighbourhoods.
    """
    near, body = problem.neighbourhoods, problem.body
    assert near is not None
    images, rigid, skull = images_of(problem), problem.terms.get("rigid"), problem.terms.get("skull")
    assert images is not None
    temperature, quadrature = values["t_similarity"], images.quadrature
    u_boundary = values["u_boundary"].at[near.rows].set(near.at)
    u_prescribed = body.prescribed(u_boundary)
    around = jnp.tensordot(near.response, u_prescribed, 2)

    row, points, follows, at = near.rows[which], near.points[which], near.follows[which], near.at[which]
    base = (quadrature.barycentric[points][:, :, None] * around[near.corners[which]]).sum(axis=1)
    places, fixed, weights = images.positions[points] + base, images.fixed_values[points], quadrature.weights[points]
    similarity = images.similarity.among(points)
    force = jnp.tensordot(near.force[which], u_prescribed, 2)
    stiffness = near.force[which][:, body.slots[row]]
    if rigid is not None:
        motion = rigid.modes.T @ u_boundary.reshape(-1)
        own_motion = jax.lax.dynamic_slice_in_dim(rigid.modes, 3 * row, 3)

    def log(u: Float[AnyArray, "3"]) -> Scalar:
        away = u - at
        pair = Intensities(fixed, images.moving(places + follows @ away), weights)
        similarity_energy = similarity.energy(pair, temperature)
        strain_energy = away @ force + 0.5 * away @ stiffness @ away
        total = -images.independent_share * similarity_energy / temperature - strain_energy / values["t_elastic"]
        if rigid is not None:
            total += rigid.log_of(motion + own_motion.T @ away)
        if skull is None:
            return total
        return jnp.where(is_allowed(skull.distance, (skull.points[row] + u)[None])[0], total, -jnp.inf)

    return log


def local_equilibrium(
    problem: Problem, u_boundary: Float[AnyArray, "sampled 3"], which: Int[AnyArray, ""]
) -> Float[AnyArray, "3"]:
    """Elastic equilibrium of one node, mm: no force acts on it there while all other sampled and held nodes stay.

    At the λ and μ that the problem is conditioned for. `which` is one of the neighbourhoods.
    """
    near = problem.neighbourhoods
    assert near is not None
    row, force = near.rows[which], near.force[which]
    stiffness = force[:, problem.body.slots[row]]
    u_prescribed = problem.body.prescribed(u_boundary)
    return u_boundary[row] - jnp.linalg.solve(stiffness, jnp.tensordot(force, u_prescribed, 2))


def images_of(problem: Problem) -> ComparedImages | None:
    """The pair of images whose quadrature points the neighbourhoods know, if there is one."""
    return next((term for term in problem.terms.values() if isinstance(term, ComparedImages)), None)
