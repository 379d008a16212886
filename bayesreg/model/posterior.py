"""The posterior of displacements and Lamé parameters, for evaluation and sampling."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from bayesreg.mesh import TetMesh
from bayesreg.model import coordinates, evaluation
from bayesreg.model.blocks import LAME, Values
from bayesreg.model.curvature import displacement_curvature
from bayesreg.model.evaluation import Evaluation
from bayesreg.model.observations.images.likelihood import ComparedImages, images_of
from bayesreg.model.observations.observation import Correlated
from bayesreg.model.options import ModelConfig
from bayesreg.model.program import Problem
from bayesreg.model.target import PosteriorTarget
from bayesreg.types import AnyArray, InputError, Scalar


@dataclass(frozen=True, eq=False)
class Posterior:
    """The unnormalised posterior p(u_B, λ, μ | observations) of eq. (9); `build_posterior` makes it.

    A state has three sets of coordinates:

    - *values*: ``{"u_boundary": (b, 3), "lam": all entries, "mu": all entries, "t_similarity", "t_elastic"}``, with
      known entries, and for a field of stiffness its "field_sd" and whitened components "field" (k,);
    - *estimands*: only the sampled entries of the values;
    - *position*: estimands mapped to the real line: λ and μ as Normal scores (`RangeTransform`), temperatures and the
      field's sd by their logarithm.

    Attributes
    ----------
    data : Problem
        All arrays. It is an argument of every jitted function, so that no array becomes a constant of compiled code.
    mesh : TetMesh
    options : ModelConfig
    sampled : (b,) int array
        The nodes whose displacements are sampled, sorted.
    observations : mapping
        The observations, prepared for this mesh, by name.
    search_start : mapping, optional
        Estimands near the mode, at which a search for it begins.
    tempered : bool
        False if residuals must still determine how many quadrature points are independent (`independent_points:
        residual`); until then, all points count.
    """

    data: Problem
    mesh: TetMesh
    options: ModelConfig
    sampled: Int[np.ndarray, "sampled"]
    observations: Mapping[str, Any]
    search_start: Values | None = None
    tempered: bool = True

    def logdensity_constrained(self, values: Values) -> Scalar:
        """Return log p(u, λ, μ | m) of section 3.1 up to a constant; it is differentiable.

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
        """Return the log density with the energies, the full displacement and the state of the solve."""
        return evaluation.evaluate(self.data, self.fill(values))

    def logdensity(self, position: Values) -> Scalar:
        """Return the log density of the unconstrained position, including the Jacobian of `constrain`."""
        estimands, log_jacobian = self.target.coordinates.constrain(self.data, position)
        return self.target.evaluate_estimands(self.data, estimands).logdensity + log_jacobian

    def energies(self, values: Values) -> dict[str, Scalar]:
        """Return every factor of the density by name, and the energies.

        Returns
        -------
        dict
            "similarity_energy" (E_s), "strain_energy" (E_r), and the logarithms that sum to the log density: those of
            the observations by their names ("images"), "elastic", "rigid", "skull" where there are such terms,
            "prior_lam", "prior_mu" and so on of the blocks that are sampled, "support" and "solved".
        """
        return evaluation.terms(self.data, self.fill(values))

    def constrain(self, position: Values) -> dict[str, AnyArray]:
        """Return the values (known entries included) of an unconstrained position."""
        return coordinates.complete(self.data.blocks, self.target.coordinates.constrain(self.data, position)[0])

    def unconstrain(self, values: Values) -> dict[str, AnyArray]:
        """Return the unconstrained position of values; this is the inverse of `constrain`."""
        return self.target.coordinates.unconstrain(self.data, self.estimands(values))

    def estimands(self, values: Values) -> dict[str, AnyArray]:
        """Return the sampled entries of values."""
        return coordinates.estimands_of(self.data.blocks, self.fill(values))

    def reference(self) -> dict[str, AnyArray]:
        """Return the values at rest: displacements of zero, known or reference λ and μ, temperatures at their medians.

        The field is zero, and its sd is the scale of its prior.
        """
        return coordinates.reference_values(self.data.blocks)

    def initial(self, key: AnyArray) -> dict[str, AnyArray]:
        """Draw a random position near `reference`: displacements with sd 0.01 mm, other coordinates with sd 0.1."""
        position = self.unconstrain(self.reference())
        keys = jax.random.split(key, len(position))
        return {
            name: value + (0.01 if name == "u_boundary" else 0.1) * jax.random.normal(subkey, value.shape)
            for (name, value), subkey in zip(sorted(position.items()), keys, strict=True)
        }

    def fill(self, values: Values) -> dict[str, AnyArray]:
        """Add known temperatures that were omitted from values.

        Raises
        ------
        InputError
            If a name is missing or a shape is wrong.
        """
        blocks, expected = self.data.blocks, {name: np.shape(value) for name, value in self.reference().items()}
        if unknown := sorted(set(values) - set(expected)):
            raise InputError(f"values hold the unknown {', '.join(unknown)}; expected {', '.join(expected)}")
        for name, shape in expected.items():
            if name not in values and (name in LAME or blocks[name].is_sampled):
                raise InputError(f"values lack {name!r}; expected {', '.join(expected)}")
            if name in values and np.shape(values[name]) != shape:
                raise InputError(f"values[{name!r}] must have shape {shape}, got {np.shape(values[name])}")
        return coordinates.fill(blocks, values)

    def count_independent_points(self, values: Values) -> dict[str, float]:
        """Count the independent quadrature points of each pair of images, from its residuals at these values.

        The counted points are those of the rule "voxels". If all nodes are sampled and points are compared one by one,
        see `bayesreg.model.observations.images.independence.excess_of_patches`, else `independent_scores` there.
        """
        filled = self.fill(values)
        u = self.evaluate(filled).u
        correlated = {
            name: observation for name, observation in self.observations.items() if isinstance(observation, Correlated)
        }
        pairs = [
            term for term in self.data.terms.values() if isinstance(term, ComparedImages) and term.name in correlated
        ]
        by_patches = [term for term in pairs if term.is_pointwise and len(self.sampled) == len(self.mesh.points)]
        counts: dict[str, float] = {}
        if by_patches:
            size = 3 * len(self.sampled)
            curvature = displacement_curvature(self.data, filled, u).gauss_newton[-size:, -size:]
            counts = {term.name: term.count_by_patches(u, filled, curvature) for term in by_patches}
        return counts | {
            name: observation.count_independent_points(self.data.terms[name], u, filled)
            for name, observation in correlated.items()
            if name not in counts
        }

    def with_independent_points(self, counts: Mapping[str, float]) -> Posterior:
        """Return the posterior with each pair of images tempered to its count of independent points."""
        data = self.data
        for name, count in counts.items():
            data = data.with_term(name, data.terms[name].with_independent_points(count))
        return replace(self, data=data, tempered=True)

    def tempered_by(self, counts: Mapping[str, float], values: Values) -> Posterior:
        """Return the posterior with these counts of independent points, whose searches start at some values."""
        return replace(self.with_independent_points(counts), search_start=self.estimands(values))

    @property
    def independent_points(self) -> dict[str, float]:
        """The number of independent quadrature points that the likelihood assumes, by name of the pair of images."""
        names = [name for name, observation in self.observations.items() if isinstance(observation, Correlated)]
        return {name: float(self.data.terms[name].independent_points) for name in names}

    @property
    def images(self) -> ComparedImages:
        """The first pair of images on the mesh; InputError if there is none."""
        images = images_of(self.data)
        if images is None:
            raise InputError("the posterior has no pair of images, and so neither residuals nor noise of images")
        return images

    @cached_property
    def target(self) -> PosteriorTarget:
        """The posterior as the samplers use it."""
        return PosteriorTarget(self)
