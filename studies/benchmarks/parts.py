"""Where does the time of a draw and of a gradient go, at the end of a finished run of `hmc`?

    python -m studies.benchmarks.parts RUN [--chains 16]

RUN is a run's folder. A draw is timed with the chains of the run in their last state; density and gradient are timed
with --chains chains, which are slightly moved copies of these. Times are medians of nine. Each operation is compiled
separately, so that the sum may exceed the time of the whole. The second column is the time of compilation, with the
flags in XLA_FLAGS.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import blackjax
import jax
import jax.numpy as jnp

import bayesreg as br
from bayesreg.fem.elasticity import total_strain_energy
from bayesreg.fem.equilibrium import equilibrium
from bayesreg.inference.chains.beginning import checkpoint_from_arrays
from bayesreg.inference.gaussian.whitened import whitened_density, whitened_position
from bayesreg.inference.samplers.hamiltonian import _quarter_turn
from bayesreg.inference.samplers.registry import choose_sampler
from bayesreg.inference.target import estimands_of
from bayesreg.io import checkpoints, store
from bayesreg.io.run_folder import RunFolder
from bayesreg.model.coordinates import complete
from bayesreg.model.observations.images.pointwise import SumOfSquaredDifferences
from bayesreg.workflow.assembly import posterior_of
from studies.benchmarks.bench_sampling import _median

APART = 0.01  # In whitened coordinates.


def main() -> None:
    """Print a line for each operation of a draw and of a gradient."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--chains", type=int, default=16)
    arguments = parser.parse_args()
    config = br.load_config(arguments.run / "config.yaml")
    posterior, options = posterior_of(config, store.read_inputs(RunFolder(arguments.run))), config.sampler
    arrays = checkpoints.load_state(RunFolder(arguments.run))
    if (
        options.name != "hmc"
        or not isinstance(posterior.images.similarity, SumOfSquaredDifferences)
        or posterior.data.body.field is not None
        or not arrays
    ):
        parser.error("RUN must be a run of hmc that has begun, with Gaussian noise and without a field of stiffness")
    arrays.pop("blocks")
    end = checkpoint_from_arrays(arrays, posterior.target, options.name, options.chains, **options.settings)
    sampler = choose_sampler(options.name, posterior.target, **options.settings).sampler
    data, setup = sampler.data(end.setup), end.setup
    print(f"{len(posterior.mesh.points)} nodes, {len(posterior.sampled)} sampled, {int(setup.steps)} gradients a draw")
    print(f"\nA draw, {options.chains} chains")
    of_a_draw(posterior, sampler, data, setup, end.state)
    print(f"\nA gradient, {arguments.chains} chains")
    of_a_gradient(posterior, data, setup, end.state.position, arguments.chains)


def timed(name: str, of_chain: Callable[..., Any], shared: tuple[Any, ...], *chains: Any) -> None:
    """Print the time of a function for all chains, and of its compilation.

    `of_chain` takes the arguments in `shared`, then an entry of each array in `chains`.
    """
    axes = (*[None] * len(shared), *[0] * len(chains))
    lowered = jax.jit(jax.vmap(of_chain, in_axes=axes)).lower(*shared, *chains)
    began = time.perf_counter()
    program = lowered.compile()
    compiling = time.perf_counter() - began
    print(f"{name:40s} {1e3 * _median(program, *shared, *chains):7.1f} ms {compiling:6.1f} s", flush=True)


def of_a_draw(posterior: Any, sampler: Any, data: Any, setup: Any, state: Any) -> None:
    """Time a draw, then its operations."""
    keys = jax.random.split(jax.random.key(0), len(state.position))

    def begin(data: Any, setup: Any, xi: jax.Array) -> Any:
        return blackjax.mcmc.hmc.init(xi, whitened_density(posterior.target, data, setup))

    def trajectory(data: Any, setup: Any, key: jax.Array, state: Any) -> Any:
        return _quarter_turn(posterior.target, data, setup, key, state)[0]

    shared = data, setup
    timed("all but its energies", lambda *arguments: sampler.step(*arguments)[0], shared, keys, state)
    timed("  trajectory", trajectory, shared, keys, state)
    timed("    a gradient of it", begin, shared, state.position)
    timed("its energies", sampler.observe, shared, state)


def of_a_gradient(posterior: Any, data: Any, setup: Any, positions: jax.Array, chains: int) -> None:
    """Time density and gradient, then their operations, each without and with its derivative."""
    places = jnp.resize(positions, (chains, positions.shape[1]))
    places += APART * jax.random.normal(jax.random.key(2), places.shape)

    def density(data: Any, setup: Any, xi: jax.Array) -> jax.Array:
        return whitened_density(posterior.target, data, setup)(xi)

    def values_of(xi: jax.Array) -> Any:
        estimands = estimands_of(posterior.target, data, whitened_position(posterior.target, setup.gaussian, xi))
        values = complete(data.blocks, estimands)
        return *data.body.lame_by_cell(values), data.body.prescribed(values["u_boundary"])

    lam, mu, prescribed = jax.jit(jax.vmap(values_of))(places)
    u = jax.jit(jax.vmap(lambda *x: equilibrium(data.body.system, *x).u))(lam, mu, prescribed)
    cotangent = jax.random.normal(jax.random.key(3), u.shape)

    def solve(data: Any, lam: jax.Array, mu: jax.Array, prescribed: jax.Array) -> jax.Array:
        return equilibrium(data.body.system, lam, mu, prescribed).u

    def adjoint(data: Any, lam: jax.Array, mu: jax.Array, prescribed: jax.Array, cotangent: jax.Array) -> Any:
        return jax.vjp(partial(solve, data), lam, mu, prescribed)[1](cotangent)

    def images(data: Any, u: jax.Array) -> jax.Array:
        return data.terms["images"].quadrature.weights @ data.terms["images"].residuals(u) ** 2

    def strain(data: Any, lam: jax.Array, mu: jax.Array, u: jax.Array) -> jax.Array:
        return total_strain_energy(data.body.system.elements, lam, mu, u)

    timed("density", density, (data, setup), places)
    timed("density and gradient", jax.value_and_grad(density, argnums=2), (data, setup), places)
    timed("  solve", solve, (data,), lam, mu, prescribed)
    timed("  solve and adjoint", adjoint, (data,), lam, mu, prescribed, cotangent)
    timed("  images", images, (data,), u)
    timed("  images and slope", jax.value_and_grad(images, argnums=1), (data,), u)
    timed("  strain energy", strain, (data,), lam, mu, u)
    timed("  strain energy and slopes", jax.value_and_grad(strain, argnums=(1, 2, 3)), (data,), lam, mu, u)


if __name__ == "__main__":
    main()
