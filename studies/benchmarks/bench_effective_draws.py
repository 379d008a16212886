"""Compare effective draws per second of the default sampler and of the paper's kernel, on the paper's posterior.

The kernel is too slow for an estimate of its effective sample size from a chain: a short chain overestimates it a
thousandfold. For a random walk with step variances D, acceptance a and posterior covariance C, entry i gains
a C_ii / (4 [C D⁻¹ C]_ii) effective draws per step in the diffusion limit. Acceptance and steps per second are measured
at draws of the converged posterior. The formula is checked on a Gaussian of that covariance, where steps are cheap.
"""

import os
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

import bayesreg as br
from bayesreg.inference.samplers.registry import choose_sampler
from bayesreg.io import store
from bayesreg.io.run_folder import RunFolder
from bayesreg.workflow.assembly import posterior_of
from studies.benchmarks.bench_samplers import PAPERS_THIN, block_from
from studies.benchmarks.bench_sampling import _median
from tests.inference.random_walk import ess_per_step, gaussian_walk

CONFIG = Path(__file__).parents[2] / "configs" / "converged_tissues.yaml"
STEPS = {"u_boundary": 0.008, "lam": 0.03, "mu": 0.003}
CHAINS, STEPS_TIMED, STEPS_TRIED = 3, 1500, 10_000


def bench_effective_draws():
    finished = os.environ.get("BAYESREG_RUN")
    if finished is not None:
        compare_kernels(br.load_result(finished))
    elif "BAYESREG_DATA" in os.environ:
        with tempfile.TemporaryDirectory() as folder:
            compare_kernels(br.run(br.load_config(CONFIG), Path(folder) / "run", progress=False))
    else:
        print("\neffective draws: skipped, BAYESREG_DATA does not name the folder of the paper's data", end="")


def compare_kernels(result):
    """Print the speed of both kernels on the posterior of a finished run of `CONFIG`."""
    convergence = result.run.manifest["convergence"]
    seconds = result.run.manifest["timings"]["sampling"]
    posterior = posterior_of(br.load_config(result.folder / "config.yaml"), store.read_inputs(RunFolder(result.folder)))
    draws = result.idata.posterior.load()
    effective = float(np.median(np.asarray(result.convergence.ess_bulk.u_boundary)))
    nodes, sampled = len(result.mesh.points), len(result.mesh.boundary)
    print(f"\nmesh of {nodes} nodes, {sampled} sampled; {seconds:.0f} s until {convergence}")
    covariance, variances = covariance_and_steps(draws)
    acceptance, inside = papers_acceptance(posterior, draws)
    rate = papers_speed(posterior, draws)
    ess = ess_per_step(covariance, variances, acceptance, effective)
    print(
        f"the paper's kernel at the posterior: {rate:.0f} steps per second and chain, "
        f"{acceptance:.3%} accepted ({inside:.1%} in the support)"
    )
    print("steps per effective draw: median {:,.0f}, greatest {:,.0f}".format(*np.quantile(1 / ess, [0.5, 1.0])))
    for kind in ("bulk", "tail"):
        default_rate, papers_rate = convergence[f"ess_{kind}_min"] / seconds, ess.min() * rate * CHAINS
        print(
            f"least {kind} ESS per second: {default_rate:.3g} against {papers_rate:.3g}, "
            f"{default_rate / papers_rate:,.0f} times"
        )
    check_formula(covariance, variances)


def covariance_and_steps(draws: xr.Dataset):
    flat = {name: draws[name].values.reshape(draws.sizes["chain"] * draws.sizes["draw"], -1) for name in STEPS}
    free = {name: values[:, np.ptp(values, axis=0) > 0].astype(float) for name, values in flat.items()}
    variances = np.concatenate([np.full(free[name].shape[1], step**2) for name, step in STEPS.items()])
    return np.cov(np.concatenate(list(free.values()), axis=1).T), variances


def estimands_of(posterior, draws):
    """The estimands of every kept draw of all chains."""
    flat = {name: draws[name].values.reshape(-1, *draws[name].shape[2:]) for name in STEPS}
    return jax.vmap(posterior.estimands)({name: jnp.asarray(values, float) for name, values in flat.items()})


def papers_acceptance(posterior, draws):
    """Measure the mean acceptance of a step over the posterior, and the share of steps in the support."""
    kernel, places = choose_sampler("rwmh", posterior.target).sampler, estimands_of(posterior.target, draws)

    @jax.jit
    def tried(data, place, keys):
        def attempt(key):
            state = kernel.init(data, None, place)
            info = kernel.step(data, None, key, state)[1]
            return info.acceptance_rate, ~info.outside_support

        return jax.lax.map(attempt, keys)

    count = len(places["u_boundary"])
    keys = jax.random.split(jax.random.key(1), (count, STEPS_TRIED // count + 1))
    outcomes = [tried(posterior.data, jax.tree.map(lambda x, i=i: x[i], places), keys[i]) for i in range(count)]
    rates, inside = (np.concatenate(columns) for columns in zip(*outcomes, strict=True))
    return float(np.nan_to_num(rates).mean()), float(inside.mean())


def papers_speed(posterior, draws):
    """Measure the steps per second of each of three chains, from draws of the posterior, in blocks like a run's."""
    last = jax.tree.map(lambda x: x[-CHAINS:], estimands_of(posterior.target, draws))
    setup = jax.tree.map(lambda x: x.mean(axis=0), last)
    block = block_from(choose_sampler("rwmh", posterior.target), setup, last, STEPS_TIMED // PAPERS_THIN, PAPERS_THIN)
    return STEPS_TIMED / _median(block)


def check_formula(covariance, variances):
    """Check the formula by a long walk on a Gaussian, in coordinates that make its covariance and steps diagonal."""
    predicted, measured = gaussian_walk(covariance, variances, chains=16, steps=200_000)
    ratio = measured / predicted
    print(
        "measured over predicted ESS on that Gaussian, the fastest ten entries: " + " ".join(f"{x:.2f}" for x in ratio)
    )
