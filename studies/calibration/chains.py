"""What calibration and Geweke's test share: chains of many data sets side by side, and the quantities they look at.

All data sets share one mesh, one moving image and what is compiled: f at the quadrature points differs alone.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import bayesreg as br
from bayesreg.inference.gaussian.laplace import Gaussian, laplace
from bayesreg.inference.gaussian.normaliser import make_stand_in
from bayesreg.inference.gaussian.whitened import Setup, setup_about
from bayesreg.model.blocks import LAME
from studies.calibration.simulator import MESH, Simulator, draw_data, observing

# Every third node's displacement is looked at: neighbours say much the same.
NODES = np.arange(0, len(MESH.boundary), 3)

# So many data sets at a time: what they need together stays in the cache, four times as fast as all at once.
BATCH = 20

PARAMETERS = ("lam", "mu", "t_similarity", "t_elastic", "body_load", "surface_load")

Estimands = dict[str, Any]


def quantity_names(posterior: br.Posterior) -> tuple[str, ...]:
    """What is looked at: parameters, some displacements, E_s and the log density."""
    labels, blocks = posterior.target.variables.entry_names, posterior.data.blocks
    entries = [f"{name} {labels[i]}" for name in LAME for i in blocks[name].free.index]
    warm = [name for name in PARAMETERS if name not in LAME and name in blocks and blocks[name].is_sampled]
    nodes = [f"u{posterior.sampled[node]} {axis}" for node in NODES for axis in "xyz"]
    return (*entries, *warm, *nodes, "E_s", "log p")


def quantities(estimands: Estimands, evaluation: Any) -> Any:
    """Their values, in the order of `quantity_names`."""
    parameters = [jnp.atleast_1d(estimands[name]) for name in PARAMETERS if name in estimands]
    rest = [estimands["u_boundary"][NODES].ravel(), evaluation.similarity_energy[None], evaluation.logdensity[None]]
    return jnp.concatenate(parameters + rest)


def quantities_at(posterior: br.Posterior, data: Any, observed: Any, estimands: Estimands) -> Any:
    return quantities(estimands, posterior.target.evaluate_estimands(observing(data, observed), estimands))


def of_posterior(posterior: br.Posterior, estimands: Estimands) -> Estimands:
    """In the posterior's order, without temperatures that it takes for known."""
    return {name: estimands[name] for name in posterior.estimands(posterior.reference())}


@partial(jax.jit, static_argnums=0)
def simulated(posterior: br.Posterior, data: Any, truths: Estimands, key: Any) -> Any:
    keys = jax.random.split(key, len(truths["u_boundary"]))
    return jax.vmap(partial(draw_data, posterior, data))(keys, truths)


def prior_reference(simulator: Simulator, posterior: br.Posterior) -> Gaussian:
    """At rest, with data of its own: any gaussian is exact."""
    truth = simulator.draw_prior(np.random.default_rng(1000), 1)
    observed = simulated(simulator.posterior, simulator.posterior.data, truth, jax.random.key(1000))[0]
    at_rest = ravel_pytree(posterior.unconstrain(posterior.reference()))[0]
    return laplace(posterior.target, np.asarray(at_rest), observing(posterior.data, observed))


def setups_about(
    posterior: br.Posterior,
    references: list[Gaussian],
    middles: np.ndarray,
    step_size: float,
    steps: int,
) -> Setup:
    """The setups of all replications, stacked."""
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *references)
    size = {"step_size": jnp.asarray(step_size), "steps": jnp.asarray(steps)}
    found = [make_stand_in(posterior.target, *each) for each in zip(references, middles, strict=True)]
    normalisers = jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)

    def about(gaussian: Gaussian, middle: Any) -> Setup:
        return setup_about(posterior.target, gaussian, middle)._replace(**size)

    return jax.vmap(about)(stacked, jnp.asarray(middles))._replace(stand_in=normalisers)


def condition(posterior: br.Posterior) -> Any:
    """The data for chains: for all of them about rest."""
    return posterior.target.condition(posterior.estimands(posterior.reference()))
