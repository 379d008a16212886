"""A made-up but plausible run on a phantom: an ellipsoidal brain in a skull, with draws that follow a known rule."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import xarray as xr
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.io.records import Predicted, Run, Truth
from bayesreg.mesh import TetMesh
from bayesreg.model.elastic.boltzmann import Boltzmann
from bayesreg.model.observations.images.options import ImageOptions
from bayesreg.report.metrics import compute_metrics
from bayesreg.report.study import Study as PageStudy
from tests.phantoms import ball_mesh, rotated_affine

CENTRE = np.array([2.0, -18.0, 12.0])
RADII = np.array([62.0, 78.0, 55.0])
PATCH = np.array([0.45, 0.55, 0.70])
NAMES = ("csf", "gm", "wm")
TRUE_LAM, TRUE_MU = np.array([1.0, 10.0, 30.0]), np.ones(3)
# Median and log-sd of the draws of λ by tissue.
LAM_POSTERIOR = np.array([[0.9, 8.5, 24.0], [0.3, 0.16, 0.12]])


class Draws(NamedTuple):
    """What opening posterior.nc gives."""

    posterior: xr.Dataset
    sample_stats: xr.Dataset


class Study(NamedTuple):
    """The arguments of `write_report`."""

    run: Run
    idata: Draws
    rhat: xr.Dataset
    ess_bulk: xr.Dataset
    ess_tail: xr.Dataset


def tissue_at(points: np.ndarray) -> np.ndarray:
    """0 outside, 1 CSF, 2 GM, 3 WM."""
    scaled = (points - CENTRE) / RADII
    radius = np.linalg.norm(scaled, axis=-1)
    angle = np.arctan2(scaled[..., 1], scaled[..., 0])
    wave = 0.03 * np.sin(9 * angle) * np.cos(5 * scaled[..., 2])
    tissue = np.select([radius < 0.74 + wave, radius < 0.97 + wave / 2, radius <= 1.02], [3, 2, 1], 0)
    horns = [np.linalg.norm((points - CENTRE - (s * 11, 4, 4)) / (7, 27, 11), axis=-1) < 1 for s in (-1, 1)]
    return np.where(np.any(horns, axis=0), 1, tissue)


def intensity_at(points: np.ndarray) -> np.ndarray:
    return np.array([0.03, 0.22, 0.58, 0.86])[tissue_at(points)]


def true_displacement(points: np.ndarray) -> np.ndarray:
    """A bump of 15 mm under a patch, inwards, and a slight rotation elsewhere."""
    where = CENTRE + RADII * PATCH / np.linalg.norm(PATCH)
    inwards = (CENTRE - where) / np.linalg.norm(CENTRE - where)
    bump = np.exp(-((points - where) ** 2).sum(axis=-1) / (2 * 30.0**2))
    turn = np.cross((0.0, 0.01, 0.015), points - CENTRE)
    return 15 * bump[..., None] * inwards + turn


def phantom_mesh(spacing: float) -> TetMesh:
    ball = ball_mesh(40.0, spacing)
    points = (ball.points - (5.0, -3.0, 8.0)) / 40 * RADII + CENTRE
    tissue = tissue_at(points[ball.cells].mean(axis=1)) - 1
    return TetMesh.from_arrays(points, ball.cells, np.maximum(tissue, 0), NAMES)


def phantom_images(mesh: TetMesh, shape: tuple[int, int, int], rng: np.random.Generator) -> dict[str, Image]:
    grid = Image(np.zeros(shape), rotated_affine(mesh.points, shape, margin=16.0, angles=(6.0, -4.0, 9.0)))
    points = grid.grid_points()
    origin = points.copy()
    for _ in range(30):
        origin = points - true_displacement(origin)
    inside = np.linalg.norm((points - CENTRE) / RADII, axis=-1) <= 1.03
    blurred = [ndimage.gaussian_filter(intensity_at(x), 0.5) for x in (points, origin)]
    fixed, moving = (image + 0.01 * rng.normal(size=shape) for image in blurred)
    return {
        "fixed": grid.with_voxels(fixed),
        "moving": grid.with_voxels(moving),
        "warped": grid.with_voxels(fixed + 0.015 * ndimage.gaussian_filter(rng.normal(size=shape), 1)),
        "tissue": grid.with_voxels(tissue_at(points).astype(np.int8)),
        "skull": grid.with_voxels((~inside).astype(np.uint8)),
    }


def walks(rng: np.random.Generator, chains: int, draws: int, shape: tuple[int, ...], memory: float) -> np.ndarray:
    """Stationary autoregressive chains of variance one."""
    steps = rng.normal(size=(chains, draws, *shape))
    steps[:, 1:] *= np.sqrt(1 - memory**2)
    for k in range(1, draws):
        steps[:, k] += memory * steps[:, k - 1]
    return steps


def boundary_draws(mesh: TetMesh, u_mean: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Draws about the mean, pushed back where a node would leave the skull."""
    points = mesh.points[mesh.boundary]
    draws = u_mean[mesh.boundary] + 0.35 * noise
    outwards = (points - CENTRE) / RADII**2
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    room = 1.2
    beyond = np.maximum((draws * outwards).sum(axis=-1) - room, 0)
    return draws - 2 * beyond[..., None] * outwards


def make_study(
    seed: int = 0,
    spacing: float = 12.0,
    shape: tuple[int, int, int] = (58, 70, 40),
    chains: int = 3,
    draws: int = 300,
    memory: float = 0.6,
    uniform: bool = False,
    error: float = 0.25,
) -> Study:
    rng = np.random.default_rng(seed)
    mesh = phantom_mesh(spacing)
    truth_u = true_displacement(mesh.points)
    waves = np.sin(mesh.points / 17 + rng.normal(size=3)) + 0.5 * rng.normal(size=mesh.points.shape)
    u_mean = truth_u + error * waves
    truth = Truth(truth_u, TRUE_LAM, TRUE_MU, 0.5 * truth_u)
    noise = walks(rng, chains, draws, (len(mesh.boundary), 3), memory)
    if memory > 0.95:
        noise += 2 * rng.normal(size=(chains, 1, len(mesh.boundary), 3))
    posterior = make_posterior(rng, mesh, boundary_draws(mesh, u_mean, noise), memory, uniform)
    spread = 0.25 + 0.4 * np.linalg.norm((mesh.points - CENTRE) / RADII, axis=1, keepdims=True) ** 2
    run = Run(
        config="name: phantom\nmodel:\n  elasticity: " + ("uniform" if uniform else "tissue") + "\n",
        manifest=manifest(uniform, converged=memory <= 0.95),
        mesh=mesh,
        u_mean=u_mean,
        u_sd=spread * (0.5, 0.6, 0.4),
        truth=truth,
        metrics=compute_metrics(mesh, u_mean, truth, posterior),
        predicted=make_predicted(rng, mesh, u_mean, chains),
        **phantom_images(mesh, shape, rng),
    )
    stats = sample_stats(rng, chains, draws, memory)
    return Study(run, Draws(posterior, stats), *diagnose(rng, posterior, memory, draws * chains))


def make_posterior(rng: np.random.Generator, mesh: TetMesh, u: np.ndarray, memory: float, uniform: bool) -> xr.Dataset:
    chains, draws = u.shape[:2]
    centre, sd = (
        (np.array([14.0]), np.array([0.12])) if uniform else (np.array([0.9, 8.5, 24.0]), np.array([0.3, 0.16, 0.12]))
    )
    lam = centre * np.exp(sd * walks(rng, chains, draws, centre.shape, memory))
    mu = np.exp(0.05 * walks(rng, chains, draws, centre.shape, memory))
    mu[..., 0 if uniform else 1] = 1.0
    dims = ("chain", "draw", "tissue")
    return xr.Dataset(
        {
            "u_boundary": (("chain", "draw", "node", "axis"), u),
            "lam": (dims, lam),
            "mu": (dims, mu),
            "ratio": (dims, lam / mu),
        },
        coords={"node": mesh.boundary, "axis": list("xyz"), "tissue": ["uniform"] if uniform else list(NAMES)},
    )


def make_predicted(rng: np.random.Generator, mesh: TetMesh, u_mean: np.ndarray, chains: int) -> Predicted:
    """Two places with a covariance of known axes; P(> 2 mm) that rises with x; residuals of sd 1.3."""
    nodes = [int(np.linalg.norm(u_mean, axis=1).argmax()), int(mesh.interior[0])]
    spread = rng.normal(size=(chains, 100, 2, 3)) * (0.9, 0.3, 0.1)
    observed = rng.normal((1.3, 4.0, 0.0), (0.01, 0.2, 0.05), (chains, 100, 3))
    return Predicted(
        chain_mean=np.stack([u_mean] * chains),
        far_mm=np.array(2.0),
        far=np.clip((mesh.points[:, 0] - CENTRE[0]) / RADII[0], 0, 1),
        reach=np.full(len(u_mean), 1.25),
        place_names=np.array(["ventricle", "tip <b>"]),
        place_points=mesh.points[nodes],
        place_draws=u_mean[nodes] + spread,
        motion=rng.normal((1.0, -2.0, 0.5, 3.0, 0.0, -4.0), 0.1, (chains, 100, 6)),
        centre=np.array(CENTRE),
        observations={
            "images/residual": 1.3 * rng.normal(size=4 * len(mesh.cells)),
            "images/residual_tissue": np.repeat(mesh.tissue, 4),
            "images/observed": observed,
            "images/replicated": rng.normal((1.0, 4.0, 0.0), (0.01, 0.2, 0.05), (chains, 100, 3)),
        },
    )


def sample_stats(rng: np.random.Generator, chains: int, draws: int, memory: float) -> xr.Dataset:
    energy = 40 + 3 * walks(rng, chains, draws, (), memory)
    return xr.Dataset(
        {
            "lp": (("chain", "draw"), -energy / 0.05),
            "similarity_energy": (("chain", "draw"), energy),
            "strain_energy": (("chain", "draw"), 9e4 + 4e3 * walks(rng, chains, draws, (), memory)),
        }
    )


def diagnose(rng: np.random.Generator, posterior: xr.Dataset, memory: float, total: int) -> list[xr.Dataset]:
    """Figures of the size that such chains would have; NaN where μ is fixed."""
    slow = memory > 0.95
    diagnostics = []
    for kind in ("rhat", "bulk", "tail"):
        variables = {}
        for name, draws in posterior.data_vars.items():
            shape = draws.shape[2:]
            excess = rng.gamma(2.0, 0.4 if slow else 0.0008, shape)
            values = 1 + excess if kind == "rhat" else total * rng.uniform(0.1, 0.4, shape) / (1 + 20 * excess)
            varies = draws.to_numpy().std(axis=(0, 1)) > 0
            variables[name] = (draws.dims[2:], np.where(varies, values, np.nan))
        diagnostics.append(xr.Dataset(variables, coords=posterior.coords))
    return diagnostics


def manifest(uniform: bool, converged: bool) -> dict:
    return {
        "name": "Phantom, uniform" if uniform else "Phantom, by tissue",
        "versions": {"bayesreg": "0.1.0", "jax": "0.10.2", "python": "3.11.2"},
        "seed": 0,
        "mesh_digest": "0123456789abcdef" * 4,
        "images": {"fixed": "ab" * 32, "moving": "cd" * 32},
        "timings": {"mesh": 23.0, "compile": 4.1, "sampling": 301.5, "total": 352.7},
        "devices": ["cpu:0"],
        "sampler": {"name": "rwmh", "settings": {"sigma_u": 0.008, "sigma_lam": 0.03, "sigma_mu": 0.003, "thin": 10}},
        "exact": True,
        "stopped": {
            "reason": "R̂ fell below 1.01 for all estimands" if converged else "the budget of 5 min was spent",
            "converged": converged,
            "rhat_threshold": 1.01,
        },
        "acceptance": {"overall": 0.0871, "inside_support": 0.243},
        "contact_nodes": 17,
        "solver": {"failed": 0, "iterations_mean": 14.2},
        "steps_per_second_per_chain": 63.4,
        "residual_sd": 0.0151,
        "implied_noise_sd": 0.0146,
        "appraisal": {"warnings": ["A fifth of the organ is ignored."], "notes": []},
        "observations": {
            "images": {
                "kind": "images",
                "title": "pair of images",
                "options": ImageOptions().model_dump(mode="json"),
                "log": -6021.4,
                "values": 12_000,
                "residual_rms": 1.03,
            }
        },
        "model": {
            "preset": "paper",
            "elasticity": "uniform" if uniform else "tissue",
            "elastic_prior": Boltzmann().model_dump(mode="json"),
        },
    }


@pytest.fixture(scope="session")
def study() -> Study:
    return make_study()


@pytest.fixture(scope="session")
def uniform_study() -> Study:
    return make_study(seed=1, uniform=True, error=0.45, memory=0.995, draws=200)


@pytest.fixture(scope="session")
def clinical_study(study: Study) -> Study:
    """The same without a truth and without a skull."""
    return study._replace(run=replace(study.run, truth=None, skull=None, metrics=None))


@pytest.fixture(scope="session")
def seen(study: Study) -> PageStudy:
    """The study as pages see it."""
    return PageStudy(*study)
