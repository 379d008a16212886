"""A problem prepared for chains: with fast elastic solves near some estimands, and with a cheaper density."""

from __future__ import annotations

from functools import lru_cache

import jax.numpy as jnp
import numpy as np

from bayesreg.fem.conjugate_gradients import ElasticSystem
from bayesreg.fem.equilibrium import elastic_system
from bayesreg.fem.multigrid import Multigrid
from bayesreg.model.blocks import LAME, Values
from bayesreg.model.coordinates import complete
from bayesreg.model.normaliser import Normaliser
from bayesreg.model.observations.images.likelihood import ComparedImages
from bayesreg.model.program import Problem
from bayesreg.model.state import StaticMesh

# Tolerance of the solves in chains. It causes an error of some thousandths in the log density, too small to affect
# acceptance.
CHAIN_TOLERANCE = 1e-6

# Tolerance of the solves for gradients. A small error of the gradient that is always the same in one state leaves
# the sampled density unchanged, because the gradient only proposes.
CHAIN_ADJOINT_TOLERANCE = 1e-3

# The solves are preconditioned at λ and μ within this factor of the posterior's own reference.
NEAR = 1e3


def condition(problem: Problem, estimands: Values) -> Problem:
    """Return the problem with fast solves for chains, preconditioned at these λ, μ and field.

    The preconditioner is a dense inverse; a multigrid hierarchy remains that of the problem's own reference. Solves
    stop at the tolerance `CHAIN_TOLERANCE`.
    """
    body, values = problem.body, complete(problem.blocks, estimands)
    # K_II has no factor if a tissue has almost no stiffness.
    reference = {name: np.asarray(problem.blocks[name].reference()) for name in LAME}
    near = {name: np.clip(values[name], x / NEAR, x * NEAR) for name, x in reference.items()}
    lam, mu = (np.asarray(by_cell) for by_cell in body.lame_by_cell({**values, **near}))
    return problem._replace(body=body._replace(system=_conditioned_system(body.mesh, body.system, lam, mu)))


def _conditioned_system(mesh: StaticMesh, system: ElasticSystem, lam: np.ndarray, mu: np.ndarray) -> ElasticSystem:
    if isinstance(system.preconditioner, Multigrid):
        # Another reference would have aggregates with other shapes, which would require a new compilation of
        # everything.
        return system._replace(
            tolerance=jnp.asarray(CHAIN_TOLERANCE), adjoint_tolerance=jnp.asarray(CHAIN_ADJOINT_TOLERANCE)
        )
    return _kept_system(mesh, tuple(np.asarray(system.prescribed).tolist()), tuple(lam.tolist()), tuple(mu.tolist()))


@lru_cache(maxsize=2)
def _kept_system(
    mesh: StaticMesh, prescribed: tuple[int, ...], lam: tuple[float, ...], mu: tuple[float, ...]
) -> ElasticSystem:
    tolerances = CHAIN_TOLERANCE, CHAIN_ADJOINT_TOLERANCE
    return elastic_system(mesh.mesh, np.array(prescribed, int), np.array(lam), np.array(mu), *tolerances)


def simplify(problem: Problem, normaliser: Normaliser) -> Problem:
    """Return a problem with nearly the same density, at less cost: images in single precision, without normaliser."""
    for name, term in problem.terms.items():
        if isinstance(term, ComparedImages):
            problem = problem.with_term(name, term.in_single_precision())
    return normaliser.without(problem)
