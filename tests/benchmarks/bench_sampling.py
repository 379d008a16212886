"""Speed of the sampler on a phantom of the paper's size; run with `make bench`."""

import time

import jax
import numpy as np

from bayesreg.inference.run import sample
from bayesreg.model.options import ModelConfig
from bayesreg.model.posterior import build_posterior
from tests.oracles.paper import Paper
from tests.phantoms import ball_mesh, smooth_image

STEPS_PER_SECOND = 50  # What each of three chains should make on two cores; the paper's made 5.


def _posterior(model: ModelConfig):
    mesh = ball_mesh(radius=70, spacing=16)
    fixed = smooth_image(mesh.points, (60, 60, 60))
    return build_posterior(fixed, smooth_image(mesh.points, (60, 60, 60), seed=1), mesh, model)


def bench_density():
    for interpolation in ("linear", "cubic"):
        posterior = _posterior(ModelConfig(interpolation=interpolation))
        position = posterior.initial(jax.random.key(0))
        for name, function in (
            ("density", jax.jit(posterior.logdensity)),
            ("gradient", jax.jit(jax.grad(posterior.logdensity))),
        ):
            jax.block_until_ready(function(position))
            start = time.perf_counter()
            for _ in range(20):
                jax.block_until_ready(function(position))
            print(f"\n{interpolation} {name}: {(time.perf_counter() - start) / 20 * 1e3:.1f} ms", end="")


def bench_density_against_numpy_and_scipy():
    """One density of three chains against the plain transcription in tests/oracles (SuperLU, map_coordinates)."""
    posterior = _posterior(ModelConfig())
    mesh, chains = posterior.mesh, 3
    images = [smooth_image(mesh.points, (60, 60, 60), seed=seed) for seed in (0, 1)]
    arrays = [(image.voxels, image.affine) for image in images]
    peer = Paper(mesh.points, mesh.cells, mesh.tissue, *arrays, mesh.boundary)
    values = posterior.constrain(posterior.initial(jax.random.key(0)))
    estimands = jax.tree.map(lambda x: np.tile(x, (chains,) + (1,) * x.ndim), posterior.estimands(values))
    evaluate = jax.jit(jax.vmap(posterior.evaluate_estimands, in_axes=(None, 0)))
    arguments = [np.asarray(values[name]) for name in ("u_boundary", "lam", "mu")]
    ratios = []
    jax.block_until_ready(evaluate(posterior.data, estimands))
    for _ in range(10):
        start = time.perf_counter()
        jax.block_until_ready(evaluate(posterior.data, estimands))
        middle = time.perf_counter()
        for _ in range(chains):
            peer.logdensity(*arguments)
        ratios.append((time.perf_counter() - middle) / (middle - start))
    print(f"\ndensity of {chains} chains: {np.median(ratios):.1f} times as fast as NumPy and SciPy", end="")


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
