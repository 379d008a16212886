"""Samplers with long trajectories that follow the gradient."""

from __future__ import annotations

from typing import Any

import blackjax
import jax
import jax.numpy as jnp

from bayesreg.inference.gaussian.about_gaussian import about_gaussian
from bayesreg.inference.gaussian.rotation import corrected_rotation, rotation
from bayesreg.inference.gaussian.warm_up import Tuning
from bayesreg.inference.gaussian.whitened import Moved, Setup, whitened_density
from bayesreg.inference.kernel import Sampler
from bayesreg.inference.samplers.settings import Hmc, Nuts
from bayesreg.inference.target import Target
from bayesreg.types import AnyArray

# The step size of every trajectory is multiplied by a random factor in this range, because trajectories of one fixed
# length may be periodic.
JITTER = (0.8, 1.2)


def hmc(target: Target, settings: Hmc) -> Sampler:
    """Make a Hamiltonian Monte Carlo sampler.

    Each trajectory is a quarter turn about the Gaussian, in as many steps as the acceptance requires.
    """
    tuning = Tuning(settings.warm_up, settings.target_acceptance, quarter_turns=True)
    return about_gaussian(target, _quarter_turn, tuning, mode_search=settings.mode_search)


def _quarter_turn(target: Target, data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Moved]:
    key_step, key_move = jax.random.split(key)
    kernel = blackjax.mcmc.hmc.build_kernel(corrected_rotation(setup.steps))
    density = whitened_density(target, data, setup)
    size = setup.step_size * jax.random.uniform(key_step, minval=JITTER[0], maxval=JITTER[1])
    # One step of the integrator is a whole trajectory.
    state, info = kernel(key_move, state, density, size, jnp.ones_like(state.position), 1)
    return state, Moved(info.acceptance_rate, info.is_divergent, setup.steps)


def nuts(target: Target, settings: Nuts) -> Sampler:
    """Make a No-U-Turn sampler about the Gaussian."""
    tuning = Tuning(settings.warm_up, settings.target_acceptance)
    return about_gaussian(target, _no_u_turn, tuning, mode_search=settings.mode_search)


def _no_u_turn(target: Target, data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Moved]:
    kernel = blackjax.mcmc.nuts.build_kernel(rotation())
    density = whitened_density(target, data, setup)
    unit = jnp.ones_like(state.position)
    state, info = kernel(key, state, density, setup.step_size, unit, max_num_doublings=6)
    return state, Moved(info.acceptance_rate, info.is_divergent, info.num_integration_steps)
