"""Speed of the paper's sampler on a phantom of the paper's size; run with `make bench`."""

import time

import jax
import numpy as np
import pytest

from bayesreg.inference.chains.run import sample
from bayesreg.model.build import build_posterior
from bayesreg.model.observations.images.pair import ImagePair
from tests.phantoms import ball_mesh, smooth_image

REPETITIONS = 9
STEPS_PER_SECOND = 50  # The least speed of each of three chains on two cores; the paper's implementation made 5.


def _posterior():
    mesh = ball_mesh(radius=70, spacing=16)
    fixed = smooth_image(mesh.points, (60, 60, 60))
    return build_posterior(mesh, [ImagePair(fixed, smooth_image(mesh.points, (60, 60, 60), seed=1))])


def _median(function, *arguments):
    jax.block_until_ready(function(*arguments))
    seconds = []
    for _ in range(REPETITIONS):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        seconds.append(time.perf_counter() - start)
    return np.median(seconds)


@pytest.mark.parametrize("chains", [pytest.param(chains, id=f"0.8k-{chains}") for chains in (3, 16)])
def bench_steps_of_the_papers_sampler(chains):
    posterior = _posterior()
    blocks: list[float] = []
    sample(
        posterior,
        "rwmh",
        chains=chains,
        draws=30,
        thin=10,
        block=5,
        progress=False,
        on_block=lambda *_: blocks.append(time.perf_counter()),
    )
    rate = 50 / np.median(np.diff(blocks))  # The first block compiles.
    mesh = posterior.mesh
    size = f"{len(mesh.points)} nodes, {len(mesh.cells)} elements, {len(posterior.sampled)} sampled"
    print(f"\n{size}, {chains} chains: {rate:.0f} steps per second and chain", end="")
    assert chains > 3 or rate > STEPS_PER_SECOND
