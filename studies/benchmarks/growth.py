"""How do the cost of a density, the cost of its gradient and peak memory grow with the mesh and the quadrature?

    python -m studies.benchmarks.growth [--nodes 5000 30000 100000] [--chains 4] [--voxels]

The mesh is a ball of radius 80 mm with three shells; its boundary nodes are sampled, and images of 1.5 mm have cubic
interpolation. λ and μ of the chains are scattered about the reference by a factor of 1.35, and solves have the
tolerance of chains. From the smallest mesh to the largest, the cost of a density may grow with the nodes to the power
of 1.15, and the iterations by a factor of 1.5, within 8 GiB. Every mesh has its own process, which gives its peak
memory. With --voxels the quadrature points are the two million voxels of a fixed image of 1 mm, on a mesh of the
paper's size. Times are medians of nine.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from functools import partial
from typing import Any

import jax
import numpy as np

from bayesreg.inference.target import estimands_of, logdensity
from bayesreg.model.build import build_posterior
from bayesreg.model.observations.images.pair import ImagePair
from bayesreg.model.posterior import Posterior
from studies.benchmarks.bench_sampling import _median
from studies.benchmarks.places import scattered
from studies.benchmarks.solves import mesh_of
from tests.phantoms import smooth_image

PAPER_SIZE = 801
MOST_POWER, MOST_ITERATIONS, MOST_GIB = 1.15, 1.5, 8.0


def main() -> None:
    """Print a row for each mesh, and the exponents."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, nargs="+", default=[5_000, 30_000, 100_000])
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--voxels", action="store_true", help="every voxel of a fixed image of 1 mm")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measured(options.one, options.chains, options.voxels)))
        return
    columns = "nodes", "points", "iterations", f"density of {options.chains} chains, ms", "gradient", "set-up, s"
    print("|", " | ".join((*columns, "compiling, s", "GiB")), "|")
    print("|---|---|---|---|---|---|---|---|")
    rows = []
    for nodes in [PAPER_SIZE] if options.voxels else options.nodes:
        arguments = ["--one", str(nodes), "--chains", str(options.chains)] + ["--voxels"] * options.voxels
        process = subprocess.run([sys.executable, "-m", __spec__.name, *arguments], capture_output=True, text=True)
        if process.returncode:
            sys.exit(process.stderr)
        row = json.loads(process.stdout.splitlines()[-1])
        rows.append(row)
        print(
            f"| {row['nodes']:,} | {row['points']:,} | {row['iterations']} | {row['density'] * 1e3:.1f} | "
            f"{row['gradient'] * 1e3:.1f} | {row['setup']:.1f} | {row['compiling']:.1f} | {row['gib']:.2f} |",
            flush=True,
        )
    if len(rows) > 1:
        nodes, *times = (np.log([row[name] for row in rows]) for name in ("nodes", "density", "gradient"))
        density, gradient = ((x[-1] - x[0]) / (nodes[-1] - nodes[0]) for x in times)
        more = rows[-1]["iterations"] / rows[0]["iterations"]
        print(
            f"from the smallest to the largest as nodes to the power of {density:.2f}, gradient {gradient:.2f}; "
            f"{more:.2f} times the iterations"
        )
        sys.exit(not (density <= MOST_POWER and more <= MOST_ITERATIONS and rows[-1]["gib"] < MOST_GIB))


def measured(nodes: int, chains: int, voxels: bool) -> dict[str, Any]:
    """Measure the seconds and the peak memory of this process."""
    begun = time.perf_counter()
    posterior = phantom(nodes, voxels)
    values = posterior.constrain(posterior.initial(jax.random.key(0)))
    data = posterior.target.condition(posterior.estimands(values))
    positions = scattered(posterior, chains)
    setup = time.perf_counter() - begun
    densities = jax.jit(jax.vmap(partial(logdensity, posterior.target), in_axes=(None, 0)))
    gradients = jax.jit(
        jax.vmap(jax.value_and_grad(partial(logdensity, posterior.target), argnums=1), in_axes=(None, 0))
    )
    begun = time.perf_counter()
    compiled = [function.lower(data, positions).compile() for function in (densities, gradients)]
    compiling = time.perf_counter() - begun
    assert np.isfinite(compiled[0](data, positions)).all()
    density, gradient = (_median(function, data, positions) for function in compiled)

    def evaluated(data: Any, position: Any) -> Any:
        return posterior.target.evaluate_estimands(data, estimands_of(posterior.target, data, position))

    iterations = jax.jit(jax.vmap(evaluated, in_axes=(None, 0)))(data, positions).solver_iterations
    return {
        "nodes": len(posterior.mesh.points),
        "points": len(posterior.images.quadrature.weights),
        "iterations": int(iterations.max()),
        "density": density,
        "gradient": gradient,
        "setup": setup,
        "compiling": compiling,
        "gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def phantom(nodes: int, voxels: bool) -> Posterior:
    """The posterior of two smooth images on a ball of about `nodes` nodes."""
    mesh = mesh_of(nodes)
    shape = (184,) * 3 if voxels else (120,) * 3
    fixed, moving = (smooth_image(mesh.points, shape, seed=seed, blur=6.0) for seed in (0, 1))
    images = ImagePair(fixed, moving, interpolation="cubic", quadrature="voxels" if voxels else "gauss4")
    return build_posterior(mesh, [images])


if __name__ == "__main__":
    main()
