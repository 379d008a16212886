"""Measure time and memory after the last draw, by the number of draws: storing, convergence, report and `apply`.

    python -m studies.benchmarks.large_posterior [--nodes 10000] [--chains 4] [--draws 1000 2000]

The draws are synthetic and autoregressive about rest, and all nodes of a ball are sampled. Each number of draws has its
own process. Memory should be constant, and time linear in the draws.
"""

from __future__ import annotations

import argparse
import cProfile
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pandas as pd
from ruamel.yaml import YAML
from scipy.signal import lfilter

import bayesreg as br
from bayesreg.config import load_config
from bayesreg.inference.chains.checkpoint import no_steps
from bayesreg.inference.chains.run import Samples
from bayesreg.inference.draws.blocks import Block
from bayesreg.io.run_folder import RunFolder
from bayesreg.workflow.assembly import posterior_of
from bayesreg.workflow.finish import finish
from bayesreg.workflow.preparation import prepared_inputs, store_inputs, with_unsampled
from studies.endurance.small_run import write_pair
from tests.phantoms import ball_mesh

BLOCK, SD, MEMORY_OF_CHAIN = 100, 0.3, 0.9


class SyntheticBlocks:
    """Blocks of autoregressive draws, each made when it is read."""

    def __init__(self, posterior: br.Posterior, chains: int, draws: int) -> None:
        estimands = posterior.estimands(posterior.reference())
        self.reference = {name: np.asarray(value) for name, value in estimands.items()}
        self.chains, self.draws = chains, draws

    def __len__(self) -> int:
        return -(-self.draws // BLOCK)

    def __getitem__(self, index: int, /) -> Block:
        rng, length = np.random.default_rng(index), min(BLOCK, self.draws - index * BLOCK)
        block = {}
        for name, value in self.reference.items():
            noise = rng.standard_normal((self.chains, length, *value.shape), np.float32)
            wave = lfilter([np.sqrt(1 - MEMORY_OF_CHAIN**2)], [1, -MEMORY_OF_CHAIN], noise, axis=1)
            block[name] = SD * wave if name == "u_boundary" else value * np.exp(SD * wave)
        lp = rng.standard_normal((self.chains, length))
        counts = np.ones((self.chains, length), int)
        return block | {
            "lp": lp, "similarity_energy": lp**2, "strain_energy": lp**2, "acceptance_rate": np.exp(-(lp**2)),
            "solver_iterations": 1.0 * counts, "solver_failed": 0 * counts, "outside_support": 0 * counts,
            "diverging": counts < 0, "n_steps": counts,
        }  # fmt: skip

    def __iter__(self) -> Iterator[Block]:
        return (self[index] for index in range(len(self)))

    def append(self, block: Block, /) -> None:
        raise NotImplementedError


def spacing_of(nodes: int) -> float:
    """The spacing with which a ball has about `nodes` nodes."""
    low, high = 1.0, 30.0
    while high - low > 0.02:
        middle = (low + high) / 2
        low, high = (middle, high) if len(ball_mesh(38, middle).points) > nodes else (low, middle)
    return high


def measure(nodes: int, chains: int, draws: int, profile: Path | None) -> None:
    """Measure one number of draws, and print a line."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path, out = write_pair(folder), RunFolder(folder / "run")
        br.save_mesh(ball_mesh(38, spacing_of(nodes)), folder / "mesh.vtu")
        settings = YAML(typ="safe").load(path)
        settings["model"]["elastic_prior"] = {"nodes": "all"}
        YAML(typ="safe").dump(settings, path)
        config = load_config(path)
        inputs, provenance = prepared_inputs(config)
        posterior = posterior_of(config, inputs)
        nodal = np.ones(inputs.mesh.points.shape)
        samples = Samples(
            posterior.target, SyntheticBlocks(posterior, chains, draws), 0 * nodal, SD * nodal,
            {name: np.ones(np.shape(value)) for name, value in posterior.reference().items()},
            jax.tree.map(lambda zeros: np.asarray(zeros) + 1, no_steps((chains,))), None, "made up", 1.0, exact=True,
        )  # fmt: skip
        seconds = []

        def timed(function) -> None:
            began = time.perf_counter()
            function()
            seconds.append(time.perf_counter() - began)

        with out.locked():
            store_inputs(out, inputs, with_unsampled(provenance, time.perf_counter()))
            profiler = cProfile.Profile()
            if profile:
                profiler.enable()
            timed(lambda: finish(config, inputs, posterior, samples, provenance, out, time.perf_counter()))
            if profile:
                profiler.dump_stats(profile)
        pd.DataFrame(inputs.mesh.points[:100], columns=list("xyz")).to_csv(folder / "points.csv", index=False)
        timed(lambda: br.apply(out.path, folder / "carried", points=folder / "points.csv"))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        estimands = sum(np.size(value) for value in posterior.reference().values())
        size = (out.path / "posterior.nc").stat().st_size / 2**30
        print(
            f"{draws} draws × {chains} chains × {estimands} estimands, {size:.2f} GiB: written, judged and reported in "
            f"{seconds[0]:.0f} s, applied in {seconds[1]:.0f} s; at most {peak:.2f} GiB of memory",
            flush=True,
        )


def main() -> None:
    """Print a line for each number of draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, default=10_000)
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--draws", type=int, nargs="+", default=[1000, 2000])
    parser.add_argument("--profile", type=Path, help="write a profile to this file, if there is one number of draws")
    options = parser.parse_args()
    if len(options.draws) == 1:
        measure(options.nodes, options.chains, options.draws[0], options.profile)
        return
    for draws in options.draws:
        arguments = ["--nodes", options.nodes, "--chains", options.chains, "--draws", draws]
        subprocess.run([sys.executable, "-m", "studies.benchmarks.large_posterior", *map(str, arguments)], check=True)


if __name__ == "__main__":
    main()
