"""Registrations of a pair of unlike contrast with a known truth."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import bayesreg as br
from tests.options import posterior_of
from tests.phantoms import ball_mesh, pair_from_model

MESH = ball_mesh(spacing=24.0)
NOISE = 0.01


def push(points):
    """A smooth displacement of some millimetres."""
    x, y, z = points.T
    return 3.0 * np.column_stack([np.sin(y / 25), 0.7 * np.cos(z / 22), np.sin(x / 28)])


@cache
def phantom():
    """Fixed image, moving image, the moving one inverted and brighter at one side, true u_B and T_s."""
    u = np.asarray(br.solve_interior(MESH, np.full(3, 10.0), np.ones(3), push(MESH.points[MESH.boundary])).u)
    fixed, moving, t_similarity = pair_from_model(MESH, u, NOISE, voxel=3.0, blur=5.0)
    along = (moving.grid_points()[..., 0] - MESH.points[:, 0].mean()) / np.ptp(MESH.points[:, 0])
    inverted = moving.with_voxels((1 - np.asarray(moving.voxels)) * (1 + 0.2 * along))
    return fixed, moving, inverted, u[MESH.boundary], t_similarity


@cache
def registered(similarity, which, sampler, t_similarity=None, **settings):
    """Median error of the mean of u_B, mm, rms of the error over the posterior's sd, and the result."""
    pair = phantom()
    post = posterior_of(
        pair[0],
        pair[which],
        MESH,
        similarity=similarity,
        elasticity="uniform",
        fixed={"lam": 10.0, "mu": 1.0},
        quadrature="voxels",
        interpolation="cubic",
        t_elastic=300.0,
        t_similarity=t_similarity or {"median": 2 * pair[4]},
    )
    samples = br.sample(post, sampler, seed=0, progress=False, **settings)
    draws = samples.idata.posterior["u_boundary"].values
    error = draws.mean(axis=(0, 1)) - pair[3]
    return np.median(np.linalg.norm(error, axis=1)), np.sqrt(np.mean((error / draws.std(axis=(0, 1))) ** 2)), samples


ALIKE, INVERTED = 1, 2
QUICK = {"chains": 4, "draws": 200}


@pytest.mark.long
def test_an_inverted_contrast_is_registered_where_squared_differences_fail():
    start = np.median(np.linalg.norm(phantom()[3], axis=1))
    alike, *_ = registered("ssd", ALIKE, "laplace", **QUICK)
    failed, *_ = registered("ssd", INVERTED, "laplace", **QUICK)
    error, away, samples = registered("lncc", INVERTED, "laplace", **QUICK)
    warmth = float(samples.idata.posterior["t_similarity"].mean()) / phantom()[4]
    print(f"median error of u_B, mm: at rest {start:.2f}, ssd {alike:.3f} of one contrast and {failed:.1f} of inverted")
    print(f"contrast, lncc {error:.3f} of inverted contrast, {away:.2f} of its sd; T_s {warmth:.3f} of the true one")
    assert failed > start > 2
    assert error < 2.5 * alike < 0.5 * start
    assert 0.6 < away < 1.6
    assert warmth == pytest.approx(1.0, abs=0.15)


@pytest.mark.long
@pytest.mark.slow
def test_trajectories_agree_with_the_approximation():
    error, away, samples = registered("lncc", INVERTED, "hmc", chains=2, draws=60, warm_up=30, block=60)
    quick_error, _, quick = registered("lncc", INVERTED, "laplace", **QUICK)
    sd, quick_sd = (r.idata.posterior["u_boundary"].std(("chain", "draw")).values for r in (samples, quick))
    print(f"error {error:.3f} mm, {quick_error:.3f} of laplace; {away:.2f} sd; sd {np.median(sd / quick_sd):.3f}")
    assert error < 1.3 * quick_error + 0.05
    assert 0.6 < away < 1.6
    assert 0.9 < np.median(sd / quick_sd) < 1.15


def test_the_papers_kernel_runs():
    *_, samples = registered("lncc", INVERTED, "rwmh", chains=2, draws=50, thin=2, sigma_u=0.003, t_similarity=0.01)
    assert 0.02 < float(samples.idata.sample_stats["acceptance_rate"].mean()) < 0.99
