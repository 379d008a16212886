"""Twenty calibrated pairs: do the 95 % intervals of λ/μ contain the truth?

All pairs are of the MNI152 brain; each has its own patch and noise (sd 0.01 on each image), and T_s is inferred. The
mesh that makes the pairs is finer than the registering mesh, or the same, which shows the share of the mesh in an
error. A node of the coarser mesh may lie a millimetre or two outside the true body. Where the body slides along the
skull, the true displacement moves this node into the skull: between different meshes the registration therefore has no
skull. Intervals of pairs between different meshes are corrected for the registering mesh, by bodies that are made on a
third mesh (`studies.mesh_error.__main__`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

import bayesreg as br
from bayesreg.distance import forbidden
from bayesreg.fem.location import transfer
from bayesreg.image import robust_scale
from bayesreg.inference.chains.stopping import StopRule
from bayesreg.inference.draws.diagnostics import convergence
from bayesreg.inference.draws.inference_data import dataset
from bayesreg.io.atomic import write_text
from bayesreg.io.datasets import Anatomy as AnatomyOfData
from bayesreg.io.datasets import mni152
from bayesreg.io.domain import without_ridges
from bayesreg.io.meshing import MeshOptions, build_mesh, domain_labels, load_mesh, mesh_domain, save_mesh
from bayesreg.synthetic.deformation import Direction
from bayesreg.synthetic.pair import SyntheticPair, make_pair
from bayesreg.types import InputError
from studies.calibration import figures
from studies.mesh_error.bodies import PATCH_SHARE, Subject, register_body
from studies.mesh_error.ratios import sound
from studies.mesh_error.recalibration import Response, recalibrate, response

COUNT, ENOUGH = 20, 17
TRUE_LAM, TRUE_MU = np.array([1e-6, 10.0, 30.0]), np.array([1e-6, 1.0, 1.0])
TISSUES = {"gm": 1, "wm": 2}
# The edge lengths of the registering mesh, of the mesh that makes the pairs, and of the mesh that makes the bodies.
EDGE, MAKING_EDGE, BODIES_EDGE = 22.0, 12.0, 13.0
BODIES = 30
DISPLACEMENT, NOISE_SD = 10.0, 0.01
QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
SECONDS = 90.0
MODEL = br.ModelConfig()
IMAGE_OPTIONS = {"similarity": br.SquaredDifferences(temperature=br.ScalePrior(median=0.1)), "interpolation": "cubic"}

Progress = Callable[[str], None]
Product = TypeVar("Product")


class Anatomy(NamedTuple):
    """The images and meshes that all pairs share."""

    fixed: br.Image
    tissue: br.Image
    skull: br.Image
    making: br.TetMesh
    registering: br.TetMesh


@cache
def brain() -> tuple[AnatomyOfData, br.Image]:
    """Return the MNI152 brain, and the domain that is meshed."""
    atlas = mni152()
    assert atlas.intracranial is not None
    atlas = atlas._replace(intracranial=without_ridges(atlas.intracranial))
    return atlas, mesh_domain(atlas.tissue, atlas.intracranial)


def skull() -> br.Image:
    """The image of the skull; nonzero voxels are forbidden."""
    atlas, _ = brain()
    return forbidden(atlas.intracranial)


def meshes(folder: Path, edges: Sequence[float]) -> list[br.TetMesh]:
    """Meshes of these edge lengths (mm), stored in a folder because fTetWild is not deterministic."""
    atlas, domain = brain()
    for edge in edges:
        path = folder / f"mesh_{edge:g}mm.vtu"
        if not path.exists():
            save_mesh(build_mesh(atlas.tissue, atlas.intracranial, MeshOptions(edge_length=edge), domain), path)
    return [load_mesh(folder / f"mesh_{edge:g}mm.vtu") for edge in edges]


def anatomy(folder: Path, same_mesh: bool) -> Anatomy:
    """The MNI152 brain, the mesh that makes the pairs and the mesh that registers them."""
    atlas, domain = brain()
    making, registering = meshes(folder, (EDGE if same_mesh else MAKING_EDGE, EDGE))
    fixed = robust_scale(atlas.image, domain.voxels != 0)(atlas.image)
    return Anatomy(fixed, domain_labels(atlas.tissue, domain), skull(), making, registering)


def upwards(seed: int, attempt: Callable[[Direction], Product]) -> tuple[Product, Direction]:
    """Call `attempt` with random upward directions until it succeeds; return its result and the direction."""
    rng = np.random.default_rng(seed)
    while True:
        direction = rng.normal(size=3)
        direction *= np.sign(direction[2]) / np.linalg.norm(direction)
        if direction[2] < 0.2:
            continue
        chosen = tuple(float(x) for x in direction)
        try:
            return attempt(chosen), chosen
        except InputError:
            continue


def push(mesh: br.TetMesh) -> dict[str, Any]:
    """The options of a push, whose patch is equally large on every mesh."""
    patch_nodes = round(PATCH_SHARE * len(mesh.boundary))
    return {"lam": TRUE_LAM, "mu": TRUE_MU, "displacement": DISPLACEMENT, "patch_nodes": patch_nodes}


def make(shared: Anatomy, seed: int) -> tuple[SyntheticPair, Direction]:
    """Make a pair with its own random patch."""
    options = push(shared.making) | {"noise_sd": NOISE_SD, "seed": seed}
    return upwards(seed, lambda direction: make_pair(*shared[:4], direction=direction, **options))


def register_bodies(folder: Path, report_progress: Progress = print) -> Response:
    """Measure the response of the registering mesh by bodies of a third mesh, each stored in a file."""
    shared = anatomy(folder, same_mesh=False)
    (making,) = meshes(folder, [BODIES_EDGE])
    lam, mu = (dict(zip(making.names, values.tolist(), strict=True)) for values in (TRUE_LAM, TRUE_MU))
    subject = Subject(*shared[:3], making, shared.registering, MODEL, IMAGE_OPTIONS, lam, mu, DISPLACEMENT, NOISE_SD)
    bodies = []
    for seed in range(1, BODIES + 1):
        path = folder / f"body_{seed:02d}.json"
        if not path.exists():
            write_text(path, json.dumps(register_body(subject, seed)._asdict()) + "\n")
        bodies.append(json.loads(path.read_text()))
        report_progress(
            f"body {seed} of {BODIES}: λ/μ {bodies[-1]['true']}, found {bodies[-1]['found']} {bodies[-1]['failed']}"
        )
    return response(*(np.array([list(body[key].values()) for body in sound(bodies)]) for key in ("true", "found")))


def allowing_for(curve: Response, pair: dict[str, Any], seed: int) -> dict[str, list[float]]:
    """Correct quantiles of λ/μ for the mesh; draws of each tissue are interpolated from its quantiles."""
    rng = np.random.default_rng(seed)
    levels = rng.uniform(QUANTILES[0], QUANTILES[-1], (200, len(TISSUES)))
    log_ratios = [
        np.interp(level, QUANTILES, np.log(pair["ratio"][name])) for level, name in zip(levels.T, TISSUES, strict=True)
    ]
    recalibrated = recalibrate(curve, np.exp(np.column_stack(log_ratios)), seed)
    return dict(zip(TISSUES, np.quantile(recalibrated, QUANTILES, axis=0).T.tolist(), strict=True))


def register(shared: Anatomy, pair: SyntheticPair, seed: int) -> dict[str, Any]:
    """Register a pair; return the intervals of λ/μ on the mesh, and diagnostics of the sampling and the model."""
    skull = shared.skull if shared.making.digest == shared.registering.digest else None
    images = br.ImagePair(pair.fixed, pair.moving, **IMAGE_OPTIONS)
    posterior = br.build_posterior(shared.registering, [images], MODEL, skull)
    rule = StopRule(rhat=1.01, ess=400, max_seconds=SECONDS)
    samples = br.sample(posterior, "hmc", chains=4, draws=1500, seed=seed, stop=rule, progress=False)
    draws, judged = dataset(samples.idata, "posterior"), convergence(samples.idata)
    u_true = transfer(pair.u, pair.mesh, shared.registering.points)
    ratio = {name: draws["ratio"].values[..., entry].ravel() for name, entry in TISSUES.items()}
    return {
        "ratio": {name: np.quantile(values, QUANTILES).tolist() for name, values in ratio.items()},
        "t_similarity": float(draws["t_similarity"].mean()),
        "noise_sd_of_t_similarity": posterior.images.noise_sd(float(draws["t_similarity"].mean())),
        "residual_sd_at_truth": pair.residual_sd,
        "residual_sd": float(np.std(posterior.images.residuals(samples.u_mean))),
        "residual_sd_at_transferred_truth": float(np.std(posterior.images.residuals(u_true))),
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
    """The true λ/μ of each solid tissue."""
    return {name: float(TRUE_LAM[entry] / TRUE_MU[entry]) for name, entry in TISSUES.items()}


def register_pairs(
    out: Path, same_mesh: bool = False, report_progress: Progress = print, count: int = COUNT
) -> dict[str, Any]:
    """Register all pairs, and tell for GM and for WM whether enough intervals contain the truth.

    Each pair is stored in a file, so that an interrupted study continues with the next pair.
    """
    shared, results, name = anatomy(out, same_mesh), [], "same_mesh" if same_mesh else "pair"
    curve = None if same_mesh else register_bodies(out, report_progress)
    for seed in range(1, count + 1):
        path = out / f"{name}_{seed:02d}.json"
        if not path.exists():
            pair, direction = make(shared, seed)
            result = register(shared, pair, seed) | {"direction": direction, "seed": seed}
            write_text(path, json.dumps(result) + "\n")
            # JAX never frees compiled samplers, and about forty of them exhaust the memory maps of a process.
            jax.clear_caches()
        results.append(json.loads(path.read_text()))
        if curve is not None:
            results[-1] |= {"ratio": allowing_for(curve, results[-1], seed), "ratio_on_the_mesh": results[-1]["ratio"]}
        inside = ", ".join(f"{name} {'in' if covers(results[-1], name) else 'OUT'}" for name in TISSUES)
        report_progress(f"pair {seed} of {count}: {inside}; R̂ of λ {results[-1]['rhat_of_ratio']:.3f}")
    figures.intervals(results, truth(), out / f"{name}s.png")
    covered = {name: sum(covers(pair, name) for pair in results) for name in TISSUES}
    enough = ENOUGH * count / COUNT
    return {
        name: {"as_it_should": covered[name] >= enough, "covered": covered[name], "of": count, "pairs": results}
        for name in TISSUES
    }
