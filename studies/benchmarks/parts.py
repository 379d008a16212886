"""Where does the time of a draw and of a gradient go, where a run of `hmc` stands?

    python -m studies.benchmarks.parts RUN

RUN is a run's folder, with any model. The parts are timed with the chains of the run in their last state. Times are
medians of nine. Each part is compiled separately, so that the sum may exceed the time of the whole. The second column
is the time of compilation, with the flags in XLA_FLAGS.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from bayesreg.config import load_stored_config
from bayesreg.inference.chains.beginning import checkpoint_from_arrays
from bayesreg.inference.gaussian.delayed_acceptance import ChainData, Delayed
from bayesreg.inference.gaussian.density import log_normaliser_at
from bayesreg.inference.gaussian.hyperparameters import move_hyperparameters
from bayesreg.inference.gaussian.whitened import Setup, whitened_density
from bayesreg.inference.layout import unravel
from bayesreg.inference.samplers.hamiltonian import _quarter_turn
from bayesreg.inference.samplers.registry import choose_sampler
from bayesreg.inference.target import Target, estimands_of
from bayesreg.io import checkpoints, store
from bayesreg.io.run_folder import RunFolder
from bayesreg.workflow.assembly import posterior_of
from bayesreg.workflow.preparation import PROVENANCE
from studies.benchmarks.bench_sampling import _median


def main() -> None:
    """Print a line for each part of a draw and of a gradient."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    folder = RunFolder(parser.parse_args().run)
    config, arrays = load_stored_config(folder.file("config.yaml")), checkpoints.load_state(folder)
    if config.sampler.name != "hmc":
        parser.error("RUN must be a run of hmc")
    counts = store.read_json(folder.file(PROVENANCE)).get("independent_points")
    posterior, options = posterior_of(config, store.read_inputs(folder), [], counts), config.sampler
    arrays.pop("blocks")
    end = checkpoint_from_arrays(arrays, posterior.target, options.name, options.chains, **options.settings)
    # Arrays of NumPy would be copied to the device for each call.
    setup, state = jax.tree.map(jnp.asarray, (end.setup, end.state))
    sampler = choose_sampler(options.name, posterior.target, **options.settings).sampler
    data = jax.tree.map(jnp.asarray, sampler.data(setup))
    steps = int(setup.steps)
    print(f"{len(posterior.mesh.points)} nodes, {options.chains} chains, {steps} gradients a trajectory")
    keys = jax.random.split(jax.random.key(0), options.chains)
    timed("a step", sampler.step, (data, setup), keys, state)
    exact, surrogate = data if isinstance(data, ChainData) else (data, data)
    time_parts(posterior.target, exact, surrogate, setup, keys, state.kernel if isinstance(state, Delayed) else state)


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


def time_parts(target: Target, exact: Any, surrogate: Any, setup: Setup, keys: jax.Array, kernel: Any) -> None:
    """Time the parts of a step, and the terms of a gradient."""

    def gradient(data: Any, setup: Setup, xi: jax.Array) -> Any:
        return jax.value_and_grad(whitened_density(target, data, setup))(xi)

    def evaluate(data: Any, setup: Setup, estimands: Any) -> Any:
        return target.evaluate_estimands(data, estimands)

    flat = jax.jit(jax.vmap(setup.gaussian.place))(kernel.position)
    estimands = jax.vmap(lambda flat: estimands_of(target, exact, unravel(target)(flat)))(flat)
    timed("  a trajectory", lambda *arguments: _quarter_turn(target, *arguments), (surrogate, setup), keys, kernel)
    timed("  hyperparameters", partial(move_hyperparameters, target), (surrogate, setup), keys, kernel)
    timed("  the density of the draw", evaluate, (exact, setup), estimands)
    timed("    its normaliser", lambda data, setup, flat: log_normaliser_at(target, data, flat), (exact, setup), flat)
    timed("a gradient", gradient, (surrogate, setup), kernel.position)
    timed("  without terms", gradient, (surrogate._replace(terms={}), setup), kernel.position)
    for name, term in surrogate.terms.items():
        timed(f"  with {name} alone", gradient, (surrogate._replace(terms={name: term}), setup), kernel.position)


if __name__ == "__main__":
    main()
