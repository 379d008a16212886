"""The samplers against posteriors that are known exactly.

Where the moving image is linear in x, E_s is quadratic in u_B, and the posterior of u_B at fixed λ, μ is a Gaussian
whose mean and precision the oracle computes. With a flat skull it is that Gaussian, cut off by a hard wall or damped by
a soft one: rejection samples it.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

import bayesreg as br
from tests.options import posterior_of
from tests.oracles import paper
from tests.phantoms import box_mesh, flat_skull, linear_image, rotated_affine, smooth_image

MESH = box_mesh(2)
LAM, MU = np.array([0.5, 1.0, 1.5]), np.array([0.7, 1.0, 1.4])
OFFSET, GRADIENT = 0.4, np.array([0.03, -0.02, 0.04])
TEMPERATURES = {"t_similarity": 1.0, "t_elastic": 20.0, "rigid_sd": 0.3}
KNOWN = {name: dict(zip(MESH.names, values, strict=True)) for name, values in (("lam", LAM), ("mu", MU))}
OPTIONS = {"fixed": KNOWN, **TEMPERATURES}
WALL, FAR, VOXEL = 21.0, 45.0, 2.0
WIDTH = 0.15

CHAINS, STEPS_PER_DRAW = 32, 15
# Of the random walk; the others forget sooner, and half as many do.
DRAWS = 240


class Problem(NamedTuple):
    posterior: br.Posterior
    oracle: paper.Paper
    exact: paper.Gaussian


@cache
def problem() -> Problem:
    moving = linear_image(MESH.points, GRADIENT, OFFSET)
    affine = rotated_affine(MESH.points, (14, 11, 16))
    texture = smooth_image(MESH.points, seed=4)
    # What the moving image shows after a shift by (0.8, -0.5, 0.3) mm, and a texture that it cannot explain.
    ramp = OFFSET + (texture.grid_points() + np.array([0.8, -0.5, 0.3])) @ GRADIENT
    fixed = br.Image(ramp + 0.1 * (texture.voxels - 0.5), affine)
    arrays = ((image.voxels, image.affine) for image in (fixed, moving))
    oracle = paper.Paper(MESH.points, MESH.cells, MESH.tissue, *arrays, MESH.boundary, **TEMPERATURES)
    exact = paper.gaussian_posterior(oracle, LAM, MU, OFFSET, GRADIENT)
    return Problem(posterior_of(fixed, moving, MESH, **OPTIONS), oracle, exact)


@cache
def walled(wall: float = WALL, width: float = WIDTH) -> br.Posterior:
    """With a skull, whose width is in voxels."""
    gaussian_problem = problem()
    images = (br.Image(*arrays) for arrays in (gaussian_problem.oracle.fixed, gaussian_problem.oracle.moving))
    skull = flat_skull(MESH.points, axis=0, wall=wall, voxel=VOXEL)
    return posterior_of(*images, MESH, skull, **OPTIONS, skull_width=width)


def run(posterior, sampler, seed, **settings):
    draws, thin = (DRAWS, STEPS_PER_DRAW) if sampler == "rwmh" else (DRAWS // 2, 1)
    return br.sample(
        posterior, sampler, chains=CHAINS, draws=draws, seed=seed, thin=thin, block=draws, progress=False, **settings
    )


def settled(draws):
    """The draws of every chain, the first quarter left out."""
    return draws[:, draws.shape[1] // 4 :]


def draws_of(result):
    """(chain, draw, coordinate), settled."""
    draws = result.idata.posterior["u_boundary"]
    assert draws.dims == ("chain", "draw", "node", "axis")
    return settled(draws.values.reshape(*draws.shape[:2], -1))


def z_scores(per_chain, expected, expected_variance=0.0):
    """Of the mean over independent chains, its error estimated from their scatter: Student t, CHAINS − 1."""
    error = np.sqrt(per_chain.var(axis=0, ddof=1) / len(per_chain) + expected_variance)
    return (per_chain.mean(axis=0) - expected) / error


def assert_gaussian(draws, exact):
    """Mean and covariance of the draws are the exact ones within their Monte Carlo error.

    In coordinates whitened by the exact posterior: mean 0, covariance I. Single entries, and two statistics that
    collect small errors everywhere: the mean square of all z, and the trace.
    """
    whitened = np.linalg.cholesky(exact.precision).T @ (draws - exact.mean)[..., None]
    z_mean, z_second = whitened_scores(whitened[..., 0])
    assert abs(z_mean).max() < 5
    assert (z_mean**2).mean() == pytest.approx(1.0, abs=0.6)
    assert abs(z_second).max() < 6
    assert (z_second**2).mean() == pytest.approx(1.0, abs=0.3)
    trace = (whitened[..., 0] ** 2).mean(axis=(1, 2))
    assert abs(z_scores(trace, 1.0)) < 4.5
    # The chains are long enough for this to mean something: a shift of all means by a tenth of their standard
    # deviations, or a posterior wider by a twentieth, fails.
    assert whitened[..., 0].mean(axis=1).std(axis=0).max() / np.sqrt(CHAINS) < 0.12


def whitened_scores(y):
    """z of every mean and of every entry of the second moment (upper triangle)."""
    second = np.einsum("cdi,cdj->cij", y, y) / y.shape[1]
    rows, columns = np.triu_indices(y.shape[2])
    return z_scores(y.mean(axis=1), 0.0), z_scores(second[:, rows, columns], np.eye(y.shape[2])[rows, columns])


def test_density_is_the_gaussian():
    """No sampling: log p is quadratic, with the exact mean and precision."""
    posterior, _, exact = problem()

    def density(flat):
        return posterior.logdensity_constrained({"u_boundary": flat.reshape(-1, 3), "lam": LAM, "mu": MU})

    rng = np.random.default_rng(0)
    at_mean = float(density(exact.mean))
    for step in rng.normal(size=(5, len(exact.mean))):
        expected = -0.5 * step @ exact.precision @ step
        for sign in (-1, 1):
            difference = float(density(exact.mean + sign * step)) - at_mean
            assert difference == pytest.approx(expected, rel=1e-9)


@pytest.fixture(scope="module", params=["rwmh", "hmc", pytest.param("nuts", marks=pytest.mark.long), "laplace"])
def result(request):
    """Laplace's approximation of a Gaussian is the Gaussian. Where trajectories are long the skull is out of reach."""
    posterior = walled(FAR) if request.param in ("hmc", "nuts") else problem().posterior
    return run(posterior, request.param, seed=0, **({"sigma_u": 0.25} if request.param == "rwmh" else {}))


@pytest.mark.slow
class TestGaussianPosterior:
    def test_mean_and_covariance(self, result):
        assert_gaussian(draws_of(result), problem().exact)

    def test_mean_within_its_error_by_batch_means(self, result):
        """A second estimate of the Monte Carlo error, from the scatter of half chains."""
        draws, exact = draws_of(result), problem().exact
        batches = draws.reshape(CHAINS * 2, -1, draws.shape[2]).mean(axis=1)
        error = batches.std(axis=0, ddof=1) / np.sqrt(len(batches))
        assert abs((batches.mean(axis=0) - exact.mean) / error).max() < 5.5

    def test_acceptance_and_known_parameters(self, result):
        stats, posterior = result.idata.sample_stats, result.idata.posterior
        assert float(stats["acceptance_rate"].mean()) > 0.1
        assert not stats["solver_failed"].any()
        assert not stats["outside_support"].any()
        np.testing.assert_allclose(posterior["lam"], np.broadcast_to(LAM, posterior["lam"].shape), rtol=1e-12)
        np.testing.assert_allclose(posterior["mu"], np.broadcast_to(MU, posterior["mu"].shape), rtol=1e-12)

    def test_log_density_of_the_draws(self, result):
        """lp belongs to the draw beside it."""
        draws, lp = draws_of(result), settled(result.idata.sample_stats["lp"].values)
        exact = problem().exact
        distance = np.einsum("di,ij,dj->d", *(draws[0] - exact.mean,), exact.precision, draws[0] - exact.mean)
        offset = lp[0] + 0.5 * distance
        assert np.ptp(offset) < 1e-6 * np.ptp(lp[0])

    def test_displacement_at_every_node(self, result):
        """Moments accumulated while sampling are those of the extended draws, interior included."""
        _, oracle, _ = problem()
        extension = paper.extension(oracle.stiffness(LAM, MU), MESH.boundary)
        draws = result.idata.posterior["u_boundary"]
        every = draws.values.reshape(draws.sizes["chain"] * draws.sizes["draw"], -1) @ extension.T
        np.testing.assert_allclose(result.u_mean.ravel(), every.mean(axis=0), atol=1e-6)
        np.testing.assert_allclose(result.u_sd.ravel(), every.std(axis=0, ddof=1), rtol=1e-5)


@cache
def exact_draws(width: float) -> np.ndarray:
    """Brute force: draw from the Gaussian, and keep what the wall of this width, in voxels, lets pass."""
    exact, rng = problem().exact, np.random.default_rng(1)
    height = MESH.points[MESH.boundary, 0]
    accepted = []
    while sum(map(len, accepted)) < 20_000:
        draws = exact.draw(rng, 100_000)
        depth = np.maximum(height + draws[:, ::3] - WALL, 0.0)
        if width:
            passes = np.log(rng.uniform(size=len(draws))) < -0.5 * ((depth / (width * VOXEL)) ** 2).sum(axis=1)
        else:
            passes = (depth == 0).all(axis=1)
        accepted.append(draws[passes])
    return np.concatenate(accepted)


@pytest.fixture(
    scope="module",
    params=[pytest.param(("rwmh", 0.0, {"sigma_u": 0.22}), marks=pytest.mark.long), ("hmc", WIDTH, {})],
    ids=["rwmh", "hmc"],
)
def beside_wall(request):
    """The width of the wall, the sampler's draws, and exact ones."""
    sampler, width, settings = request.param
    return width, draws_of(run(walled(width=width), sampler, seed=1, **settings)), exact_draws(width)


@pytest.mark.slow
class TestPosteriorBesideAWall:
    """A flat skull one millimetre beyond a face of the box: some three in a hundred draws of the Gaussian avoid it."""

    LEVELS = np.array([0.05, 0.25, 0.5, 0.75, 0.95])

    def scores(self, draws, exact):
        """z of the means, and of the probabilities below the exact quantiles, for every coordinate."""
        below = np.stack([(draws < q).mean(axis=1) for q in np.quantile(exact, self.LEVELS, axis=0)], axis=-1)
        spread = (self.LEVELS * (1 - self.LEVELS)) / len(exact)
        mean = z_scores(draws.mean(axis=1), exact.mean(axis=0), exact.var(axis=0) / len(exact))
        return mean, z_scores(below, self.LEVELS, spread)

    def test_how_deep_draws_go(self, beside_wall):
        width, draws, _ = beside_wall
        deepest = (MESH.points[MESH.boundary, 0] + draws[..., ::3]).max() - WALL
        assert -0.05 < deepest < (5 * width * VOXEL if width else 0)
        assert (deepest > 0) == (width > 0)

    def test_marginals(self, beside_wall):
        mean, quantiles = self.scores(*beside_wall[1:])
        assert abs(mean).max() < 5
        assert (mean**2).mean() == pytest.approx(1.0, abs=0.6)
        assert abs(quantiles).max() < 6
        assert (quantiles**2).mean() == pytest.approx(1.0, abs=0.6)

    def test_the_wall_matters(self, beside_wall):
        """Against the Gaussian without the wall the same scores fail by far."""
        free = problem().exact.draw(np.random.default_rng(2), 20_000)
        mean, quantiles = self.scores(beside_wall[1], free)
        assert abs(mean).max() > 10
        assert abs(quantiles).max() > 10
