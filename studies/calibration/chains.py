"""Chains of many data sets side by side and their test quantities, for calibration and for Geweke's test.

All data sets share one mesh, one moving image and the compiled programs. They differ only in f at the quadrature
points.
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

# The displacement of every third node is tested, because neighbours move alike.
NODES = np.arange(0, len(MESH.boundary), 3)

# The number of data sets at a time: their data fit into the cache, which is four times as fast as all at once.
BATCH = 20

PARAMETERS = ("lam", "mu", "t_similarity", "t_elastic", "body_load", "surface_load", "images_shading")

Estimands = dict[str, Any]


def quantity_names(posterior: br.Posterior) -> tuple[str, ...]:
    """The names of the test quantities: parameters, some displacements, E_s and the log density."""
    labels, blocks = posterior.target.variables.entry_names, posterior.data.blocks
    entries = [f"{name} {labels[i]}" for name in LAME for i in blocks[name].free.index]
    sizes = {name: np.size(posterior.reference()[name]) for name in PARAMETERS if name not in LAME and name in blocks}
    warm = [
        name if size == 1 else f"{name} {i}"
        for name, size in sizes.items()
        if blocks[name].is_sampled
        for i in range(size)
    ]
    nodes = [f"u{posterior.sampled[node]} {axis}" for node in NODES for axis in "xyz"]
    return (*entries, *warm, *nodes, "E_s", "log p")


def quantities(estimands: Estimands, evaluation: Any) -> Any:
    """The values of the test quantities, in the order of `quantity_names`."""
    parameters = [jnp.atleast_1d(estimands[name]) for name in PARAMETERS if name in estimands]
    rest = [estimands["u_boundary"][NODES].ravel(), evaluation.similarity_energy[None], evaluation.logdensity[None]]
    return jnp.concatenate(parameters + rest)


def quantities_at(posterior: br.Posterior, data: Any, observed: Any, estimands: Estimands) -> Any:
    return quantities(estimands, posterior.target.evaluate_estimands(observing(data, observed), estimands))


def of_posterior(posterior: br.Posterior, estimands: Estimands) -> Estimands:
    """The estimands in the order of the posterior, without the temperatures that it keeps fixed."""
    return {name: estimands[name] for name in posterior.estimands(posterior.reference())}


@partial(jax.jit, static_argnums=0)
def simulated(posterior: br.Posterior, data: Any, truths: Estimands, key: Any) -> Any:
    keys = jax.random.split(key, len(truths["u_boundary"]))
    return jax.vmap(partial(draw_data, posterior, data))(keys, truths)


def prior_reference(simulator: Simulator, posterior: br.Posterior) -> Gaussian:
    """A Gaussian about rest, for simulated data; the kernel is exact with any Gaussian."""
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
    """Stack the setups of all replications."""
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *references)
    size = {"step_size": jnp.asarray(step_size), "steps": jnp.asarray(steps)}
    stand_ins = [make_stand_in(posterior.target, *each) for each in zip(references, middles, strict=True)]
    normalisers = jax.tree.map(lambda *leaves: jnp.stack(leaves), *stand_ins)

    def about(gaussian: Gaussian, middle: Any) -> Setup:
        return setup_about(posterior.target, gaussian, middle)._replace(**size)

    return jax.vmap(about)(stacked, jnp.asarray(middles))._replace(stand_in=normalisers)


def condition(posterior: br.Posterior) -> Any:
    """The data of all chains, conditioned about rest."""
    return posterior.target.condition(posterior.estimands(posterior.reference()))
