"""Independent draws from a Gaussian that stands in for the posterior: a quick look, approximate."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from blackjax.optimizers.lbfgs import lbfgs_inverse_hessian_formula_1
from blackjax.vi.pathfinder import approximate

from bayesreg.inference.gaussian.about_gaussian import about_gaussian
from bayesreg.inference.gaussian.laplace import Gaussian
from bayesreg.inference.gaussian.mode_search import penalty
from bayesreg.inference.gaussian.reflection import rotate
from bayesreg.inference.gaussian.whitened import Moved, Setup, clearance_of, setup_about, whiten
from bayesreg.inference.kernel import Sampler, Say
from bayesreg.inference.layout import flat_position, unravel
from bayesreg.inference.samplers.settings import Laplace, Pathfinder
from bayesreg.inference.target import Target, logdensity, without_walls
from bayesreg.types import AnyArray, InputError

# Pathfinder: L-BFGS iterations, and draws by which the approximations along its path are judged.
ITERATIONS, JUDGES = 30, 8


def laplace(target: Target, settings: Laplace) -> Sampler:
    """Independent draws from Laplace's approximation, cut off by the skull: a quick look, not the posterior."""
    return about_gaussian(target, _turn, begin=_begin, mode_search=settings.mode_search, exact=False)


class _Place(NamedTuple):
    """Where a chain stands in the whitened coordinates."""

    position: AnyArray


def _begin(position: AnyArray, _density: Callable[[AnyArray], AnyArray]) -> _Place:
    return _Place(position)


def _turn(target: Target, data: Any, setup: Setup, key: AnyArray, state: _Place) -> tuple[_Place, Moved]:
    momentum = jax.random.normal(key, state.position.shape)
    position, _ = rotate(setup.walls, clearance_of(target, data, setup), state.position, momentum, jnp.pi / 2)
    # A turn that was not over in time is refused, as everywhere.
    done = jnp.isfinite(position).all()
    return _Place(jnp.where(done, position, state.position)), Moved(done.astype(float), diverging=~done)


def pathfinder(target: Target, settings: Pathfinder) -> Sampler:
    """Draw from Pathfinder's Gaussian (Zhang et al. 2022): that of the greatest evidence bound on a path.

    The path is that of L-BFGS in the coordinates that Laplace's approximation whitens, from an overdispersed start; the
    skull is soft there, and cuts off the draws.
    """
    about_mode = laplace(target, Laplace(mode_search=settings.mode_search))

    def prepare(points: Any, key: AnyArray, say: Say) -> tuple[Setup, Any]:
        setup, starts = about_mode.prepare(points, key, say)
        flat = flat_position(target, target.data, jax.tree.map(lambda x: x[0], starts))
        path = _path(
            target, about_mode.data(setup), setup.gaussian, whiten(setup.gaussian, flat), jax.random.fold_in(key, 0)
        )
        elbo, mean, covariance = (np.asarray(found) for found in path)
        if not np.isfinite(elbo):
            raise InputError("pathfinder found no Gaussian with a finite evidence bound; use the sampler laplace")
        say(f"pathfinder: evidence bound {elbo:.1f}, mean {np.sqrt((mean**2).mean()):.2f} sd from the mode")
        gaussian = _push_forward(setup.gaussian, mean, covariance)
        return setup_about(target, gaussian, gaussian.centre), starts

    return about_mode._replace(prepare=prepare)


@partial(jax.jit, static_argnums=0)
def _path(target: Target, data: Any, gaussian: Gaussian, start: AnyArray, key: AnyArray) -> Any:
    """Evidence bound, mean and covariance in whitened coordinates."""

    def density(xi: AnyArray) -> AnyArray:
        position = unravel(target)(gaussian.place(xi))
        height = logdensity(target, without_walls(target, data), position)
        return height - penalty(target, data, position["u_boundary"])

    best, _ = approximate(key, density, start, JUDGES, maxiter=ITERATIONS)
    covariance = lbfgs_inverse_hessian_formula_1(best.alpha, best.beta, best.gamma)
    # The gradient is that of minus the log density.
    return best.elbo, best.position - covariance @ best.grad_position, covariance


def _push_forward(gaussian: Gaussian, mean: np.ndarray, covariance: np.ndarray) -> Gaussian:
    """The Gaussian of the whitened coordinates as one of flat positions."""
    factor = np.asarray(gaussian.factor)
    spread = factor @ covariance @ factor.T
    # Cholesky's factor from the last row up is the upper triangular one.
    upper = np.linalg.cholesky(spread[::-1, ::-1])[::-1, ::-1]
    return Gaussian(gaussian.centre + gaussian.factor @ mean, jnp.asarray(upper))
