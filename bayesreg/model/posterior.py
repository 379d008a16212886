"""The posterior of boundary displacements and Lamé parameters: from the program to log densities."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from bayesreg.fem.equilibrium import ElasticSystem, elastic_system
from bayesreg.fem.multigrid import Multigrid
from bayesreg.fem.preconditioners import ReferenceInverse
from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.model import evaluation
from bayesreg.model.constraint import is_allowed
from bayesreg.model.continuation import continuation
from bayesreg.model.coordinates import (
    FIELD,
    LAME,
    Values,
    complete,
    lame_by_cell,
    least_curvature,
    to_estimands,
    transform,
    whitened,
)
from bayesreg.model.curvature import Curvature, displacement_curvature
from bayesreg.model.evaluation import Evaluation
from bayesreg.model.neighbourhood import neighbourhoods
from bayesreg.model.options import ModelConfig
from bayesreg.model.problem import registration_data, sparsely_compared
from bayesreg.model.program import RegistrationData, in_support, local_equilibrium, local_logdensity, stiffness_factor
from bayesreg.model.similarity import SIMILARITIES, Noise
from bayesreg.types import AnyArray, InputError, Scalar

# Up to this many nodes the elastic prior's normaliser may stand in every step of a trajectory.
CHEAP_NODES = 200

# Of the solves of chains: it leaves an error of some thousandths in the log density, which no acceptance can tell.
CHAIN_TOLERANCE = 1e-6

# Of the solves behind their slopes. A slope that is a little off, and the same at the same place, leaves what is
# sampled as it is: it only proposes.
CHAIN_ADJOINT_TOLERANCE = 1e-3

# Solves are preconditioned at λ and μ within this factor of the posterior's own reference.
NEAR = 1e3


@dataclass(frozen=True, eq=False)
class Posterior:
    """p(u_B, λ, μ | m) of eq. (9), unnormalised. Make one with `build_posterior`.

    Three sets of coordinates name the same state:

    - *values*: ``{"u_boundary": (b, 3), "lam": all entries, "mu": all entries}``, known entries included,
      the scalars "t_similarity", "t_elastic" where they have a prior, and where the elasticity has a field its
      "field_sd" and whitened components "field" (k,);
    - *estimands*: the same with the sampled entries of λ and μ only;
    - *position*: estimands mapped to the real line: λ and μ as Normal scores (`RangeTransform`), temperatures and the
      field's sd by their logarithm.

    Attributes
    ----------
    data : RegistrationData
        All arrays; an argument of every jitted function, so that none is baked into compiled code.
    mesh : TetMesh
    options : ModelConfig
    sampled : (b,) int array
        The nodes whose displacements are sampled, sorted.
    fixed, moving : Image
        f and m, as they were given.

    Notes
    -----
    Two are equal if they differ in the values of their arrays alone: what is compiled for one pair of images then
    serves all others on the mesh.
    """

    data: RegistrationData
    mesh: TetMesh
    options: ModelConfig
    sampled: Int[np.ndarray, "sampled"]
    fixed: Image
    moving: Image

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Posterior) and self._structure == other._structure

    def __hash__(self) -> int:
        return hash(self._structure)

    @cached_property
    def _structure(self) -> tuple[Hashable, ...]:
        leaves, tree = jax.tree.flatten(self.data)
        shapes = tuple((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
        entries = tuple((name, tuple(free.tolist())) for name, free in self.free.items())
        options = self.options.model_dump_json(), self.costly_normaliser
        return self.mesh.digest, *options, tuple(self.sampled.tolist()), entries, tree, shapes

    @cached_property
    def free(self) -> dict[str, Int[np.ndarray, "free"]]:
        """Indices of the sampled entries of λ and of μ."""
        return {name: np.flatnonzero(np.asarray(getattr(self.data, name).is_free)) for name in LAME}

    @cached_property
    def entry_names(self) -> tuple[str, ...]:
        """What the entries of λ and μ stand for: tissue names, "all", or element numbers."""
        return {
            "tissue": self.mesh.names,
            "uniform": ("all",),
            "element": tuple(f"element {i}" for i in range(len(self.mesh.cells))),
            "field": self.mesh.names,
        }[self.options.elasticity]

    def logdensity_constrained(self, values: Values) -> Scalar:
        """log p(u, λ, μ | m) of section 3.1 up to a constant; differentiable.

        Parameters
        ----------
        values : mapping
            "u_boundary" (b, 3) in mm, "lam" and "mu" with all their entries.

        Raises
        ------
        InputError
            If a name or a shape is wrong.
        """
        return self.evaluate(values).logdensity

    def evaluate(self, values: Values) -> Evaluation:
        """`logdensity_constrained` with the energies, the full displacement and the state of the solve."""
        self._require_shapes(values)
        return evaluation.evaluate(self.data, dict(values), self.options.similarity)

    def evaluate_estimands(
        self,
        data: RegistrationData,
        estimands: Values,
        guess: Float[AnyArray, "nodes 3"] | None = None,
    ) -> Evaluation:
        """`evaluate` as a pure function of the data, for samplers of the constrained space.

        With a `guess`, the displacement of every node at a place near by, it is faster and has no gradient.
        """
        return evaluation.evaluate(data, complete(data, estimands, self.free), self.options.similarity, guess)

    @property
    def costly_normaliser(self) -> bool:
        """Whether the elastic prior's normaliser is part of the density, and costs much more than the rest."""
        return self.options.normalised and len(self.mesh.points) > CHEAP_NODES

    def without_normaliser(self, data: RegistrationData) -> RegistrationData:
        """The data of the same problem without `log_normaliser` in its density, and without its cost."""
        return data._replace(determinant=None)

    def log_normaliser(self, data: RegistrationData, estimands: Values) -> Scalar:
        """½ log pdet S(λ, μ) − r/2 log(2π T_r), the elastic prior's normaliser; zero if not `normalised`.

        The same for all displacements: what moves these alone does not need it.
        """
        return evaluation.log_normaliser(data, complete(data, estimands, self.free))

    def supports(self, data: RegistrationData, estimands: Values) -> Bool[AnyArray, ""]:
        """Whether estimands lie where the density may be positive; costs no elastic solve."""
        return in_support(data, **complete(data, estimands, self.free))

    def logdensity(self, position: Values) -> Scalar:
        """Log density of the unconstrained position, the Jacobian of `constrain` included."""
        return self.logdensity_of(self.data, position)

    def logdensity_of(self, data: RegistrationData, position: Values) -> Scalar:
        """`logdensity` as a pure function of the data, for samplers."""
        estimands, log_jacobian = to_estimands(data, position, self.free)
        return self.evaluate_estimands(data, estimands).logdensity + log_jacobian

    def clearance(
        self, data: RegistrationData, u: Float[AnyArray, "*batch nodes 3"], nodes: Int[AnyArray, "nodes"]
    ) -> Float[AnyArray, "*batch nodes"]:
        """Signed distance to Ω_SK, mm, of some rows of "u_boundary" displaced by u; infinite without a skull."""
        places = data.points_sampled[nodes] + u
        if data.skull_distance is None:
            return jnp.full(places.shape[:-1], jnp.inf)
        return data.skull_distance(places)

    def without_walls(self, data: RegistrationData) -> RegistrationData:
        """The data of the same problem without a skull."""
        return data._replace(skull_distance=None)

    def continuation(self) -> Iterator[RegistrationData]:
        """Problems of growing difficulty, in the displacements alone, that lead to this one."""
        return continuation(self.data, self.fixed, self.moving, self.options.interpolation)

    def conditioned(
        self, estimands: Values, alone: Int[AnyArray, "k"] | None = None, quick: bool = False
    ) -> RegistrationData:
        """The data of the same problem for chains: faster near these λ, μ and field, where solves are preconditioned.

        (By a dense inverse, that is; a multigrid hierarchy stays that of the posterior's own reference.)
        Solves end at `CHAIN_TOLERANCE`. The nodes in these rows of "u_boundary" may be moved alone, see
        `local_logdensity`. With `quick` the images are compared at four points of each tetrahedron, whatever the
        model's quadrature.
        """
        data = sparsely_compared(self.data, self.mesh, self.fixed, self.options.interpolation) if quick else self.data
        values = complete(self.data, estimands, self.free)
        # A tissue that is next to nothing leaves K_II without a factor.
        reference = {name: np.asarray(getattr(self.data, name).reference) for name in LAME}
        near = {name: np.clip(values[name], x / NEAR, x * NEAR) for name, x in reference.items()}
        lam, mu = (tuple(by_cell.tolist()) for by_cell in lame_by_cell(self.data, {**values, **near}))
        system = _conditioned_system(self, lam, mu, CHAIN_TOLERANCE, CHAIN_ADJOINT_TOLERANCE)
        rows = np.zeros(0, int) if alone is None else np.asarray(alone)
        slots, at = np.asarray(self.data.slots)[rows], np.asarray(estimands["u_boundary"])[rows]
        around = neighbourhoods(self.mesh, system, data.quadrature, np.array(lam), np.array(mu), slots, rows, at)
        return data._replace(system=system, neighbourhoods=around)

    @property
    def knows_neighbourhoods(self) -> bool:
        """Whether data can be conditioned for `local_logdensity`: a dense preconditioner says what follows a node."""
        return isinstance(self.data.system.preconditioner, ReferenceInverse) or not len(self.data.system.free)

    def local_logdensity(
        self, data: RegistrationData, estimands: Values, which: Int[AnyArray, ""]
    ) -> Callable[[Float[AnyArray, "3"]], Scalar]:
        """Approximate log density of one node's displacement; see `bayesreg.model.program.local_logdensity`."""
        return local_logdensity(data, self.options.similarity, complete(data, estimands, self.free), which)

    def local_equilibrium(
        self, data: RegistrationData, estimands: Values, which: Int[AnyArray, ""]
    ) -> Float[AnyArray, "3"]:
        """Elastic equilibrium of one node; see `bayesreg.model.program.local_equilibrium`."""
        return local_equilibrium(data, estimands["u_boundary"], which)

    def displacement_curvature(self, data: RegistrationData, estimands: Values) -> Curvature:
        """Curvature of −log p(u, λ, μ | m) in "field", if there is one, and "u_boundary".

        Returns
        -------
        Curvature
            First the k components of the field, then row k + 3 · node + axis, 1/mm². Of the elastic energy the
            curvature in the displacements alone is counted.
        """
        values = complete(data, estimands, self.free)
        lam, mu = lame_by_cell(data, values)
        u = _settled(self, self.without_normaliser(data), dict(estimands))
        data = data._replace(**{name: values[name] for name in data.temperature_log_sd})
        sd = float(values.get("field_sd", 0.0))
        found = displacement_curvature(self.mesh, data, self.options.similarity, lam, mu, u, sd)
        if len(self.sampled):
            weight, rows = 1 / (len(self.sampled) * float(data.rigid_sd) ** 2), 3 * len(self.sampled)
            found.gauss_newton[-rows:, -rows:] += weight * np.asarray(data.rigid_modes @ data.rigid_modes.T)
        return found

    def constrain_of(self, data: RegistrationData, position: Values) -> dict[str, AnyArray]:
        """Estimands of an unconstrained position, as a pure function of the data."""
        return to_estimands(data, position, self.free)[0]

    def least_curvature(self, data: RegistrationData, position: Values) -> dict[str, AnyArray]:
        """Of −`logdensity` in every coordinate where next to nothing is known of it; shaped as the position."""
        return least_curvature(data, position, self.free)

    def constrain(self, position: Values) -> dict[str, AnyArray]:
        """Values (known entries included) of an unconstrained position."""
        estimands, _ = to_estimands(self.data, position, self.free)
        return complete(self.data, estimands, self.free)

    def unconstrain(self, values: Values) -> dict[str, AnyArray]:
        """Unconstrained position of values; the inverse of `constrain`."""
        return self.unconstrain_of(self.data, self.estimands(values))

    def unconstrain_of(self, data: RegistrationData, estimands: Values) -> dict[str, AnyArray]:
        """Unconstrained position of estimands, as a pure function of the data; the inverse of `constrain_of`."""
        position = {"u_boundary": estimands["u_boundary"]}
        for name, free in self.free.items():
            if len(free):
                position[name] = transform(getattr(data, name), free).inv(estimands[name])
        return position | whitened(data, estimands) | {name: jnp.log(estimands[name]) for name in data.scales}

    def estimands(self, values: Values) -> dict[str, AnyArray]:
        """The sampled entries of values."""
        self._require_shapes(values)
        free = {name: jnp.asarray(values[name], float)[free] for name, free in self.free.items() if len(free)}
        scales = {name: jnp.asarray(values[name], float) for name in self.data.scales}
        u = {"u_boundary": jnp.asarray(values["u_boundary"], float)}
        return u | free | whitened(self.data, values) | scales

    def reference(self) -> dict[str, AnyArray]:
        """Values at rest: no displacement, λ, μ at their known or reference values, temperatures at their medians.

        The field is zero, its sd the scale of its prior.
        """
        field = self.data.field
        components = {} if field is None else {"field": jnp.zeros(field.basis.shape[1]), "field_sd": field.sd_scale}
        return {
            "u_boundary": jnp.zeros((len(self.sampled), 3)),
            "lam": jnp.asarray(self.data.lam.reference),
            "mu": jnp.asarray(self.data.mu.reference),
            **{name: jnp.asarray(getattr(self.data, name)) for name in self.data.temperature_log_sd},
            **components,
        }

    def allowed(self, u_boundary: Float[AnyArray, "sampled 3"]) -> Bool[np.ndarray, "sampled"]:
        """Which sampled nodes, so displaced (mm), lie outside Ω_SK."""
        distance = self.data.skull_distance
        if distance is None:
            return np.ones(len(self.sampled), bool)
        return np.asarray(is_allowed(distance, self.data.points_sampled + jnp.asarray(u_boundary)))

    def stiffness(self, values: Values) -> Float[AnyArray, "cells"]:
        """Stiffness of every element over that of its tissue, e^s of the field; one where there is no field."""
        if self.data.field is None:
            return jnp.ones(len(self.mesh.cells))
        return stiffness_factor(self.data, *(jnp.asarray(values[name]) for name in FIELD))

    def residuals(self, u: Float[AnyArray, "nodes 3"]) -> Float[AnyArray, "points"]:
        """f(x_q) − m(x_q + u(x_q)) at the quadrature points."""
        return evaluation.residuals(self.data, jnp.asarray(u))

    def noise_sd(self, t_similarity: float) -> float:
        """The noise that a temperature T_s stands for at a point of average weight w: √(T_s / 2w) if it is Gaussian."""
        noise = Noise(jnp.asarray(t_similarity), self.data.degrees_of_freedom)
        variance = SIMILARITIES[self.options.similarity].variance(noise) * t_similarity
        return float(np.sqrt(variance / (2 * np.mean(self.data.quadrature.weights))))

    @property
    def implied_noise_sd(self) -> float:
        """`noise_sd` at the known T_s, or at the median of its prior."""
        return self.noise_sd(float(self.data.t_similarity))

    def constant_data(self) -> dict[str, AnyArray]:
        """Points (mm), cells, tissue of every cell and the sampled nodes."""
        mesh = self.mesh
        return {"points": mesh.points, "cells": mesh.cells, "tissue": mesh.tissue, "boundary": self.sampled}

    def initial(self, key: AnyArray) -> dict[str, AnyArray]:
        """A random position near `reference`: displacements of 0.01 mm, the other coordinates within 0.1."""
        position = self.unconstrain(self.reference())
        keys = jax.random.split(key, len(position))
        return {
            name: value + (0.01 if name == "u_boundary" else 0.1) * jax.random.normal(subkey, value.shape)
            for (name, value), subkey in zip(position.items(), keys, strict=True)
        }

    def energies(self, values: Values) -> dict[str, Scalar]:
        """Every term of the log density by name, and the energies behind them.

        Returns
        -------
        dict
            "similarity_energy" (E_s), "strain_energy" (E_r), and the terms that sum to the log density:
            "log_similarity", "log_prior_lam", "log_prior_mu", "log_support", "log_solved"; where nodes are sampled
            "log_elastic" and "log_rigid"; where T_s is inferred "log_similarity_normaliser", where the density is
            normalised "log_normaliser", and "log_prior_t_similarity", "log_prior_t_elastic", "log_prior_field_sd",
            "log_prior_field" of those inferred.
        """
        self._require_shapes(values)
        return evaluation.terms(self.data, dict(values), self.options.similarity)

    def _require_shapes(self, values: Values) -> None:
        expected = {"u_boundary": (len(self.sampled), 3), **{n: getattr(self.data, n).low.shape for n in LAME}}
        expected |= dict.fromkeys(self.data.scales, ())
        if self.data.field is not None:
            expected["field"] = (self.data.field.basis.shape[1],)
        for name, shape in expected.items():
            if name not in values:
                raise InputError(f"values lack {name!r}; expected {', '.join(expected)}")
            if np.shape(values[name]) != shape:
                raise InputError(f"values[{name!r}] must have shape {shape}, got {np.shape(values[name])}")


def build_posterior(
    fixed: Image,
    moving: Image,
    mesh: TetMesh,
    model: ModelConfig | None = None,
    skull: Image | None = None,
    reference: Mapping[str, AnyArray] | None = None,
) -> Posterior:
    """The posterior of a registration problem.

    Parameters
    ----------
    fixed, moving : Image
        f and m; their intensities are taken as they are.
    mesh : TetMesh
        In the space of `fixed`.
    model : ModelConfig, optional
        The default is the paper's model with three tissues.
    skull : Image, optional
        Nonzero = forbidden; off its grid is forbidden too. None: no constraint.
    reference : mapping, optional
        "lam" and "mu" (all entries) where the interior solve is preconditioned and chains start, and the scale of the
        coordinate of a parameter without an upper bound; the nearer to the posterior the faster. Default: λ = 10,
        μ = 1, and 0.01 for a tissue named "csf".

    Returns
    -------
    Posterior

    Raises
    ------
    InputError
        If the mesh does not overlap an image, lies partly in the skull, an option names a tissue or node that
        does not exist, or the sampled and held nodes do not hold the mesh.
    """
    model = model or ModelConfig()
    data, sampled = registration_data(fixed, moving, mesh, model, skull, reference)
    return Posterior(data, mesh, model, sampled, fixed, moving)


@partial(jax.jit, static_argnums=0)
def _settled(posterior: Posterior, data: RegistrationData, estimands: Values) -> Float[AnyArray, "nodes 3"]:
    return posterior.evaluate_estimands(data, estimands).u


@lru_cache(maxsize=2)
def _conditioned_system(
    posterior: Posterior, lam: tuple[float, ...], mu: tuple[float, ...], *tolerances: float
) -> ElasticSystem:
    system = posterior.data.system
    if isinstance(system.preconditioner, Multigrid):
        # Another reference has aggregates of its own, of other shapes, and everything would be compiled again.
        tolerance, adjoint_tolerance = map(jnp.asarray, tolerances)
        return system._replace(tolerance=tolerance, adjoint_tolerance=adjoint_tolerance)
    return elastic_system(posterior.mesh, np.asarray(system.prescribed), np.array(lam), np.array(mu), *tolerances)
