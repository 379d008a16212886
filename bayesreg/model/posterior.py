"""The posterior of displacements and Lamé parameters: from terms and blocks to log densities."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from bayesreg.fem.equilibrium import ElasticSystem, elastic_system
from bayesreg.fem.multigrid import Multigrid
from bayesreg.fem.preconditioners import ReferenceInverse
from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.model import blocks, evaluation, program, single_node
from bayesreg.model.blocks import LAME, Values
from bayesreg.model.continuation import continuation
from bayesreg.model.curvature import Curvature, displacement_curvature
from bayesreg.model.evaluation import Evaluation
from bayesreg.model.neighbourhood import neighbourhoods
from bayesreg.model.options import ModelConfig
from bayesreg.model.problem import problem_of
from bayesreg.model.program import Problem
from bayesreg.model.state import state_of
from bayesreg.model.terms.images import ComparedImages, ImagePair
from bayesreg.model.terms.term import Outside
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
    """p(u_B, λ, μ | observations) of eq. (9), unnormalised. Make one with `build_posterior`.

    Three sets of coordinates name the same state:

    - *values*: ``{"u_boundary": (b, 3), "lam": all entries, "mu": all entries, "t_similarity", "t_elastic"}``, known
      entries included, and where the elasticity has a field its "field_sd" and whitened components "field" (k,);
    - *estimands*: the sampled entries of these only;
    - *position*: estimands mapped to the real line: λ and μ as Normal scores (`RangeTransform`), temperatures and the
      field's sd by their logarithm.

    Attributes
    ----------
    data : Problem
        All arrays; an argument of every jitted function, so that none is baked into compiled code.
    mesh : TetMesh
    options : ModelConfig
    sampled : (b,) int array
        The nodes whose displacements are sampled, sorted.
    observations : mapping
        The observations by name, as they were given.

    Notes
    -----
    Two are equal if they differ in the values of their arrays alone: what is compiled for one pair of images then
    serves all others on the mesh.
    """

    data: Problem
    mesh: TetMesh
    options: ModelConfig
    sampled: Int[np.ndarray, "sampled"]
    observations: Mapping[str, Any]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Posterior) and self._structure == other._structure

    def __hash__(self) -> int:
        return hash(self._structure)

    @cached_property
    def _structure(self) -> tuple[Hashable, ...]:
        leaves, tree = jax.tree.flatten(self.data)
        shapes = tuple((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
        return self.options.model_dump_json(), self.costly_normaliser, tuple(self.sampled.tolist()), tree, shapes

    @cached_property
    def free(self) -> dict[str, Int[np.ndarray, "free"]]:
        """Indices of the sampled entries of λ and of μ."""
        return {name: self.data.blocks[name].free.index for name in LAME}

    @cached_property
    def entry_names(self) -> tuple[str, ...]:
        """What the entries of λ and μ stand for: tissue names, "all", or element numbers."""
        return {
            "tissue": self.mesh.names,
            "uniform": ("all",),
            "element": tuple(f"element {i}" for i in range(len(self.mesh.cells))),
            "field": self.mesh.names,
        }[self.options.elasticity]

    @property
    def images(self) -> ComparedImages:
        """The first pair of images on the mesh; InputError if there is none."""
        images = single_node.images_of(self.data)
        if images is None:
            raise InputError("the posterior has no pair of images, and so neither residuals nor noise of images")
        return images

    # Densities

    def logdensity_constrained(self, values: Values) -> Scalar:
        """log p(u, λ, μ | m) of section 3.1 up to a constant; differentiable.

        Parameters
        ----------
        values : mapping
            "u_boundary" (b, 3) in mm, "lam" and "mu" with all their entries; known temperatures may be left out.

        Raises
        ------
        InputError
            If a name or a shape is wrong.
        """
        return self.evaluate(values).logdensity

    def evaluate(self, values: Values) -> Evaluation:
        """`logdensity_constrained` with the energies, the full displacement and the state of the solve."""
        return evaluation.evaluate(self.data, self._filled(values))

    def evaluate_estimands(
        self, data: Problem, estimands: Values, guess: Float[AnyArray, "nodes 3"] | None = None
    ) -> Evaluation:
        """`evaluate` as a pure function of the data, for samplers of the constrained space.

        With a `guess`, the displacement of every node at a place near by, it is faster and has no gradient.
        """
        return evaluation.evaluate(data, blocks.completed(data.blocks, estimands), guess)

    def supports(self, data: Problem, estimands: Values) -> Bool[AnyArray, ""]:
        """Whether estimands lie where the density may be positive; costs no elastic solve."""
        return program.allowed(data, blocks.completed(data.blocks, estimands))

    def logdensity(self, position: Values) -> Scalar:
        """Log density of the unconstrained position, the Jacobian of `constrain` included."""
        return self.logdensity_of(self.data, position)

    def logdensity_of(self, data: Problem, position: Values) -> Scalar:
        """`logdensity` as a pure function of the data, for samplers."""
        estimands, log_jacobian = blocks.constrained(data.blocks, position)
        return self.evaluate_estimands(data, estimands).logdensity + log_jacobian

    def energies(self, values: Values) -> dict[str, Scalar]:
        """Every factor of the density by name, and the energies behind them.

        Returns
        -------
        dict
            "similarity_energy" (E_s), "strain_energy" (E_r), and the logarithms that sum to the log density: those of
            the observations by their names ("images"), "elastic", "rigid", "skull" where there are such terms,
            "prior_lam", "prior_mu" and so on of the blocks that are sampled, "support" and "solved".
        """
        return evaluation.terms(self.data, self._filled(values))

    # Coordinates

    def constrain(self, position: Values) -> dict[str, AnyArray]:
        """Values (known entries included) of an unconstrained position."""
        return blocks.completed(self.data.blocks, blocks.constrained(self.data.blocks, position)[0])

    def constrain_of(self, data: Problem, position: Values) -> dict[str, AnyArray]:
        """Estimands of an unconstrained position, as a pure function of the data."""
        return blocks.constrained(data.blocks, position)[0]

    def unconstrain(self, values: Values) -> dict[str, AnyArray]:
        """Unconstrained position of values; the inverse of `constrain`."""
        return self.unconstrain_of(self.data, self.estimands(values))

    def unconstrain_of(self, data: Problem, estimands: Values) -> dict[str, AnyArray]:
        """Unconstrained position of estimands, as a pure function of the data; the inverse of `constrain_of`."""
        return blocks.unconstrained(data.blocks, estimands)

    def estimands(self, values: Values) -> dict[str, AnyArray]:
        """The sampled entries of values."""
        return blocks.estimands_of(self.data.blocks, self._filled(values))

    def reference(self) -> dict[str, AnyArray]:
        """Values at rest: no displacement, λ, μ at their known or reference values, temperatures at their medians.

        The field is zero, its sd the scale of its prior.
        """
        return blocks.reference_values(self.data.blocks)

    def least_curvature(self, data: Problem, position: Values) -> dict[str, AnyArray]:
        """Of −`logdensity` in every coordinate where next to nothing is known of it; shaped as the position."""
        return blocks.least_curvatures(data.blocks, position)

    def initial(self, key: AnyArray) -> dict[str, AnyArray]:
        """A random position near `reference`: displacements of 0.01 mm, the other coordinates within 0.1."""
        position = self.unconstrain(self.reference())
        keys = jax.random.split(key, len(position))
        return {
            name: value + (0.01 if name == "u_boundary" else 0.1) * jax.random.normal(subkey, value.shape)
            for (name, value), subkey in zip(sorted(position.items()), keys, strict=True)
        }

    def _filled(self, values: Values) -> dict[str, AnyArray]:
        """Values with the known blocks that were left out; InputError where a name is missing or a shape is wrong."""
        expected = {name: np.shape(value) for name, value in self.reference().items()}
        for name, shape in expected.items():
            if (name not in values and self.data.blocks[name].is_sampled) or (name in LAME and name not in values):
                raise InputError(f"values lack {name!r}; expected {', '.join(expected)}")
            if name in values and np.shape(values[name]) != shape:
                raise InputError(f"values[{name!r}] must have shape {shape}, got {np.shape(values[name])}")
        return blocks.filled(self.data.blocks, values)

    # The elastic prior's normaliser

    @property
    def costly_normaliser(self) -> bool:
        """Whether the elastic prior's normaliser is part of the density, and costs much more than the rest."""
        return self.options.normalised and len(self.mesh.points) > CHEAP_NODES

    def without_normaliser(self, data: Problem) -> Problem:
        """The data of the same problem without `log_normaliser` in its density, and without its cost."""
        elastic = data.terms.get("elastic")
        return data if elastic is None else data.with_term("elastic", elastic._replace(determinant=None))

    def log_normaliser(self, data: Problem, estimands: Values) -> Scalar:
        """½ log pdet S(λ, μ) − r/2 log(2π T_r), the elastic prior's normaliser; zero if not `normalised`.

        The same for all displacements: what moves these alone does not need it.
        """
        return evaluation.log_normaliser(data, blocks.completed(data.blocks, estimands))

    # The skull

    def clearance(
        self, data: Problem, u: Float[AnyArray, "*batch nodes 3"], nodes: Int[AnyArray, "nodes"]
    ) -> Float[AnyArray, "*batch nodes"]:
        """Signed distance to Ω_SK, mm, of some rows of "u_boundary" displaced by u; infinite without a skull."""
        skull = data.terms.get("skull")
        return jnp.full(u.shape[:-1], jnp.inf) if skull is None else skull.clearance(u, nodes)

    def without_walls(self, data: Problem) -> Problem:
        """The data of the same problem without a skull."""
        return data.without_term("skull")

    def allowed(self, u_boundary: Float[AnyArray, "sampled 3"]) -> Bool[np.ndarray, "sampled"]:
        """Which sampled nodes, so displaced (mm), lie outside Ω_SK."""
        return np.asarray(self.clearance(self.data, jnp.asarray(u_boundary), jnp.arange(len(self.sampled)))) >= 0

    # Chains, the search for the mode, and moves of single nodes

    def continuation(self) -> Iterator[Problem]:
        """Problems of growing difficulty, in the displacements alone, that lead to this one."""
        return continuation(self.data, self.observations, self.options.interpolation)

    def conditioned(self, estimands: Values, alone: Int[AnyArray, "k"] | None = None, quick: bool = False) -> Problem:
        """The data of the same problem for chains: faster near these λ, μ and field, where solves are preconditioned.

        (By a dense inverse, that is; a multigrid hierarchy stays that of the posterior's own reference.)
        Solves end at `CHAIN_TOLERANCE`. The nodes in these rows of "u_boundary" may be moved alone, see
        `local_logdensity`. With `quick` the images are compared at four points of each tetrahedron, whatever the
        model's quadrature.
        """
        data = self._sparse() if quick else self.data
        values = blocks.completed(self.data.blocks, estimands)
        # A tissue that is next to nothing leaves K_II without a factor.
        reference = {name: np.asarray(self.data.blocks[name].reference()) for name in LAME}
        near = {name: np.clip(values[name], x / NEAR, x * NEAR) for name, x in reference.items()}
        lam, mu = (np.asarray(by_cell) for by_cell in data.body.lame_by_cell({**values, **near}))
        tolerances = CHAIN_TOLERANCE, CHAIN_ADJOINT_TOLERANCE
        system = _conditioned_system(self, tuple(lam.tolist()), tuple(mu.tolist()), *tolerances)
        around = None
        if alone is not None and len(alone):
            rows = np.asarray(alone)
            slots, at = np.asarray(data.body.slots)[rows], np.asarray(estimands["u_boundary"])[rows]
            images = single_node.images_of(data)
            assert images is not None
            around = neighbourhoods(self.mesh, system, images.quadrature, lam, mu, slots, rows, at)
        return data._replace(body=data.body._replace(system=system), neighbourhoods=around)

    def _sparse(self) -> Problem:
        data = self.data
        for name, pair in self.observations.items():
            if isinstance(pair, ImagePair):
                term = pair.at_four_points(data.terms[name], self.mesh, self.options.interpolation)
                data = data.with_term(name, term)
        return data

    @property
    def knows_neighbourhoods(self) -> bool:
        """Whether data can be conditioned for `local_logdensity`: a dense preconditioner says what follows a node."""
        system = self.data.body.system
        return single_node.images_of(self.data) is not None and (
            isinstance(system.preconditioner, ReferenceInverse) or not len(system.free)
        )

    def local_logdensity(
        self, data: Problem, estimands: Values, which: Int[AnyArray, ""]
    ) -> Callable[[Float[AnyArray, "3"]], Scalar]:
        """Approximate log density of one node's displacement; see `bayesreg.model.single_node`."""
        return single_node.local_logdensity(data, blocks.completed(data.blocks, estimands), which)

    def local_equilibrium(self, data: Problem, estimands: Values, which: Int[AnyArray, ""]) -> Float[AnyArray, "3"]:
        """Elastic equilibrium of one node; see `bayesreg.model.single_node`."""
        return single_node.local_equilibrium(data, estimands["u_boundary"], which)

    def displacement_curvature(self, data: Problem, estimands: Values) -> Curvature:
        """Curvature of −log p(u, λ, μ | m) in "field", if there is one, and "u_boundary".

        Returns
        -------
        Curvature
            First the k components of the field, then row k + 3 · node + axis, 1/mm². Of the elastic energy the
            curvature in the displacements alone is counted.
        """
        u = _equilibrium(self, self.without_normaliser(data), dict(estimands))
        return displacement_curvature(data, blocks.completed(data.blocks, estimands), u)

    # What a reader of the draws asks

    def stiffness(self, values: Values) -> Float[AnyArray, "cells"]:
        """Stiffness of every element over that of its tissue, e^s of the field; one where there is no field."""
        return self.data.body.stiffness_factor(values)

    def residuals(self, u: Float[AnyArray, "nodes 3"]) -> Float[AnyArray, "points"]:
        """f(x_q) − m(x_q + u(x_q)) at the quadrature points of the (first) pair of images."""
        return _residuals(self.images, jnp.asarray(u))

    def noise_sd(self, t_similarity: float) -> float:
        """The noise that a temperature T_s stands for at a point of average weight w: √(T_s / 2w) if it is Gaussian."""
        return self.images.noise_sd(t_similarity)

    @property
    def implied_noise_sd(self) -> float:
        """`noise_sd` at the known T_s, or at the median of its prior."""
        return self.noise_sd(float(self.data.blocks["t_similarity"].reference()))

    def constant_data(self) -> dict[str, AnyArray]:
        """Points (mm), cells, tissue of every cell and the sampled nodes."""
        mesh = self.mesh
        return {"points": mesh.points, "cells": mesh.cells, "tissue": mesh.tissue, "boundary": self.sampled}


def build_posterior(
    fixed: Image | None = None,
    moving: Image | None = None,
    mesh: TetMesh | None = None,
    model: ModelConfig | None = None,
    skull: Image | None = None,
    reference: Mapping[str, AnyArray] | None = None,
    observations: Sequence[Any] | None = None,
) -> Posterior:
    """The posterior of a registration problem.

    ``build_posterior(mesh=mesh, observations=[ImagePair(fixed, moving), Landmarks(p, q, sd=1.0)])``, or, short for one
    pair of images, ``build_posterior(fixed, moving, mesh)``.

    Parameters
    ----------
    fixed, moving : Image, optional
        f and m of one pair of images; their intensities are taken as they are.
    mesh : TetMesh
        In the space of the fixed image.
    model : ModelConfig, optional
        The default is the paper's model.
    skull : Image, optional
        Nonzero = forbidden; off its grid is forbidden too. None: no constraint.
    reference : mapping, optional
        "lam" and "mu" (all entries) where the interior solve is preconditioned and chains start, and the scale of the
        coordinate of a parameter without an upper bound; the nearer to the posterior the faster. Default: λ = 10,
        μ = 1, and 0.01 for a tissue named "csf".
    observations : sequence, optional
        In place of `fixed` and `moving`: `ImagePair`, `Landmarks`, or any object with a `name` and a function
        `log(state)` that JAX can trace, the log of its factor of the density. It sees the displacement of every node,
        `state.u` (n, 3), mm, and of points inside the mesh, `state.at(points)`.

    Returns
    -------
    Posterior

    Raises
    ------
    InputError
        If the mesh does not overlap an image, lies partly in the skull, an option names a tissue or node that
        does not exist, the sampled and held nodes do not hold the mesh, or an observation is wrong.
    """
    if not isinstance(mesh, TetMesh):
        raise InputError(f"build_posterior needs a mesh: a TetMesh; got {type(mesh).__name__}")
    model, given = model or ModelConfig(), _observations(fixed, moving, observations)
    problem, sampled = problem_of(mesh, given, model, skull, reference)
    posterior = Posterior(problem, mesh, model, sampled, {observation.name: observation for observation in given})
    _require_scalars(posterior)
    return posterior


def _observations(fixed: Image | None, moving: Image | None, observations: Sequence[Any] | None) -> list[Any]:
    """The observations that were given in one of the two forms."""
    if (fixed is None) != (moving is None):
        raise InputError("a pair of images needs both, fixed and moving")
    if fixed is not None and moving is not None and observations is not None:
        raise InputError("give either fixed and moving, or observations; a pair of images is ImagePair(fixed, moving)")
    if fixed is not None and moving is not None:
        return [ImagePair(fixed, moving)]
    if not observations:
        raise InputError("there is nothing observed: give fixed and moving, or observations, such as Landmarks")
    return list(observations)


def _require_scalars(posterior: Posterior) -> None:
    """Raise InputError where an observation from outside gives no real number, before anything long begins."""
    outside = [name for name, term in posterior.data.terms.items() if isinstance(term, Outside)]
    for name in outside:
        found = jax.eval_shape(partial(_log_of, name), posterior.data, posterior.reference())
        if found.shape != () or not jnp.issubdtype(found.dtype, jnp.floating):
            raise InputError(
                f"log(state) of the observation {name!r} must give one real number, got shape {found.shape} of "
                f"{found.dtype}"
            )


def _log_of(name: str, problem: Problem, values: Values) -> Any:
    return jnp.asarray(problem.terms[name].log(state_of(problem.body, problem.blocks, values)))


@partial(jax.jit, static_argnums=0)
def _equilibrium(posterior: Posterior, data: Problem, estimands: Values) -> Float[AnyArray, "nodes 3"]:
    return posterior.evaluate_estimands(data, estimands).u


@jax.jit
def _residuals(images: ComparedImages, u: Float[AnyArray, "nodes 3"]) -> Float[AnyArray, "points"]:
    return images.residuals(u)


@lru_cache(maxsize=2)
def _conditioned_system(
    posterior: Posterior, lam: tuple[float, ...], mu: tuple[float, ...], *tolerances: float
) -> ElasticSystem:
    system = posterior.data.body.system
    if isinstance(system.preconditioner, Multigrid):
        # Another reference has aggregates of its own, of other shapes, and everything would be compiled again.
        tolerance, adjoint_tolerance = map(jnp.asarray, tolerances)
        return system._replace(tolerance=tolerance, adjoint_tolerance=adjoint_tolerance)
    return elastic_system(posterior.mesh, np.asarray(system.prescribed), np.array(lam), np.array(mu), *tolerances)
