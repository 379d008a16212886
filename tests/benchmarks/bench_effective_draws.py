"""Effective draws per second of the default sampler against the paper's kernel, on the paper's posterior.

The kernel cannot be run until its effective sample size can be estimated: a short chain flatters it a thousandfold.
For a random walk with step variances D, acceptance a and posterior covariance C, entry i gains per step, in the
diffusion limit, a C_ii / (4 [C D⁻¹ C]_ii) effective draws. Acceptance and steps per second are measured at draws of the
converged posterior; the formula is checked on a Gaussian of that covariance, where steps are cheap.
"""

import os
import tempfile
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

import bayesreg as br
from bayesreg.assembly import posterior_of
from bayesreg.inference.samplers import SAMPLERS
from bayesreg.io import store
from tests.inference.random_walk import ess_per_step, gaussian_walk

CONFIG = Path(__file__).parents[2] / "configs" / "converged_tissues.yaml"
STEPS = {"u_boundary": 0.008, "lam": 0.03, "mu": 0.003}
CHAINS, STEPS_TIMED = 3, 1500


def bench_effective_draws():
    if "BAYESREG_DATA" not in os.environ:
        print("\neffective draws: skipped, BAYESREG_DATA does not name the folder of the paper's data", end="")
        return
    given = os.environ.get("BAYESREG_MESH")
    overrides = [] if given is None else [f"mesh.file={given}"]
    with tempfile.TemporaryDirectory() as folder:
        result = br.run(br.load_config(CONFIG, overrides), Path(folder) / "run", progress=False)
        convergence = result.run.manifest["convergence"]
        seconds = result.run.manifest["timings"]["sampling"]
        posterior = posterior_of(br.load_config(CONFIG, overrides), store.read_inputs(result.folder))
        draws = result.idata.posterior.load()
        effective = float(np.median(np.asarray(result.convergence.ess_bulk.u_boundary)))
        mesh = result.mesh
    print(f"\nmesh of {len(mesh.points)} nodes, {len(mesh.boundary)} sampled; {seconds:.0f} s until {convergence}")
    covariance, variances = covariance_and_steps(draws)
    rate, acceptance = papers_kernel(posterior, draws)
    ess = ess_per_step(covariance, variances, acceptance, effective)
    print(f"the paper's kernel at the posterior: {rate:.0f} steps per second and chain, {acceptance:.1%} accepted")
    print("steps per effective draw: median {:,.0f}, greatest {:,.0f}".format(*np.quantile(1 / ess, [0.5, 1.0])))
    for kind in ("bulk", "tail"):
        found, least = convergence[f"ess_{kind}_min"] / seconds, ess.min() * rate * CHAINS
        print(f"least {kind} ESS per second: {found:.3g} against {least:.3g}, {found / least:,.0f} times")
    check_formula(covariance, variances)


def covariance_and_steps(draws: xr.Dataset):
    flat = {name: draws[name].values.reshape(draws.sizes["chain"] * draws.sizes["draw"], -1) for name in STEPS}
    free = {name: values[:, np.ptp(values, axis=0) > 0].astype(float) for name, values in flat.items()}
    variances = np.concatenate([np.full(free[name].shape[1], step**2) for name, step in STEPS.items()])
    return np.cov(np.concatenate(list(free.values()), axis=1).T), variances


def papers_kernel(posterior, draws):
    """Steps per second of each of three chains, and the share of all proposals that is accepted, at the posterior."""
    kernel = SAMPLERS["rwmh"](posterior)
    last = {name: jnp.asarray(draws[name].values[:CHAINS, -1], float) for name in STEPS}
    estimands = jax.vmap(posterior.estimands)(last)

    @jax.jit
    def walk(data, states, keys):
        def step(states, keys):
            states, info = jax.vmap(partial(kernel.step, data, None))(keys, states)
            return states, info.acceptance_rate

        return jax.lax.scan(step, states, keys)

    states = jax.vmap(partial(kernel.init, posterior.data, None))(estimands)
    keys = jax.random.split(jax.random.key(0), (STEPS_TIMED, CHAINS))
    jax.block_until_ready(walk(posterior.data, states, keys))
    began = time.perf_counter()
    _, rates = jax.block_until_ready(walk(posterior.data, states, keys))
    return STEPS_TIMED / (time.perf_counter() - began), float(rates.mean())


def check_formula(covariance, variances):
    """A long walk on the Gaussian of that covariance, in the coordinates in which covariance and steps are diagonal."""
    predicted, measured = gaussian_walk(covariance, variances, chains=16, steps=200_000)
    ratio = measured / predicted
    print(
        "measured over predicted ESS on that Gaussian, the fastest ten entries: " + " ".join(f"{x:.2f}" for x in ratio)
    )
