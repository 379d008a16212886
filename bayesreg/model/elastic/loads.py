"""The elastic prior of random loads: equilibrium with random forces, K u = q in place of eq. (7)."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float

from bayesreg.fem.determinant import SchurDeterminant
from bayesreg.fem.elasticity import internal_force, rigid_modes
from bayesreg.fem.elements import Elements, boundary_areas
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Values
from bayesreg.model.state import State
from bayesreg.model.stiffness_parts import StiffnessParts
from bayesreg.settings import KnownOrInferred, ScalePrior, Section, Vector
from bayesreg.types import AnyArray, Matrix, Scalar

# 95 % of this prior is within a factor of 360 of its median.
BODY = ScalePrior(median=0.1, log_sd=3.0)
# Body forces alone may explain the motion. The data then say only that surface forces are small. A wider prior would
# have a long tail of sizes that are as good as zero, which chains seldom enter and leave.
SURFACE = ScalePrior(median=0.1, log_sd=1.5)


class RandomLoads(Section):
    """Equilibrium with random loads: all nodes are sampled, and the displacements depend little on the mesh."""

    normalised: ClassVar[bool] = True
    nodes: ClassVar[str] = "all"
    held: ClassVar[dict[int, Vector]] = {}
    samples_no_node: ClassVar[bool] = False

    kind: Literal["loads"] = "loads"
    body: KnownOrInferred = BODY
    """Standard deviation of the white noise of body forces (unit of μ times mm^½), or its prior."""
    surface: KnownOrInferred = SURFACE
    """Standard deviation of the white noise of surface forces (unit of μ times mm), or its prior."""

    @property
    def scales(self) -> dict[str, KnownOrInferred]:
        """The scales of this prior by the names of their blocks."""
        return {"body_load": self.body, "surface_load": self.surface}

    def on(self, mesh: TetMesh, determinant: SchurDeterminant | None) -> LoadsTerm:
        """Make the term on a mesh whose nodes are all sampled."""
        volumes = np.bincount(mesh.cells.ravel(), np.repeat(mesh.volumes / 4, 4), len(mesh.points))
        arrays = volumes, boundary_areas(mesh), rigid_modes(mesh.points)
        return LoadsTerm(determinant, *(jnp.asarray(array) for array in arrays))


class LoadsTerm(NamedTuple):
    """Equilibrium with random loads: K u = q in place of eq. (7), q ~ N(0, D), D = s² M + t² A on the diagonal.

    The body forces are white noise with density s, where M has the lumped volumes of the nodes. The surface forces are
    white noise with density t, where A has their lumped areas. The body is free and at rest, so the forces are
    balanced. The distribution of u is then N(0, (K D⁻¹ K)⁺), up to a rigid motion; u is as smooth as that of an elastic
    body. Its variance at a point has a limit under mesh refinement, unlike that of exp(−E_r / T_r) on all nodes
    (Lindgren, Rue and Lindström 2011; Bui-Thanh, Ghattas, Martin and Stadler 2013). Without body forces, s → 0, the
    inside is in equilibrium: eq. (7).

    Attributes
    ----------
    determinant : SchurDeterminant or None
        If it is None, the normaliser omits log pdet K.
    volumes : (n,) array
        Diagonal of M, mm³.
    areas : (n,) array
        Diagonal of A, mm², zero inside.
    rigid : (3n, 6) array
        Orthonormal basis of the rigid motions, which need no force.
    """

    determinant: SchurDeterminant | None
    volumes: Float[AnyArray, "nodes"]
    areas: Float[AnyArray, "nodes"]
    rigid: Float[AnyArray, "rows 6"]

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        """The names of the scales whose joint mode with the displacements misleads."""
        return tuple(self.powers)

    @property
    def powers(self) -> dict[str, float]:
        """The scales by the names of their blocks; each is a temperature to the given power."""
        return {"body_load": 0.5, "surface_load": 0.5}

    @property
    def name(self) -> str:
        """The name of the term."""
        return "elastic"

    @property
    def masses(self) -> Float[np.ndarray, "2 rows"]:
        """The diagonals of M and A with one number for each unknown of a node."""
        return np.repeat(np.stack([np.asarray(self.volumes), np.asarray(self.areas)]), 3, axis=1)

    def variances(self, values: Values) -> Float[AnyArray, "nodes"]:
        """Return the diagonal of D at each node: the variance of every component of its load."""
        return values["body_load"] ** 2 * self.volumes + values["surface_load"] ** 2 * self.areas

    def log(self, state: State) -> Scalar:
        """Return −½ qᵀ D⁻¹ q plus the log normaliser, without log pdet K if that is omitted."""
        load = internal_force(state.elements, state.lam, state.mu, state.u)
        energy = (load**2 / self.variances(state.values)[:, None]).sum() / 2
        log_pdet = self.log_normaliser(state.elements, state.lam, state.mu, state.values)
        return -energy + log_pdet + self._log_normaliser_of_loads(state.values)

    def log_normaliser(
        self, elements: Elements, lam: Float[AnyArray, "cells"], mu: Float[AnyArray, "cells"], values: Values
    ) -> Scalar:
        """Return log pdet K, the costly part of the normaliser; zero if it is omitted.

        The whole normaliser is ½ log pdet(K D⁻¹ K) − r/2 log 2π, r = 3n − 6. With an orthonormal basis R of the null
        space of K, pdet(K D⁻¹ K) = (pdet K)² det(Rᵀ D R) / det D. The reason is Jacobi's identity: the determinant of
        the block of D⁻¹ in the complement of R equals the determinant of the block of D in R over det D.
        """
        if self.determinant is None:
            return jnp.zeros(())
        return self.determinant.log_pseudo_determinant(elements, lam, mu)

    def _log_normaliser_of_loads(self, values: Values) -> Scalar:
        """Return ½ (log det Rᵀ D R − log det D − r log 2π)."""
        variances = jnp.repeat(self.variances(values), 3)
        # Cholesky's factor compiles sooner than the pivots of `slogdet`.
        lower = jnp.linalg.cholesky(self.rigid.T @ (variances[:, None] * self.rigid))
        in_null_space = 2 * jnp.log(jnp.diagonal(lower)).sum()
        rank = len(variances) - self.rigid.shape[1]
        return 0.5 * (in_null_space - jnp.log(variances).sum() - rank * jnp.log(2 * jnp.pi))

    def curvature(self, stiffness: Matrix, values: Values) -> Matrix:
        """Return K D⁻¹ K, 1/mm²."""
        weights = np.repeat(1 / np.asarray(self.variances(values)), 3)
        return stiffness @ (scipy.sparse.diags(weights) @ stiffness)

    def trace(
        self, parts: StiffnessParts, covariance: Float[np.ndarray, "unknowns unknowns"]
    ) -> Callable[[Float[np.ndarray, "parts"], Values], float]:
        """Make the function (φ, values) → tr(C K D⁻¹ K), where φ multiplies the parts of K."""
        forms = parts.quadratic_forms(covariance)

        def trace(coefficients: Float[np.ndarray, "parts"], values: Values) -> float:
            weighted = np.tensordot(1 / np.asarray(self.variances(values)), forms, axes=1)
            return float(coefficients @ weighted @ coefficients)

        return trace
