"""Does the field of log-stiffness find a stiff inclusion that no label shows?

A patch on the top of a ball is pushed in, and its bottom is held. The ball is of one material, with an inclusion of
three times its stiffness. Both images follow the model: the moving one is textured, and the fixed one has independent
Normal noise. The prior has a single tissue. With `--mode elastography` the displacement of the boundary is prescribed;
with `--mode joint` it is sampled, too.

    python -m studies.benchmarks.inclusion --mode elastography --draws 300
"""

from __future__ import annotations

import argparse
import json
import time
from typing import NamedTuple

import jax
import numpy as np

import bayesreg as br
from bayesreg.fem.elasticity import stiffness
from bayesreg.inference.draws.diagnostics import convergence
from bayesreg.model.options import FieldConfig
from tests.oracles.paper import solve_unknown
from tests.phantoms import ball_mesh, pair_from_model

LAM, MU, CONTRAST = 10.0, 1.0, 3.0


class Phantom(NamedTuple):
    """A mesh of one tissue, the mask of its stiff elements, the true u (mm), and the pair of images."""

    mesh: br.TetMesh
    stiff: np.ndarray
    u: np.ndarray
    fixed: br.Image
    moving: br.Image
    t_similarity: float


def phantom(
    radius: float = 30.0, spacing: float = 10.0, volume: float = 2.2, push: float = 12.0, noise_sd: float = 0.005
) -> Phantom:
    """Make the phantom, with lengths in mm and a volume in cm³; its images have a standard deviation of about 0.1."""
    mesh = ball_mesh(radius, spacing)
    mesh = br.TetMesh.from_arrays(mesh.points, mesh.cells, np.zeros(len(mesh.cells), int), ("gm",))
    middle = mesh.points.mean(axis=0)
    distance = np.linalg.norm(mesh.points[mesh.cells].mean(axis=1) - middle - (0, 0, 0.35 * radius), axis=1)
    order = distance.argsort()
    count = 1 + int(np.searchsorted(np.cumsum(mesh.volumes[order]), 1e3 * volume))
    stiff = np.isin(np.arange(len(mesh.cells)), order[:count])
    height = (mesh.points[mesh.boundary] - middle)[:, 2] / radius
    patch, base = mesh.boundary[height > 0.85], mesh.boundary[height < -0.5]
    prescribed = np.concatenate([patch, base])
    moved = np.vstack([np.tile([0.0, 0.0, -push], (len(patch), 1)), np.zeros((len(base), 3))])
    factor = np.where(stiff, CONTRAST, 1.0)
    u = solve_unknown(stiffness(mesh, LAM * factor, MU * factor).tocsc(), prescribed, moved)
    return Phantom(mesh, stiff, u, *pair_from_model(mesh, u, noise_sd, voxel=2.0, blur=3.0))


def posterior(body: Phantom, mode: str, modes: int = 300, correlation: float = 20.0) -> br.Posterior:
    """The posterior with known λ/μ of the tissue (ν = 0.45) and an unknown field."""
    held = {int(node): tuple(body.u[node].tolist()) for node in body.mesh.boundary}
    joint = br.Boltzmann(temperature=br.ScalePrior(median=100.0, log_sd=2.0), normalised=True)
    model = br.ModelConfig(
        elasticity="field",
        field=FieldConfig(modes=modes, correlation=correlation),
        fixed={"lam": LAM, "mu": MU},
        elastic_prior=br.Boltzmann(nodes=[], held=held) if mode == "elastography" else joint,
    )
    similarity = br.SquaredDifferences(temperature=body.t_similarity)
    images = br.ImagePair(body.fixed, body.moving, similarity=similarity, quadrature="voxels", interpolation="cubic")
    return br.build_posterior(body.mesh, [images], model)


def judged(body: Phantom, post: br.Posterior, idata) -> dict[str, float]:
    """Compute the acceptance figures: means over the volume, and shares of elements."""
    draws = idata.posterior
    stacked = [draws[name].values.reshape(-1, *draws[name].shape[2:]) for name in ("field_sd", "field")]
    factor = np.exp(stacked[0][:, None] * (stacked[1] @ np.asarray(post.data.body.field.basis).T))
    mean, likely, stiff, volumes = factor.mean(axis=0), (factor > 1.5).mean(axis=0), body.stiff, body.mesh.volumes
    inside, outside = (float(np.average(mean[which], weights=volumes[which])) for which in (stiff, ~stiff))
    return {
        "elements": len(stiff),
        "inclusion_elements": int(stiff.sum()),
        "inclusion_cm3": float(volumes[stiff].sum() / 1e3),
        "mean_inside": inside,
        "mean_outside": outside,
        "ratio": inside / outside,
        "found_inside": float((likely[stiff] > 0.95).mean()),
        "found_outside": float((likely[~stiff] > 0.95).mean()),
        "field_sd": float(draws["field_sd"].mean()),
    }


def sampled(figures):
    """The convergence figures of the sampled variables."""
    return [values for values in figures.data_vars.values() if values.size and values.notnull().any()]


def main() -> None:
    """Sample the posterior, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mode", choices=("elastography", "joint"), default="elastography")
    for name, value in {"radius": 30.0, "spacing": 10.0, "volume": 2.2, "push": 12.0, "noise_sd": 0.005}.items():
        parser.add_argument(f"--{name}", type=float, default=value)
    parser.add_argument("--modes", type=int, default=300)
    parser.add_argument("--correlation", type=float, default=20.0)
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--draws", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    body = phantom(arguments.radius, arguments.spacing, arguments.volume, arguments.push, arguments.noise_sd)
    post = posterior(body, arguments.mode, arguments.modes, arguments.correlation)
    began = time.perf_counter()
    samples = br.sample(post, "hmc", arguments.chains, arguments.draws, arguments.seed, block=25, progress=True)
    figures = judged(body, post, samples.idata)
    diagnosed = convergence(samples.idata)
    figures |= {
        "share_of_variance": float(post.data.body.field.share),
        "rhat": max(float(values.max()) for values in sampled(diagnosed.rhat)),
        "ess_bulk": min(float(values.min()) for values in sampled(diagnosed.ess_bulk)),
        "ess_tail": min(float(values.min()) for values in sampled(diagnosed.ess_tail)),
        "gradients_per_chain": float(np.mean(samples.tally.gradients)),
        "acceptance": float((samples.tally.acceptance / samples.tally.steps).mean()),
        "seconds": time.perf_counter() - began,
    }
    print(json.dumps(figures | vars(arguments), indent=1))


if __name__ == "__main__":
    main()
