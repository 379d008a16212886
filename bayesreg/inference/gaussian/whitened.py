"""The coordinates in which Laplace's approximation is N(0, I), and the density in these coordinates."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bayesreg.inference.gaussian.laplace import Gaussian
from bayesreg.inference.gaussian.normaliser import StandIn, no_stand_in, smooth_coordinates
from bayesreg.inference.gaussian.warm_up import FIRST_STEP
from bayesreg.inference.layout import unravel
from bayesreg.inference.target import Target, logdensity
from bayesreg.types import AnyArray, Scalar


class Setup(NamedTuple):
    """The setup of a sampler about a Gaussian, which is computed once (a pytree).

    Attributes
    ----------
    gaussian : Gaussian
    middle : (d,) array
        The flat position at the middle of the chains: the mode, or the mean of the chains' positions. The elastic
        solves are preconditioned there.
    step_size : scalar
        The step size in whitened coordinates; π/2 is a quarter turn of the Gaussian's motion.
    steps : scalar integer
        The number of steps of a trajectory of fixed length, a quarter turn.
    stand_in : StandIn
        The stand-in for the normaliser of the density; zero without a costly normaliser.
    """

    gaussian: Gaussian
    middle: AnyArray
    step_size: Scalar
    steps: AnyArray
    stand_in: StandIn


class Moved(NamedTuple):
    """The report of a transition in whitened coordinates, see `Info`."""

    acceptance_rate: AnyArray
    diverging: AnyArray | bool = False
    gradients: AnyArray | int = 0


# (target, data, setup, key, state) → (state, Moved)
Transition = Callable[[Target, Any, Setup, AnyArray, Any], tuple[Any, Moved]]


@partial(jax.jit, static_argnums=0)
def setup_about(target: Target, gaussian: Gaussian, middle: AnyArray) -> Setup:
    """Make a setup before its tuning.

    The factor only defines the coordinates of the chains. Rounding it leaves the density of a position as it is.
    """
    gaussian = gaussian.in_single_precision()
    return Setup(gaussian, jnp.asarray(middle), jnp.asarray(FIRST_STEP), jnp.asarray(1, int), no_stand_in(target))


def whitened_position(target: Target, gaussian: Gaussian, xi: AnyArray) -> dict[str, AnyArray]:
    """Map whitened coordinates ξ to a position."""
    return unravel(target)(gaussian.place(xi))


def whitened_density(target: Target, data: Any, setup: Setup) -> Callable[[AnyArray], AnyArray]:
    """Make the log density of whitened coordinates ξ: `surrogate_density`, and the Jacobian of what follows."""

    def density(xi: AnyArray) -> AnyArray:
        height = surrogate_density(target, data, setup, setup.gaussian.place(xi))
        return height + setup.gaussian.log_jacobian(xi)

    return density


def surrogate_density(target: Target, data: Any, setup: Setup, flat: AnyArray) -> AnyArray:
    """Compute log π̃ at a flat position: the log density of the data, with the stand-in for a costly normaliser.

    Parameters
    ----------
    target : Target
    data : pytree
        The data of the target, if it has no surrogate; else those of the surrogate, or of a part of it.
    setup : Setup
    flat : (d,) array
    """
    height = logdensity(target, data, unravel(target)(flat))
    return height + setup.stand_in(smooth_coordinates(target, data, flat))
