"""Sequential Monte Carlo: particles move from a broad Gaussian to the posterior, and chains start at some of them."""

from __future__ import annotations

import logging
from functools import partial
from typing import Any

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
from blackjax.smc import adaptive_tempered, resampling

from bayesreg.inference.deadline import Deadline
from bayesreg.inference.gaussian.about_gaussian import surrogate_data
from bayesreg.inference.gaussian.rotation import rotation
from bayesreg.inference.gaussian.whitened import Setup, whitened_density, whitened_position
from bayesreg.inference.kernel import OnMode, Sampler
from bayesreg.inference.samplers.hamiltonian import hmc
from bayesreg.inference.samplers.settings import Hmc, Smc
from bayesreg.inference.target import Target, estimands_of
from bayesreg.types import AnyArray, InputError

_log = logging.getLogger(__name__)

# Trajectories of each particle at each temperature; the share of the particles that remain effective after a rise of
# the inverse temperature; the number of particles moved at once; the greatest number of temperatures.
_MOVES, _SHARE, _BATCH, _MOST = 2, 0.7, 32, 500


def smc(target: Target, settings: Smc) -> Sampler:
    """Make a sampler that starts chains of `hmc` at particles of adaptive tempered sequential Monte Carlo.

    The particles are drawn from Laplace's approximation π₀, widened. They are reweighted, resampled and moved by the
    kernel of `hmc` along π₀^(1−β) π^β, while β rises from 0 to 1. The modes that the broad Gaussian reaches then hold
    particles in proportion to their mass, up to Monte Carlo noise. Chains start at resampled particles and continue
    with `hmc`. The draws are exact because `hmc` leaves the posterior unchanged, not because of the tempering.
    """
    particles, spread, target_acceptance = settings.particles, settings.spread, settings.target_acceptance
    chains_of = hmc(target, Hmc(**settings.model_dump(include=set(Hmc.model_fields))))

    def prepare(points: Any, key: AnyArray, deadline: Deadline, on_mode: OnMode) -> tuple[Setup, Any]:
        chains = len(next(iter(points.values())))
        if particles < chains:
            raise InputError(f"particles must be at least as many as the {chains} chains, got {particles}")
        setup, _ = chains_of.prepare(points, key, deadline, on_mode)
        data = surrogate_data(target, setup)
        key_first, key_temper, key_choose = jax.random.split(jax.random.fold_in(key, 1), 3)
        first = spread * jax.random.normal(key_first, (particles, len(setup.middle)))
        tempered_particles, weights = _temper(
            target, data, setup, spread, first, target_acceptance, key_temper, deadline
        )
        chosen = resampling.systematic(key_choose, weights, chains)
        positions = jax.vmap(lambda xi: whitened_position(target, setup.gaussian, xi))(tempered_particles[chosen])
        return setup, jax.vmap(partial(estimands_of, target, target.data))(positions)

    return chains_of._replace(prepare=prepare)


def _temper(
    target: Target,
    data: Any,
    setup: Setup,
    spread: float,
    particles: AnyArray,
    acceptance: float,
    key: AnyArray,
    deadline: Deadline,
) -> tuple[AnyArray, AnyArray]:
    """Compute particles and weights at β = 1; the step size is adapted to the acceptance at each temperature.

    At the deadline, β is what it is then.
    """
    state, size = adaptive_tempered.init(particles), setup.step_size
    for number in range(_MOST):
        state, rate = _rise(target, data, setup, spread, state, size, jax.random.fold_in(key, number))
        power = float(state.tempering_param)
        if not np.isfinite(power):
            break
        if power < 1 and deadline.has_passed:
            _log.warning("tempering: the time is spent at a power of %.2g of the density", power)
            return state.particles, state.weights
        if power >= 1:
            effective = 1 / float((state.weights**2).sum())
            _log.info(
                "tempering: %d temperatures, acceptance %.0f%%, %.0f particles",
                number + 1,
                100 * float(rate),
                effective,
            )
            return state.particles, state.weights
        size = jnp.clip(size * jnp.exp(rate - acceptance), 0.01, jnp.pi / 2)
    raise InputError("the tempering came to a halt before the posterior; give smc more particles or less spread")


@partial(jax.jit, static_argnums=0)
def _rise(
    target: Target,
    data: Any,
    setup: Setup,
    spread: AnyArray | float,
    state: Any,
    size: AnyArray,
    key: AnyArray,
) -> tuple[Any, AnyArray]:
    """Resample, move and reweight the particles for the next β; return them and the acceptance of the moves."""
    density = whitened_density(target, data, setup)

    def broad(xi: AnyArray) -> AnyArray:
        return -0.5 * (xi @ xi) / spread**2

    # Trajectories rotate about the tempered Gaussian, which has this precision.
    precision = (1 - state.tempering_param) / spread**2 + state.tempering_param
    kernel = adaptive_tempered.build_kernel(
        broad,
        lambda xi: density(xi) - broad(xi),
        blackjax.mcmc.hmc.build_kernel(rotation(precision)),
        blackjax.mcmc.hmc.init,
        resampling.systematic,
        _SHARE,
        batch_size=_BATCH,
    )
    steps = jnp.maximum(jnp.ceil(jnp.pi / 2 / size), 1).astype(int)
    settings = {
        "step_size": jnp.pi / 2 / steps,
        "inverse_mass_matrix": jnp.ones_like(setup.gaussian.centre) / precision,
        "num_integration_steps": steps,
    }
    state, info = kernel(key, state, _MOVES, jax.tree.map(lambda x: x[None], settings))
    return state, info.update_info.acceptance_rate.mean()
