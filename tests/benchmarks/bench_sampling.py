"""Speed of the sampler on a phantom of the paper's size; run with `make bench`."""

import time

import jax
import numpy as np

from bayesreg.inference.run import sample
from bayesreg.model.options import ModelConfig
from bayesreg.model.posterior import build_posterior
from tests.benchmarks.stored import SOLVERS, log_density
from tests.phantoms import ball_mesh, smooth_image

REPETITIONS = 9
STEPS_PER_SECOND = 50  # What each of three chains should make on two cores; the paper's made 5.


def _posterior(model: ModelConfig):
    mesh = ball_mesh(radius=70, spacing=16)
    fixed = smooth_image(mesh.points, (60, 60, 60))
    return build_posterior(fixed, smooth_image(mesh.points, (60, 60, 60), seed=1), mesh, model)


def bench_density_and_gradient():
    """Of 1, 4 and 16 chains, beside `tests.benchmarks.stored`, one chain after the other."""
    posteriors = {method: _posterior(ModelConfig(interpolation=method)) for method in ("linear", "cubic")}
    mesh = posteriors["linear"].mesh
    images = [smooth_image(mesh.points, (60, 60, 60), seed=seed) for seed in (0, 1)]
    print(f"\n{len(mesh.points)} nodes, {len(mesh.cells)} elements; medians of {REPETITIONS}")
    for method, posterior in posteriors.items():
        values = posterior.constrain(posterior.initial(jax.random.key(0)))
        arguments = [np.asarray(values[name]) for name in ("u_boundary", "lam", "mu")]
        data = posterior.conditioned(posterior.estimands(values))
        peers = {}
        for name, solve in SOLVERS.items():
            peer = log_density(mesh, *images, {"linear": 1, "cubic": 3}[method], solve)
            assert np.isclose(peer(*arguments), float(posterior.logdensity_constrained(values)), rtol=1e-9)
            peers[name] = _median(peer, *arguments)
        for chains in (1, 4, 16):
            keys = jax.random.split(jax.random.key(0), chains)
            positions = jax.vmap(posterior.initial)(keys)
            of_all = jax.vmap(posterior.logdensity_of, in_axes=(None, 0))
            slopes = jax.vmap(jax.value_and_grad(posterior.logdensity_of, argnums=1), in_axes=(None, 0))
            density, gradient = (_median(jax.jit(f), data, positions) for f in (of_all, slopes))
            text = f"{method}, {chains} chains: density {density * 1e3:.1f} ms"
            text += f", gradient {gradient / density:.2f} times as long; times as fast as SciPy with "
            print(text + ", ".join(f"{name} {chains * s / density:.1f}" for name, s in peers.items()), flush=True)


def _median(function, *arguments):
    jax.block_until_ready(function(*arguments))
    seconds = []
    for _ in range(REPETITIONS):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        seconds.append(time.perf_counter() - start)
    return np.median(seconds)


def bench_steps_of_the_papers_sampler():
    posterior = _posterior(ModelConfig())
    size = f"{len(posterior.mesh.points)} nodes, {len(posterior.mesh.cells)} elements, {len(posterior.sampled)} sampled"
    for chains in (3, 16):
        blocks: list[float] = []
        sample(
            posterior,
            "rwmh",
            chains=chains,
            draws=30,
            thin=10,
            block=5,
            progress=False,
            on_block=lambda *_, ends=blocks: ends.append(time.perf_counter()),
        )
        rate = 50 / np.median(np.diff(blocks))  # The first block compiles.
        print(f"\n{size}, {chains} chains: {rate:.0f} steps per second and chain", end="")
        assert chains > 3 or rate > STEPS_PER_SECOND
