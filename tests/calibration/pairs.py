"""Twenty calibrated pairs: do the 95 % intervals of λ/μ contain the truth?

Each pair has its own patch and noise (sd 0.01 on each image) and is made on a finer mesh than the one that registers
it, of the MNI152 brain; all share both meshes. T_s is inferred. What the coarse mesh cannot follow is a residual that
no noise explains, and whose neighbours agree.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import bayesreg as br
from bayesreg.fem.location import transfer
from bayesreg.image import robust_scale
from bayesreg.inference.diagnostics import convergence, dataset
from bayesreg.inference.stopping import StopRule
from bayesreg.io.atomic import write_text
from bayesreg.io.datasets import mni152
from bayesreg.io.meshing import MeshOptions, build_mesh, domain_labels, load_mesh, mesh_domain, save_mesh
from bayesreg.model.simulation import SyntheticPair, make_pair
from bayesreg.types import InputError
from tests.calibration import figures

COUNT, ENOUGH = 20, 17
TRUE_LAM, TRUE_MU = np.array([1e-6, 10.0, 30.0]), np.array([1e-6, 1.0, 1.0])
TISSUES = {"gm": 1, "wm": 2}
EDGE, MAKING_EDGE = 22.0, 12.0
DISPLACEMENT, PATCH_NODES = 10.0, 25
QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
SECONDS = 90.0

MODEL = {
    "t_similarity": {"median": 0.1, "log_sd": 1.0},
    "interpolation": "cubic",
}

Say = Callable[[str], None]


class Anatomy(NamedTuple):
    """What all pairs share."""

    fixed: br.Image
    tissue: br.Image
    skull: br.Image
    making: br.TetMesh
    registering: br.TetMesh


def anatomy(folder: Path) -> Anatomy:
    """The MNI152 brain and two meshes of it, kept in a folder: fTetWild is not deterministic."""
    brain = mni152()
    assert brain.intracranial is not None
    domain = mesh_domain(brain.tissue, brain.intracranial)
    meshes = []
    for edge in (MAKING_EDGE, EDGE):
        path = folder / f"mesh_{edge:g}mm.vtu"
        if not path.exists():
            options = MeshOptions(edge_length=edge)
            save_mesh(build_mesh(brain.tissue, brain.intracranial, options, domain), path)
        meshes.append(load_mesh(path))
    fixed = robust_scale(brain.image, domain.voxels != 0)(brain.image)
    forbidden = (np.asarray(brain.intracranial.voxels) == 0).astype(np.uint8)
    tissue = domain_labels(brain.tissue, domain)
    return Anatomy(fixed, tissue, brain.intracranial.with_voxels(forbidden), *meshes)


def make(shared: Anatomy, seed: int) -> tuple[SyntheticPair, tuple[float, float, float]]:
    """A pair whose patch lies in a random direction of the upper half, the first that inverts nothing."""
    rng = np.random.default_rng(seed)
    while True:
        direction = rng.normal(size=3)
        direction *= np.sign(direction[2]) / np.linalg.norm(direction)
        if direction[2] < 0.2:
            continue
        chosen = tuple(float(x) for x in direction)
        try:
            pair = make_pair(
                *shared[:4],
                lam=TRUE_LAM,
                mu=TRUE_MU,
                displacement=DISPLACEMENT,
                patch_nodes=PATCH_NODES,
                direction=chosen,
                noise_sd=0.01,
                seed=seed,
            )
        except InputError:
            continue
        return pair, chosen


def register(shared: Anatomy, pair: SyntheticPair, seed: int, **options: Any) -> dict[str, Any]:
    """Intervals of λ/μ, and how well the sampling and the model do."""
    posterior = br.build_posterior(
        pair.fixed, pair.moving, shared.registering, br.ModelConfig(**MODEL | options), shared.skull
    )
    rule = StopRule(rhat=1.01, ess=400, max_seconds=SECONDS)
    samples = br.sample(posterior, "hmc", chains=4, draws=1500, seed=seed, stop=rule, progress=False)
    draws, judged = dataset(samples.idata, "posterior"), convergence(samples.idata)
    u_true = transfer(pair.u, pair.mesh, shared.registering.points)
    ratio = {name: draws["ratio"].values[..., entry].ravel() for name, entry in TISSUES.items()}
    return {
        "ratio": {name: np.quantile(values, QUANTILES).tolist() for name, values in ratio.items()},
        "t_similarity": float(draws["t_similarity"].mean()),
        "noise_sd_of_t_similarity": posterior.noise_sd(float(draws["t_similarity"].mean())),
        "residual_sd_at_truth": pair.residual_sd,
        "residual_sd": float(np.std(posterior.residuals(samples.u_mean))),
        "residual_sd_at_transferred_truth": float(np.std(posterior.residuals(u_true))),
        "boundary_error_mm": float(np.median(np.linalg.norm((samples.u_mean - u_true)[posterior.sampled], axis=1))),
        "rhat_of_ratio": float(judged.rhat["lam"].max()),
        "rhat": float(max(float(judged.rhat[name].max()) for name in judged.rhat)),
        "draws": int(draws.sizes["draw"]),
        "seconds": samples.seconds,
    }


def covers(pair: dict[str, Any], tissue: str) -> bool:
    """Whether the 95 % interval of λ/μ contains the truth."""
    low, *_, high = pair["ratio"][tissue]
    return bool(low <= truth()[tissue] <= high)


def truth() -> dict[str, float]:
    """λ/μ of each solid tissue."""
    return {name: float(TRUE_LAM[entry] / TRUE_MU[entry]) for name, entry in TISSUES.items()}


def register_pairs(out: Path, say: Say = print, count: int = COUNT) -> dict[str, Any]:
    """All pairs, and whether enough intervals contain the truth, for GM and for WM.

    Each pair is a file of its own, so that what was cut short goes on where it was.
    """
    shared, found = anatomy(out), []
    for seed in range(1, count + 1):
        path = out / f"pair_{seed:02d}.json"
        if not path.exists():
            pair, direction = make(shared, seed)
            write_text(path, json.dumps(register(shared, pair, seed) | {"direction": direction, "seed": seed}) + "\n")
        found.append(json.loads(path.read_text()))
        inside = ", ".join(f"{name} {'in' if covers(found[-1], name) else 'OUT'}" for name in TISSUES)
        say(f"pair {seed} of {count}: {inside}; R̂ of λ {found[-1]['rhat_of_ratio']:.3f}")
    figures.intervals(found, truth(), out / "pairs.png")
    covered = {name: sum(covers(pair, name) for pair in found) for name in TISSUES}
    enough = ENOUGH * count / COUNT
    return {
        name: {"as_it_should": covered[name] >= enough, "covered": covered[name], "of": count, "pairs": found}
        for name in TISSUES
    }
