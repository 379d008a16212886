"""Samplers of one evaluation per transition: random walks and Langevin steps in the whitened coordinates."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import blackjax
import jax
import jax.numpy as jnp
from blackjax.mcmc import random_walk

from bayesreg.inference.gaussian.about_gaussian import about_gaussian
from bayesreg.inference.gaussian.reflection import reflective_leapfrog, rotate, shift
from bayesreg.inference.gaussian.warm_up import Tuning
from bayesreg.inference.gaussian.whitened import Density, Moved, Setup, Transition, clearance_of, whitened_density
from bayesreg.inference.kernel import Sampler
from bayesreg.inference.samplers.settings import Barker, Mala, Pcn, RwmhAdaptive
from bayesreg.inference.target import Target
from bayesreg.types import AnyArray

# Steps of a random walk shrink with the square root of the dimension, and with what refuses them.
LEAST = 1e-4


def mala(target: Target, settings: Mala) -> Sampler:
    """The Metropolis-adjusted Langevin algorithm: Hamiltonian Monte Carlo of a single leapfrog step (Neal 2011).

    Written so, it has a momentum that the skull can reflect.
    """
    tuning = Tuning(settings.warm_up, settings.target_acceptance, LEAST)
    return about_gaussian(target, _leapfrog, tuning, mode_search=settings.mode_search)


def _leapfrog(target: Target, data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Moved]:
    kernel = blackjax.mcmc.hmc.build_kernel(reflective_leapfrog(setup.walls, clearance_of(target, data, setup)))
    density = whitened_density(target, data, setup)
    state, info = kernel(key, state, density, setup.step_size, jnp.ones_like(state.position), 1)
    return state, Moved(info.acceptance_rate, info.is_divergent, gradients=1)


def barker(target: Target, settings: Barker) -> Sampler:
    """Barker's proposal, whose gradient decides on signs alone (Livingstone and Zanella 2022).

    It has no momentum: a proposal in the skull is refused.
    """
    tuning = Tuning(settings.warm_up, settings.target_acceptance, LEAST)
    return about_gaussian(target, _barker, tuning, blackjax.mcmc.barker.init, mode_search=settings.mode_search)


def _barker(target: Target, data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Moved]:
    density = whitened_density(target, data, setup)
    state, info = blackjax.mcmc.barker.build_kernel()(key, state, density, setup.step_size)
    # Outside the support the gradient, and with it the acceptance, may be NaN, which the kernel refuses.
    outside = ~jnp.isfinite(info.proposal.logdensity)
    return state, Moved(jnp.nan_to_num(info.acceptance_rate), outside_support=outside, gradients=1)


def rwmh_adaptive(target: Target, settings: RwmhAdaptive) -> Sampler:
    """Random-walk Metropolis with steps shaped like Laplace's covariance, their size tuned.

    A step is a straight flight with a Normal momentum, reflected by the skull: back with the momentum reversed it
    takes the same way, so that the proposal is symmetric.
    """
    tuning = Tuning(settings.warm_up, settings.target_acceptance, LEAST)
    transition = _symmetric(shift, whitened_density)
    return about_gaussian(target, transition, tuning, random_walk.init, whitened_density, settings.mode_search)


def pcn(target: Target, settings: Pcn) -> Sampler:
    """Preconditioned Crank–Nicolson on the Gaussian (Cotter et al. 2013).

    ξ′ = cos β ξ + sin β p with p Normal is a rotation, reflected by the skull. It leaves the Gaussian, cut off there,
    unchanged and is reversible, so that the test sees only the ratio of the posterior to the Gaussian.
    """
    tuning = Tuning(settings.warm_up, settings.target_acceptance, LEAST)
    transition = _symmetric(rotate, against_gaussian)
    return about_gaussian(target, transition, tuning, random_walk.init, against_gaussian, settings.mode_search)


@cache
def _symmetric(motion: Callable, density: Density) -> Transition:
    """A motion with a Normal momentum for the time of a step, accepted with the ratio of a density."""

    def transition(target: Target, data: Any, setup: Setup, key: AnyArray, state: Any) -> tuple[Any, Moved]:
        def proposal(key: AnyArray, position: AnyArray) -> AnyArray:
            momentum = jax.random.normal(key, position.shape)
            return motion(setup.walls, clearance_of(target, data, setup), position, momentum, setup.step_size)[0]

        state, info = random_walk.build_rmh()(key, state, density(target, data, setup), proposal)
        return state, Moved(info.acceptance_rate, densities=1)

    return transition


def against_gaussian(target: Target, data: Any, setup: Setup) -> Callable[[AnyArray], AnyArray]:
    """log π(ξ) − log N(ξ; 0, I), up to a constant."""
    density = whitened_density(target, data, setup)
    return lambda xi: density(xi) + 0.5 * (xi @ xi)
