"""Samplers with long trajectories that follow the gradient, reflected where a node meets the skull."""

from __future__ import annotations

from typing import Any

import blackjax
import jax
import jax.numpy as jnp

from bayesreg.inference.gaussian.about_gaussian import about_gaussian
from bayesreg.inference.gaussian.loose import LOOSE
from bayesreg.inference.gaussian.reflection import reflective_microcanonical, reflective_rotation
from bayesreg.inference.gaussian.warm_up import Tuning
from bayesreg.inference.gaussian.whitened import Moved, Setup, clearance_of, whitened_density
from bayesreg.inference.kernel import Sampler
from bayesreg.inference.samplers.settings import Hmc, Mclmc, Nuts
from bayesreg.inference.target import Target
from bayesreg.types import AnyArray


def hmc(target: Target, settings: Hmc) -> Sampler:
    """Hamiltonian Monte Carlo: a quarter turn about the Gaussian, in as many steps as acceptance asks for.

    All steps of a trajectory are longer or shorter by up to a fifth, at random.
    """
    tuning = Tuning(settings.warm_up, settings.target_acceptance, quarter_turns=True)
    return about_gaussian(target, _quarter_turn, tuning, mode_search=settings.mode_search, alone=LOOSE)


def _quarter_turn(target: Target, data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Moved]:
    key_step, key_move = jax.random.split(key)
    kernel = blackjax.mcmc.hmc.build_kernel(reflective_rotation(setup.walls, clearance_of(target, data, setup)))
    density = whitened_density(target, data, setup)
    size = setup.step_size * _jitter(key_step)
    state, info = kernel(key_move, state, density, size, jnp.ones_like(state.position), setup.steps)
    return state, Moved(info.acceptance_rate, info.is_divergent, gradients=info.num_integration_steps)


def nuts(target: Target, settings: Nuts) -> Sampler:
    """The No-U-Turn sampler about the Gaussian."""
    tuning = Tuning(settings.warm_up, settings.target_acceptance)
    return about_gaussian(target, _no_u_turn, tuning, mode_search=settings.mode_search)


def _no_u_turn(target: Target, data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Moved]:
    kernel = blackjax.mcmc.nuts.build_kernel(reflective_rotation(setup.walls, clearance_of(target, data, setup)))
    density = whitened_density(target, data, setup)
    unit = jnp.ones_like(state.position)
    state, info = kernel(key, state, density, setup.step_size, unit, max_num_doublings=6)
    return state, Moved(info.acceptance_rate, info.is_divergent, gradients=info.num_integration_steps)


def mclmc(target: Target, settings: Mclmc) -> Sampler:
    """Microcanonical trajectories with a Metropolis test (adjusted MCLMC).

    The speed is one whatever the density, so that a time of √d does what a time of one does in `hmc`.
    """
    tuning = Tuning(settings.warm_up, settings.target_acceptance, quarter_turns=True)
    return about_gaussian(target, _microcanonical, tuning, mode_search=settings.mode_search)


def _microcanonical(target: Target, data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Moved]:
    key_step, key_move = jax.random.split(key)
    kernel = blackjax.mcmc.adjusted_mclmc.build_kernel(
        reflective_microcanonical(setup.walls, clearance_of(target, data, setup))
    )
    density = whitened_density(target, data, setup)
    size = jnp.sqrt(len(state.position)) * setup.step_size * _jitter(key_step)
    state, info = kernel(key_move, state, density, size, (setup.steps,))
    # McLachlan's integrator has two stages.
    return state, Moved(info.acceptance_rate, info.is_divergent, gradients=2 * setup.steps)


def _jitter(key: AnyArray) -> AnyArray:
    """Trajectories of one length may be periodic."""
    return jax.random.uniform(key, minval=0.8, maxval=1.2)
