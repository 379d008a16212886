"""The posterior as the samplers use it: `bayesreg.inference.target.Target` of a posterior of this model."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bayesreg.model import coordinates, evaluation, program
from bayesreg.model.blocks import Values
from bayesreg.model.conditioning import condition, simplify
from bayesreg.model.coordinates import Coordinates
from bayesreg.model.elastic.skull import Skull, mark_behind_skull
from bayesreg.model.evaluation import Evaluation
from bayesreg.model.marginal import Marginalisation
from bayesreg.model.mode_search import ModeSearch
from bayesreg.model.normaliser import Normaliser
from bayesreg.model.program import Problem
from bayesreg.model.variables import Variables
from bayesreg.types import AnyArray

if TYPE_CHECKING:
    from bayesreg.model.posterior import Posterior

# With at most this many nodes, every step of a trajectory can evaluate the elastic prior's normaliser.
CHEAP_NODES = 200


@dataclass(frozen=True, eq=False)
class PosteriorTarget:
    """The target of a posterior; `Posterior.target` makes it.

    Attributes
    ----------
    posterior : Posterior

    Notes
    -----
    Two targets are equal if they differ only in the values of their arrays: code compiled for one pair of images then
    serves all other pairs on the mesh.
    """

    posterior: Posterior

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PosteriorTarget) and self._structure == other._structure

    def __hash__(self) -> int:
        return hash(self._structure)

    @cached_property
    def _structure(self) -> tuple[Hashable, ...]:
        leaves, tree = jax.tree.flatten(self.data)
        shapes = tuple((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
        posterior = self.posterior
        options = [
            posterior.options,
            *(getattr(observation, "options", None) for observation in posterior.observations.values()),
        ]
        return repr(options), self.normaliser, tuple(posterior.sampled.tolist()), tree, shapes

    @property
    def data(self) -> Problem:
        """All arrays of the posterior."""
        return self.posterior.data

    @cached_property
    def coordinates(self) -> Coordinates:
        """The map between estimands and the real line."""
        return Coordinates(self.data.blocks)

    @cached_property
    def variables(self) -> Variables:
        """The names, dimensions and labels with which draws are shown to a reader."""
        mesh = self.posterior.mesh
        by_elasticity = {"uniform": ("all",), "element": tuple(f"element {i}" for i in range(len(mesh.cells)))}
        names = by_elasticity.get(self.posterior.options.elasticity, mesh.names)
        return Variables(self.data.blocks, mesh, self.posterior.sampled, names)

    def evaluate_estimands(
        self, data: Problem, estimands: Values, guess: Float[AnyArray, "nodes 3"] | None = None
    ) -> Evaluation:
        """Evaluate the density as a pure function of the data; see `Posterior.evaluate`.

        A `guess` is the displacement of every node in a state near by. It makes the evaluation faster and removes
        the gradient.
        """
        return evaluation.evaluate(data, coordinates.complete(data.blocks, estimands), guess)

    def supports(self, data: Problem, estimands: Values) -> Bool[AnyArray, ""]:
        """Check whether the density may be positive at some estimands; this costs no elastic solve."""
        return program.is_allowed(data, coordinates.complete(data.blocks, estimands))

    def condition(self, estimands: Values) -> Problem:
        """Return the data for chains near these estimands; see `bayesreg.model.conditioning`."""
        return condition(self.data, estimands)

    @property
    def hard_wall(self) -> Callable[[Any, AnyArray], AnyArray] | None:
        """The function that marks the sampled nodes in a hard skull; None if there is no hard skull."""
        return mark_behind_skull if isinstance(self.data.terms.get("skull"), Skull) else None

    @property
    def normaliser(self) -> Normaliser | None:
        """The normaliser of the elastic prior; None if it is not part of the density."""
        if not self.posterior.options.elastic_prior.normalised or "elastic" not in self.data.terms:
            return None
        return Normaliser(is_costly=len(self.posterior.mesh.points) > CHEAP_NODES)

    @property
    def surrogate(self) -> Callable[[Problem], Problem] | None:
        """The map to the data of a similar problem: images in single precision, without the costly normaliser.

        It is None without a costly normaliser.
        """
        normaliser = self.normaliser
        return partial(simplify, normaliser=normaliser) if normaliser is not None and normaliser.is_costly else None

    @cached_property
    def prepare_marginal(self) -> Marginalisation | None:
        """The function that prepares the posterior with the displacements integrated out, where this is possible."""
        return Marginalisation.of(self.data, self.posterior.mesh, self.posterior.search_start)

    @property
    def mode_search(self) -> ModeSearch:
        """The posterior as the search for a mode uses it."""
        posterior = self.posterior
        return ModeSearch(
            self.data, posterior.observations, posterior.search_start, None if posterior.tempered else self._temper
        )

    def _temper(self, estimands: Values) -> PosteriorTarget:
        """Return the target tempered by the residuals at these estimands, from which a search may continue."""
        complete_values = coordinates.complete(self.data.blocks, estimands)
        counts = self.posterior.count_independent_points(complete_values)
        return PosteriorTarget(self.posterior.tempered_by(counts, complete_values))
