"""Positions of the chains of a benchmark, with λ and μ about as far apart as in a posterior."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.model.posterior import Posterior

# Standard deviation of log λ and log μ: a factor of 1.35.
SPREAD = 0.3


def scattered(posterior: Posterior, chains: int) -> dict[str, jax.Array]:
    """Draw positions near the reference (`Posterior.initial`), with λ and μ scattered by `SPREAD`."""

    def place(key: jax.Array) -> dict[str, jax.Array]:
        key_near, *keys = jax.random.split(key, 3)
        values = posterior.constrain(posterior.initial(key_near))
        for name, key_of_parameter in zip(("lam", "mu"), keys, strict=True):
            values[name] = values[name] * jnp.exp(SPREAD * jax.random.normal(key_of_parameter, values[name].shape))
        return posterior.unconstrain(values)

    positions = jax.vmap(place)(jax.random.split(jax.random.key(0), chains))
    assert all(np.isfinite(values).all() for values in positions.values()), "a scattered λ or μ is outside its prior"
    return positions
