"""Chains side by side on whatever device JAX has: densities and gradients per second, and effective draws per second.

    python -m studies.benchmarks.gpu RUN [--chains 1 4 16 …] [--sample 4 64 …] [--minutes 3]

RUN is a run's folder, or a pair's that `bayesreg simulate configs/converged_tissues.yaml` made. The first table is of
one batch of chains spread about the truth, solves ended and preconditioned as those of chains are: medians of five.
The second is of whole runs of `hmc` by the strict stop rule, the search for the mode and compilation counted.
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
from bayesreg.inference.chains.run import first_checkpoint, sample
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
# Of the chains about the truth: standard deviations in mm and of the scores of λ, μ.
SPREAD = {"u_boundary": 0.1, "lam": 0.3, "mu": 0.3}


def main() -> None:
    """Both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--chains", type=int, nargs="*", default=CHAINS)
    parser.add_argument("--sample", type=int, nargs="*", default=(4, 64))
    parser.add_argument("--minutes", type=float, default=3.0, help="of each run that samples")
    given = parser.parse_args()
    device, inputs = jax.devices()[0], store.read_inputs(RunFolder(given.run))
    # A run knows how many points are independent; a simulated pair has yet to find out.
    known = store.read_json(given.run / PROVENANCE).get("independent_points")
    posterior = posterior_of(br.load_config(given.run / "config.yaml"), inputs, (), known)
    print(f"{device.device_kind} ({device.platform}), JAX {jax.__version__}", flush=True)
    print(f"{len(posterior.mesh.points)} nodes, {len(posterior.mesh.cells)} elements, {len(posterior.sampled)} sampled")
    if given.chains:
        throughput(posterior, inputs.truth, given.chains)
    if given.sample:
        effective_draws(posterior, given.sample, given.minutes)


def throughput(posterior: br.Posterior, truth: Any, sizes: list[int]) -> None:
    """Densities and gradients per second, and how they grow with the number of chains."""
    at = posterior.reference()
    if truth is not None:
        at = at | {"u_boundary": jnp.asarray(truth.u[posterior.sampled])}
    data = posterior.target.condition(posterior.estimands(at))
    middle = posterior.unconstrain(at)
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
    """Positions (chain, …) about one."""
    rng = np.random.default_rng(chains)
    return {n: x + SPREAD.get(n, 0.0) * rng.standard_normal((chains, *np.shape(x))) for n, x in middle.items()}


def _seconds(function: Callable[..., Any], *arguments: Any) -> float:
    jax.block_until_ready(function(*arguments))
    times = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        found = jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - began)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(found))
    return float(np.median(times))


def _peak_memory() -> str:
    known = jax.devices()[0].memory_stats() or {}
    return f"{known['peak_bytes_in_use'] / 2**30:.1f} GiB" if "peak_bytes_in_use" in known else "–"


def effective_draws(posterior: br.Posterior, sizes: list[int], minutes: float) -> None:
    """The least effective sample size per second of runs by the strict rule, and what they say on the way."""
    print(
        "\n| chains | search for the mode and warm-up | in all | draws per chain | greatest R̂ | least ESS bulk / tail "
        "| per second |"
    )
    print("|---|---|---|---|---|---|---|")
    for chains in sizes:
        began = time.perf_counter()

        def told(text: Any, began: float = began) -> None:
            print(f"  {time.perf_counter() - began:.1f} s  {text}", file=sys.stderr, flush=True)

        with show_messages():
            first = first_checkpoint(posterior.target, "hmc", chains, seed=0)
        prepared = time.perf_counter() - began
        stop, block = StopRule(rhat=1.01, ess=400, max_seconds=60 * minutes), 100 if chains < 32 else 25
        found = sample(
            posterior, "hmc", chains, 10_000, block=block, stop=stop, progress=False, resume=(first, []),
            on_block=lambda index, *_, told=told: told(f"block {index + 1}"),
        )  # fmt: skip
        seconds = time.perf_counter() - began
        judged = convergence(found.idata)
        rhat = max(float(x.max()) for x in judged.rhat.values())
        bulk, tail = (min(float(x.min()) for x in ess.values()) for ess in (judged.ess_bulk, judged.ess_tail))
        draws = found.idata.posterior.sizes["draw"]
        print(
            f"| {chains} | {prepared:.0f} s | {seconds:.0f} s | {draws} | {rhat:.3f} | {bulk:.0f} / {tail:.0f} | "
            f"{bulk / seconds:.2g} / {tail / seconds:.2g} |\n  {found.reason}",
            flush=True,
        )


if __name__ == "__main__":
    main()
