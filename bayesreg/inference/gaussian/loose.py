"""Moves of single nodes that little holds: what trajectories about a Gaussian mix worst.

A node that few elements of little contrast hold has a wide and bent density of its own, now and then with a second mode
millimetres off, which no Gaussian follows; all others of a mesh often converge many times sooner. How the density
changes with one node is cheap to say approximately. A move draws some places for that node alone and takes one of
them, or stays, by their weights in the approximate density: a draw that all but forgets where the node was, and
reversible there (iterated sampling importance resampling, Andrieu, Lee and Vihola, Bernoulli 2018). Where the nodes end
is tested, for all of them at once, with the ratio of the true density to the approximate ones, which is exact (the
surrogate transition method, Liu 2001; delayed acceptance, Christen and Fox 2005).

Places are drawn from a kernel density: about where the warm-up saw the node, and about where such moves from far wider
places take it while all others stay.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayesreg.inference.gaussian.laplace import Gaussian
from bayesreg.inference.layout import unravel
from bayesreg.inference.target import Estimands, Target, estimands_of
from bayesreg.types import AnyArray

# Nodes that are moved alone. With each more the true density refuses more often what the approximate ones propose.
LOOSE = 4
# Places drawn for each, and kernels of their density. While that is being found: places drawn, and how often.
PLACES, KERNELS = 24, 256
WIDE_PLACES, SEARCHES = 64, 40
# Degrees of freedom of Student's t, and its scale in standard deviations of the node: of the kernels, and of the wide
# places.
NARROW, WIDE = (4, 0.7), (2, 2.0)


class Kernels(NamedTuple):
    """A density of places: a sum of Student's t densities that differ in their middles.

    Attributes
    ----------
    middles : (s, 3) array
    scale : (3, 3) array
        Lower triangular.
    degrees : int
        Degrees of freedom: not an array, for so many numbers are drawn.
    """

    middles: Float[AnyArray, "kernels 3"]
    scale: Float[AnyArray, "3 3"]
    degrees: int

    def sample(self, key: AnyArray, count: int) -> Float[AnyArray, "places 3"]:
        """So many places."""
        key_kernel, key_normal = jax.random.split(key)
        kernel = jax.random.randint(key_kernel, (count,), 0, len(self.middles))
        normal = jax.random.normal(key_normal, (count, 3 + self.degrees))
        # χ² as a sum of squares compiles in a fraction of the time that the gamma distribution's rejections take.
        width = jnp.sqrt(self.degrees / (normal[:, 3:] ** 2).sum(axis=1, keepdims=True))
        return self.middles[kernel] + width * normal[:, :3] @ self.scale.T

    def log_density(self, places: Float[AnyArray, "places 3"]) -> Float[AnyArray, "places"]:
        """Up to a constant."""
        whiten = jnp.linalg.inv(self.scale).T
        away = (places @ whiten)[:, None] - self.middles @ whiten
        square = (away**2).sum(axis=-1)
        return jax.scipy.special.logsumexp(-(self.degrees + 3) / 2 * jnp.log1p(square / self.degrees), axis=1)


class Loose(NamedTuple):
    """The nodes that are moved alone (a pytree).

    Attributes
    ----------
    nodes : (k,) int array
        Rows of "u_boundary".
    columns : (k, d, 3) array
        ∂ξ/∂u of each.
    seen : (k, kernels, 3) array
        Displacements about which places are drawn for each, mm.
    spread : (k, 3, 3) array
        Lower triangular: the factor of the covariance of each, mm.
    """

    nodes: Int[AnyArray, "k"]
    columns: Float[AnyArray, "k dimension 3"]
    seen: Float[AnyArray, "k kernels 3"]
    spread: Float[AnyArray, "k 3 3"]


def find_slowest(path: Float[AnyArray, "draw chain node 3"], count: int) -> Int[np.ndarray, "k"]:
    """The nodes that come the least far beside their spread: squared steps over the variance.

    Steps are those of two transitions: a quarter turn often leads to the other side of the mean, and the next one back.
    """
    steps = ((path[2:] - path[:-2]) ** 2).sum(axis=(0, 1, 3))
    variance = path.var(axis=(0, 1)).sum(axis=-1)
    mobility = np.divide(steps, variance, out=np.zeros_like(steps), where=variance > 0)
    return np.sort(np.argsort(mobility)[:count])


def place_loose_nodes(
    gaussian: Gaussian, first: int, nodes: Int[AnyArray, "k"], seen: Float[AnyArray, "k seen 3"]
) -> Loose:
    """How the nodes stand in the whitened coordinates, and where places are drawn for them.

    Parameters
    ----------
    gaussian : Gaussian
    first : int
        Where "u_boundary" begins in a flat position.
    nodes : (k,) int array
        Some of these rows.
    seen : (k, s, 3) array
        Where the nodes were seen, mm, of which `KERNELS` are taken. To their covariance there that of the Gaussian is
        added where the others stay.
    """
    dimension = len(gaussian.centre)
    rows = first + 3 * jnp.asarray(nodes, int)[:, None] + jnp.arange(3)
    unit = jnp.zeros((dimension, rows.size)).at[rows.ravel(), jnp.arange(rows.size)].set(1.0)
    columns = jax.scipy.linalg.solve_triangular(gaussian.factor, unit, lower=False)
    columns = jnp.moveaxis(columns.reshape(dimension, len(nodes), 3), 1, 0)
    own = jnp.linalg.inv(jnp.einsum("kdi,kdj->kij", columns, columns))
    seen = jnp.asarray(seen)[:, np.linspace(0, seen.shape[1] - 1, KERNELS).round().astype(int)]
    away = seen - seen.mean(axis=1, keepdims=True)
    covariance = jnp.einsum("ksi,ksj->kij", away, away) / KERNELS
    return Loose(jnp.asarray(nodes, int), columns, seen, jnp.linalg.cholesky(covariance + own))


def search_places(target: Target, data: Any, nodes: Loose, points: Any, key: AnyArray) -> Float[np.ndarray, "k seen 3"]:
    """Where the nodes come from the chains' estimands, each while all others stay, by moves from wide places."""
    keys = jax.random.split(key, len(next(iter(points.values()))))
    return np.concatenate(np.asarray(_search_places(target, data, nodes, points, keys)), axis=1)


@partial(jax.jit, static_argnums=0)
def _search_places(target: Target, data: Any, nodes: Loose, points: Any, keys: AnyArray) -> AnyArray:
    assert target.single_nodes is not None
    single_nodes = target.single_nodes

    def of_node(estimands: Estimands, key: AnyArray, which: AnyArray) -> AnyArray:
        middle = nodes.seen[which].mean(axis=0, keepdims=True)
        places = Kernels(middle, WIDE[1] * nodes.spread[which], WIDE[0])
        height = single_nodes.log_density(data, estimands, which)

        def one(here: AnyArray, key: AnyArray) -> tuple[AnyArray, AnyArray]:
            there = _resample(places, WIDE_PLACES, height, here, key)[0]
            return there, there

        here = estimands["u_boundary"][nodes.nodes[which]]
        return jax.lax.scan(one, here, jax.random.split(key, SEARCHES))[1]

    def of_chain(estimands: Estimands, key: AnyArray) -> AnyArray:
        count = len(nodes.nodes)
        return jax.vmap(partial(of_node, estimands))(jax.random.split(key, count), jnp.arange(count))

    return jax.vmap(of_chain)(points, keys)


def _resample(
    places: Kernels,
    count: int,
    height: Callable[[AnyArray], AnyArray],
    here: Float[AnyArray, "3"],
    key: AnyArray,
) -> tuple[AnyArray, AnyArray]:
    """A place by its weight among so many and the one here, and by how much it is higher."""
    key_places, key_choice = jax.random.split(key)
    drawn = jnp.concatenate([here[None], places.sample(key_places, count)])
    # One after the other: what they need together would leave the cache.
    heights = jax.lax.map(height, drawn)
    weights = jnp.nan_to_num(heights - places.log_density(drawn), nan=-jnp.inf)
    chosen = jax.random.categorical(key_choice, weights)
    return drawn[chosen], heights[chosen] - heights[0]


def move_alone(
    target: Target,
    begin: Callable[[AnyArray], Any],
    data: Any,
    gaussian: Gaussian,
    nodes: Loose,
    key: AnyArray,
    state: Any,
) -> Any:
    """The state after a move of the nodes, each in its own density, accepted or refused together.

    Parameters
    ----------
    target : Target
    begin : callable
        Whitened position → state, with fields `position` and `logdensity`.
    data : pytree
        The target's data, conditioned for moves of these nodes.
    gaussian : Gaussian
    nodes : Loose
    key : PRNG key
    state : state of the kernel
    """
    assert target.single_nodes is not None
    single_nodes = target.single_nodes
    key_move, key_test = jax.random.split(key)
    estimands = estimands_of(target, data, unravel(target)(gaussian.place(state.position)))

    def move(key: AnyArray, which: AnyArray) -> tuple[AnyArray, AnyArray]:
        """The way of one node, and what it gained in its own density."""
        here = estimands["u_boundary"][nodes.nodes[which]]
        places = Kernels(nodes.seen[which], NARROW[1] * nodes.spread[which], NARROW[0])
        there, gain = _resample(places, PLACES, single_nodes.log_density(data, estimands, which), here, key)
        return there - here, gain

    count = len(nodes.nodes)
    steps, gains = jax.vmap(move)(jax.random.split(key_move, count), jnp.arange(count))
    proposed = begin(state.position + jnp.einsum("kdi,ki->d", nodes.columns, steps))
    gain = proposed.logdensity - state.logdensity - gains.sum()
    probability = jnp.exp(jnp.minimum(jnp.nan_to_num(gain, nan=-jnp.inf), 0.0))
    accepted = jax.random.uniform(key_test) < probability
    return jax.tree.map(lambda new, old: jnp.where(accepted, new, old), proposed, state)
