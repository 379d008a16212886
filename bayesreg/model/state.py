"""The state of a body: the values of all blocks, and the elastic equilibrium that follows from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from bayesreg.fem.conjugate_gradients import ElasticSystem
from bayesreg.fem.elasticity import total_strain_energy
from bayesreg.fem.elements import Elements
from bayesreg.fem.equilibrium import equilibrium
from bayesreg.fem.location import interpolation_at
from bayesreg.fem.operators import SparseOperator
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import LAME, Blocks, Values
from bayesreg.model.field import StiffnessField
from bayesreg.types import AnyArray, Equilibrium, InputError, Scalar


@jax.tree_util.register_static
class StaticMesh:
    """A mesh as a part of pytrees that has no arrays; two are equal if their content is equal."""

    def __init__(self, mesh: TetMesh) -> None:
        self.mesh = mesh

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StaticMesh) and self.mesh.digest == other.mesh.digest

    def __hash__(self) -> int:
        return hash(self.mesh.digest)


class Body(NamedTuple):
    """The elastic body, which converts values into a state (a pytree).

    Attributes
    ----------
    mesh : StaticMesh
    system : ElasticSystem
    cell_entry : (m,) int array
        Index of each cell's entry in λ and μ.
    field : StiffnessField or None
        Prior of the logarithm of a factor on λ and μ of every cell.
    sampled_index : (b,) int array
        Indices of the sampled nodes in `system.prescribed`.
    scatter_to_prescribed : SparseOperator
        (prescribed, b): puts values of the sampled nodes into their places, and zero into the others.
    held : (prescribed, 3) array
        Known displacements, zero in the rows of sampled nodes, mm.
    """

    mesh: StaticMesh
    system: ElasticSystem
    cell_entry: Int[AnyArray, "cells"]
    field: StiffnessField | None
    sampled_index: Int[AnyArray, "sampled"]
    scatter_to_prescribed: SparseOperator
    held: Float[AnyArray, "prescribed 3"]

    def prescribed(self, u_boundary: Float[AnyArray, "sampled 3"]) -> Float[AnyArray, "prescribed 3"]:
        """Return the displacements of all prescribed nodes, mm. (XLA would compile a scatter to a loop on the CPU.)"""
        return self.held + self.scatter_to_prescribed(u_boundary) if len(self.sampled_index) else self.held

    def stiffness_factor(self, values: Values) -> Float[AnyArray, "cells"]:
        """Return exp(sd · basis · z), the factor of the field on λ and μ of every cell."""
        if self.field is None:
            return jnp.ones(self.cell_entry.shape)
        return jnp.exp(values["field_sd"] * (self.field.basis @ values["field"]))

    def is_physical(self, values: Values) -> Bool[AnyArray, ""]:
        """Check whether K is positive definite up to rigid motions: finite λ ≥ 0, μ > 0 and field factor > 0."""
        lam, mu = values["lam"], values["mu"]
        physical = ((lam >= 0) & jnp.isfinite(lam)).all() & ((mu > 0) & jnp.isfinite(mu)).all()
        if self.field is not None:
            factor = self.stiffness_factor(values)
            physical &= (jnp.isfinite(factor) & (factor > 0)).all()
        return physical

    def lame_by_cell(self, values: Values) -> tuple[Float[AnyArray, "cells"], Float[AnyArray, "cells"]]:
        """Return λ and μ of every cell."""
        lam, mu = (jnp.asarray(values[name])[self.cell_entry] for name in LAME)
        if self.field is None:
            return lam, mu
        factor = self.stiffness_factor(values)
        return lam * factor, mu * factor


@dataclass(frozen=True, eq=False)
class State:
    """The state on which every term of the posterior depends; each evaluation makes a new one.

    Attributes
    ----------
    values : mapping
        Values of every block by its name, known ones included: "u_boundary" (b, 3) in mm, "lam", "mu", …
    lam, mu : (m,) arrays
        Lamé parameters by cell.
    equilibrium : Equilibrium
    elements : Elements
    mesh : TetMesh
    """

    values: Mapping[str, AnyArray]
    lam: Float[AnyArray, "cells"]
    mu: Float[AnyArray, "cells"]
    equilibrium: Equilibrium
    elements: Elements
    mesh: TetMesh

    @property
    def u(self) -> Float[AnyArray, "nodes 3"]:
        """The displacement of every node, mm."""
        return self.equilibrium.u

    @cached_property
    def strain_energy(self) -> Scalar:
        """The strain energy E_r, eq. (3)."""
        energy = total_strain_energy(self.elements, self.lam, self.mu, self.u)
        # Without the barrier, XLA computes the energy twice: for the density and for the record.
        return jax.lax.optimization_barrier(energy)

    def at(self, points: Any) -> Float[AnyArray, "k 3"]:
        """Return the displacements of points inside the mesh, mm.

        Parameters
        ----------
        points : (k, 3) array
            World RAS mm; a concrete array, not one that JAX traces.

        Raises
        ------
        InputError
            If the shape is wrong, or a point lies outside the mesh.
        """
        points = np.asarray(points, float)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"state.at takes points of shape (k, 3), mm; got shape {points.shape}")
        nodes, weights = _locate(StaticMesh(self.mesh), points.tobytes(), len(points))
        return jnp.einsum("ka,kai->ki", weights, self.u[nodes])


def state_of(body: Body, blocks: Blocks, values: Values, guess: Float[AnyArray, "nodes 3"] | None = None) -> State:
    """Compute the state of values; if K may be indefinite, use the reference λ and μ, so that the solve ends soon.

    A `guess` of the displacement of every node makes the solve faster (see `bayesreg.fem.equilibrium.equilibrium`); it
    has no derivative.
    """
    lam, mu = physical_lame_by_cell(body, blocks, values)
    solution = equilibrium(body.system, lam, mu, body.prescribed(values["u_boundary"]), guess)
    return State(values, lam, mu, solution, body.system.elements, body.mesh.mesh)


def physical_lame_by_cell(
    body: Body, blocks: Blocks, values: Values
) -> tuple[Float[AnyArray, "cells"], Float[AnyArray, "cells"]]:
    """Return λ and μ of every cell, or their references if K may be indefinite (the density is −∞ there)."""
    physical = body.is_physical(values)
    lam, mu = (jnp.where(physical, values[name], blocks[name].reference())[body.cell_entry] for name in LAME)
    if body.field is None:
        return lam, mu
    factor = jnp.where(physical, body.stiffness_factor(values), 1.0)
    return lam * factor, mu * factor


@lru_cache(maxsize=64)
def _locate(mesh: StaticMesh, points: bytes, count: int) -> tuple[np.ndarray, np.ndarray]:
    return interpolation_at(mesh.mesh, np.frombuffer(points).reshape(count, 3))
