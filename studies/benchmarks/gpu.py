"""Measure chains side by side on the device of JAX: densities, gradients and effective draws per second.

    python -m studies.benchmarks.gpu RUN [--chains 1 4 16 …] [--sample 4 64 …] [--minutes 3]

RUN is the folder of a run, or of a pair that `bayesreg simulate configs/converged_tissues.yaml` made. The first table
is for one batch of chains about the truth, with the tolerance and preconditioner of chains; times are medians of five.
The second table is for whole runs of `hmc` with the strict stop rule; it includes the search for the mode and
compilation.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import bayesreg as br
from bayesreg.inference.chains.beginning import first_checkpoint
from bayesreg.inference.chains.run import sample
from bayesreg.inference.chains.stopping import StopRule
from bayesreg.inference.draws.diagnostics import convergence
from bayesreg.inference.target import logdensity
from bayesreg.io import store
from bayesreg.io.run_folder import RunFolder
from bayesreg.messages import show_messages
from bayesreg.workflow.assembly import posterior_of
from bayesreg.workflow.preparation import PROVENANCE

REPEATS = 5
CHAINS = (1, 4, 16, 64, 256, 1024, 4096)
# Standard deviations of the chains about the truth: of displacements in mm, and of the scores of λ and μ.
SPREAD = {"u_boundary": 0.1, "lam": 0.3, "mu": 0.3}


def main() -> None:
    """Read the command line, and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--chains", type=int, nargs="*", default=CHAINS)
    parser.add_argument("--sample", type=int, nargs="*", default=(4, 64))
    parser.add_argument("--minutes", type=float, default=3.0, help="budget of each run that samples")
    arguments = parser.parse_args()
    device, inputs = jax.devices()[0], store.read_inputs(RunFolder(arguments.run))
    # A run has stored its number of independent points; a simulated pair has not.
    independent_points = store.read_json(arguments.run / PROVENANCE).get("independent_points")
    posterior = posterior_of(br.load_config(arguments.run / "config.yaml"), inputs, (), independent_points)
    print(f"{device.device_kind} ({device.platform}), JAX {jax.__version__}", flush=True)
    print(f"{len(posterior.mesh.points)} nodes, {len(posterior.mesh.cells)} elements, {len(posterior.sampled)} sampled")
    if arguments.chains:
        throughput(posterior, inputs.truth, arguments.chains)
    if arguments.sample:
        effective_draws(posterior, arguments.sample, arguments.minutes)


def throughput(posterior: br.Posterior, truth: Any, sizes: list[int]) -> None:
    """Print the densities and gradients per second for each number of chains."""
    values = posterior.reference()
    if truth is not None:
        values = values | {"u_boundary": jnp.asarray(truth.u[posterior.sampled])}
    data = posterior.target.condition(posterior.estimands(values))
    middle = posterior.unconstrain(values)
    density = jax.jit(jax.vmap(partial(logdensity, posterior.target), (None, 0)))
    gradient = jax.jit(jax.vmap(jax.value_and_grad(partial(logdensity, posterior.target), argnums=1), (None, 0)))
    print("\n| chains | ms per density | densities per second | ms per gradient | gradients per second | peak memory |")
    print("|---|---|---|---|---|---|")
    for chains in sizes:
        positions = _spread(middle, chains)
        try:
            times = [_seconds(density, data, positions), _seconds(gradient, data, positions)]
        except jax.errors.JaxRuntimeError as error:
            print(f"| {chains} | {str(error).splitlines()[0][:90]} |", flush=True)
            return
        cells = " | ".join(f"{seconds * 1e3:.3g} | {chains / seconds:,.0f}" for seconds in times)
        print(f"| {chains} | {cells} | {_peak_memory()} |", flush=True)


def _spread(middle: dict[str, Any], chains: int) -> dict[str, Any]:
    """Draw positions (chain, …) about one position."""
    rng = np.random.default_rng(chains)
    return {n: x + SPREAD.get(n, 0.0) * rng.standard_normal((chains, *np.shape(x))) for n, x in middle.items()}


def _seconds(function: Callable[..., Any], *arguments: Any) -> float:
    jax.block_until_ready(function(*arguments))
    times = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        output = jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - began)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(output))
    return float(np.median(times))


def _peak_memory() -> str:
    statistics = jax.devices()[0].memory_stats() or {}
    return f"{statistics['peak_bytes_in_use'] / 2**30:.1f} GiB" if "peak_bytes_in_use" in statistics else "–"


def effective_draws(posterior: br.Posterior, sizes: list[int], minutes: float) -> None:
    """Print the least effective sample size per second of runs with the strict stop rule, and their progress."""
    print(
        "\n| chains | search for the mode and warm-up | in all | draws per chain | greatest R̂ | least ESS bulk / tail "
        "| per second |"
    )
    print("|---|---|---|---|---|---|---|")
    for chains in sizes:
        began = time.perf_counter()

        def report_progress(text: Any, began: float = began) -> None:
            print(f"  {time.perf_counter() - began:.1f} s  {text}", file=sys.stderr, flush=True)

        with show_messages():
            first = first_checkpoint(posterior.target, "hmc", chains, seed=0)
        prepared = time.perf_counter() - began
        stop, block = StopRule(rhat=1.01, ess=400, max_seconds=60 * minutes), 100 if chains < 32 else 25
        samples = sample(
            posterior, "hmc", chains, 10_000, block=block, stop=stop, progress=False, resume=(first, []),
            on_block=lambda index, *_, report_progress=report_progress: report_progress(f"block {index + 1}"),
        )  # fmt: skip
        seconds = time.perf_counter() - began
        judged = convergence(samples.idata)
        rhat = max(float(x.max()) for x in judged.rhat.values())
        bulk, tail = (min(float(x.min()) for x in ess.values()) for ess in (judged.ess_bulk, judged.ess_tail))
        draws = samples.idata.posterior.sizes["draw"]
        print(
            f"| {chains} | {prepared:.0f} s | {seconds:.0f} s | {draws} | {rhat:.3f} | {bulk:.0f} / {tail:.0f} | "
            f"{bulk / seconds:.2g} / {tail / seconds:.2g} |\n  {samples.reason}",
            flush=True,
        )


if __name__ == "__main__":
    main()
