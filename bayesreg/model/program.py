"""The generative model of section 3.1 as a NumPyro program: blocks of unknowns, and one factor for each term."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpyro
from jaxtyping import Bool, Float

from bayesreg.model import coordinates
from bayesreg.model.blocks import Blocks, Values
from bayesreg.model.state import Body, state_of
from bayesreg.model.term import Likelihood, Support, Terms
from bayesreg.types import AnyArray


class Problem(NamedTuple):
    """All arrays of one registration problem (a pytree, an argument of every jitted function).

    Attributes
    ----------
    body : Body
        The body, which converts values of the blocks into a state.
    blocks : dict
        The blocks of unknowns by name.
    terms : dict
        The factors of the density by name.
    """

    body: Body
    blocks: Blocks
    terms: Terms

    def with_term(self, name: str, term: object) -> Problem:
        """Return the problem with one term added or replaced."""
        return self._replace(terms={**self.terms, name: term})

    def without_term(self, name: str) -> Problem:
        """Return the problem without one term, if it has this term."""
        return self._replace(terms={term_name: term for term_name, term in self.terms.items() if term_name != name})


def registration(problem: Problem, guess: Float[AnyArray, "nodes 3"] | None = None) -> None:
    """Run the program p(m, u, λ, μ) of eq. (8); its log joint density is the posterior's up to a constant.

    The displacements have a flat base measure. Every term is a factor on it: an observed site if the term is a
    likelihood. A failed elastic solve has density zero. A `guess` of the displacement of all nodes makes the solve
    faster (see `bayesreg.fem.equilibrium.equilibrium`).
    """
    values = {name: block.draw(name) for name, block in problem.blocks.items()}
    state = state_of(problem.body, problem.blocks, values, guess)
    for name, term in problem.terms.items():
        if isinstance(term, Likelihood):
            numpyro.sample(name, term.likelihood(state), obs=term.observed())
        else:
            numpyro.factor(name, term.log(state))
    inside = is_allowed(problem, values)
    numpyro.factor("support", jnp.where(inside, 0.0, -jnp.inf))
    numpyro.factor("solved", jnp.where(state.equilibrium.converged, 0.0, -jnp.inf))

    numpyro.deterministic("u", state.u)
    numpyro.deterministic("strain_energy", state.strain_energy)
    numpyro.deterministic("solver_iterations", state.equilibrium.iterations)
    numpyro.deterministic("solver_failed", ~state.equilibrium.converged)
    numpyro.deterministic("outside_support", ~inside)


def is_allowed(problem: Problem, values: Values) -> Bool[AnyArray, ""]:
    """Check, without a solve, whether the density may be positive: parameters physical and in range, each `Support`."""
    allowed = problem.body.is_physical(values) & coordinates.is_in_range(problem.blocks, values)
    for term in problem.terms.values():
        if isinstance(term, Support):
            allowed &= term.allows(values)
    return allowed
