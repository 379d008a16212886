"""A problem prepared for chains near some estimands, where its solves are fast."""

from __future__ import annotations

from functools import lru_cache

import jax.numpy as jnp
import numpy as np

from bayesreg.fem.conjugate_gradients import ElasticSystem
from bayesreg.fem.equilibrium import elastic_system
from bayesreg.fem.multigrid import Multigrid
from bayesreg.model.blocks import LAME, Values
from bayesreg.model.coordinates import complete
from bayesreg.model.program import Problem
from bayesreg.model.state import StaticMesh

# Tolerance of the solves of chains: it leaves an error of some thousandths in the log density, which no acceptance
# can tell.
CHAIN_TOLERANCE = 1e-6

# Tolerance of the solves behind their slopes. A slope that is a little off, and the same at the same place, leaves the
# sampled density as it is: it only proposes.
CHAIN_ADJOINT_TOLERANCE = 1e-3

# Solves are preconditioned at λ and μ within this factor of the posterior's own reference.
NEAR = 1e3


def condition(problem: Problem, estimands: Values) -> Problem:
    """The problem with solves for chains, preconditioned at these λ, μ and field.

    (By a dense inverse, that is; a multigrid hierarchy stays that of the problem's own reference.) Solves end at
    `CHAIN_TOLERANCE`.
    """
    body, values = problem.body, complete(problem.blocks, estimands)
    # A tissue that is next to nothing leaves K_II without a factor.
    reference = {name: np.asarray(problem.blocks[name].reference()) for name in LAME}
    near = {name: np.clip(values[name], x / NEAR, x * NEAR) for name, x in reference.items()}
    lam, mu = (np.asarray(by_cell) for by_cell in body.lame_by_cell({**values, **near}))
    return problem._replace(body=body._replace(system=_conditioned_system(body.mesh, body.system, lam, mu)))


def _conditioned_system(mesh: StaticMesh, system: ElasticSystem, lam: np.ndarray, mu: np.ndarray) -> ElasticSystem:
    if isinstance(system.preconditioner, Multigrid):
        # Another reference has aggregates of its own, of other shapes, and everything would be compiled again.
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
