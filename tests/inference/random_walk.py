"""What a random walk's effective draws cost, in closed form, and a walk on a Gaussian to hold it against."""

from __future__ import annotations

from functools import partial

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np


def ess_per_step(covariance, variances, acceptance, effective=np.inf):
    """a C_ii / (4 [C D⁻¹ C]_ii) of every entry, the limit of small steps.

    A covariance of n effective draws has noise whose squares add up: the expectation of [C D⁻¹ C]_ii is greater by
    C_ii tr(D⁻¹ C) / n, which is taken off, down to the part C_ii² / D_ii of it that is the entry's own.
    """
    diagonal = np.diag(covariance)
    spread = np.einsum("ij,j,ji->i", covariance, 1 / variances, covariance)
    spread = np.maximum(spread - diagonal * (diagonal / variances).sum() / effective, diagonal**2 / variances)
    return acceptance * diagonal / (4 * spread)


def gaussian_walk(covariance, variances, *, chains, steps, thin=100, entries=10, seed=0):
    """Predicted and measured ESS per step of the entries that mix fastest, of a walk on N(0, covariance).

    Where the walk's steps are N(0, I) and the covariance is diagonal, a step costs next to nothing.
    """
    root = np.sqrt(variances)
    values, vectors = np.linalg.eigh(covariance / root[:, None] / root)
    values = np.maximum(values, 1e-12)
    fastest = np.argsort(ess_per_step(covariance, variances, 1.0))[::-1][:entries]
    rows = jnp.asarray(vectors[fastest])

    def step(state, key):
        z, accepted = state
        key_step, key_accept = jax.random.split(key)
        proposal = z + jax.random.normal(key_step, z.shape)
        gain = 0.5 * ((z**2 - proposal**2) / values).sum()
        accept = jnp.log(jax.random.uniform(key_accept)) < gain
        return (jnp.where(accept, proposal, z), accepted + accept), None

    def kept(state, key):
        state, _ = jax.lax.scan(step, state, jax.random.split(key, thin))
        return state, rows @ state[0]

    @partial(jax.jit, static_argnums=1)
    def walk(key, draws):
        key_start, key_walk = jax.random.split(key)
        start = jnp.sqrt(values) * jax.random.normal(key_start, values.shape)
        (_, accepted), thinned = jax.lax.scan(kept, (start, 0), jax.random.split(key_walk, draws))
        return thinned, accepted

    keys = jax.random.split(jax.random.key(seed), chains)
    coordinates, accepted = jax.vmap(partial(walk, draws=steps // thin))(keys)
    acceptance = float(np.mean(accepted)) / steps
    measured = np.array([float(az.ess(np.asarray(coordinates[..., i]))) for i in range(entries)]) / (chains * steps)
    return ess_per_step(covariance, variances, acceptance)[fastest], measured
