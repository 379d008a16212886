"""The mode and its curvature where both are known in closed form, and from far away."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy import stats
from scipy.optimize import lsq_linear, minimize_scalar

import bayesreg as br
from bayesreg.inference.gaussian.density import hessian_rows
from bayesreg.inference.gaussian.laplace import _add_convexly, laplace, precision_at, recentre
from bayesreg.inference.gaussian.mode_search import find_mode
from bayesreg.inference.layout import unravel
from bayesreg.inference.target import logdensity
from tests.inference.test_closed_form import GRADIENT, LAM, MESH, MU, OFFSET, OPTIONS, TEMPERATURES, problem
from tests.options import posterior_of
from tests.oracles import paper
from tests.phantoms import flat_skull, smooth_image


def test_a_gaussian_posterior_is_its_own_approximation():
    posterior, _, exact = problem()
    start = ravel_pytree(posterior.unconstrain(posterior.reference()))[0]
    mode = find_mode(posterior.target, np.asarray(start) + 0.5)
    reference = laplace(posterior.target, mode)
    sd = np.sqrt(np.diag(np.linalg.inv(exact.precision)))
    assert (abs(mode - exact.mean) / sd).max() < 0.02
    covariance = np.asarray(reference.factor @ reference.factor.T)
    np.testing.assert_allclose(covariance @ exact.precision, np.eye(len(mode)), atol=1e-6)


def test_an_inferred_temperature_lies_where_its_evidence_is_greatest():
    """Known in closed form at each T_r; the joint mode of T_r and the displacements lies next to T_r = 0."""
    gaussian_problem = problem()
    options = {**OPTIONS, "t_elastic": {"median": 20.0, "log_sd": 1.0}, "normalised": True}
    arrays = gaussian_problem.oracle.fixed, gaussian_problem.oracle.moving
    posterior = posterior_of(*(br.Image(*each) for each in arrays), MESH, **options)

    def minus_evidence(log_t):
        oracle = paper.Paper(
            MESH.points, MESH.cells, MESH.tissue, *arrays, MESH.boundary, **TEMPERATURES | {"t_elastic": np.exp(log_t)}
        )
        exact = paper.gaussian_posterior(oracle, LAM, MU, OFFSET, GRADIENT)
        place = {"t_elastic": jnp.asarray(log_t), "u_boundary": jnp.asarray(exact.mean.reshape(-1, 3))}
        return 0.5 * np.linalg.slogdet(exact.precision)[1] - float(posterior.logdensity(place))

    best = minimize_scalar(minus_evidence, bounds=(-3, 8), method="bounded", options={"xatol": 1e-3}).x
    mode = find_mode(posterior.target, np.asarray(ravel_pytree(posterior.unconstrain(posterior.reference()))[0]))
    assert abs(best - np.log(20.0)) > 0.1
    assert unravel(posterior.target)(mode)["t_elastic"] == pytest.approx(best, abs=0.01)
    factor, step = np.asarray(laplace(posterior.target, mode).factor), 0.1
    curvature = sum(way * minus_evidence(best + offset * step) for offset, way in ((-1, 1), (0, -2), (1, 1))) / step**2
    assert 1 / (factor[0] @ factor[0]) == pytest.approx(curvature, rel=0.03)
    assert curvature > 1.5


def test_the_mode_at_a_wall_is_that_of_the_quadratic_program():
    """A wall of a hundredth of a voxel: nodes that the Gaussian presses on it rest there, and others follow."""
    gaussian_problem, wall = problem(), float(MESH.points[:, 0].max()) + 0.1
    exact, skull = gaussian_problem.exact, flat_skull(MESH.points, axis=0, wall=wall, voxel=2.0)
    images = (br.Image(*arrays) for arrays in (gaussian_problem.oracle.fixed, gaussian_problem.oracle.moving))
    posterior = posterior_of(*images, MESH, skull, **OPTIONS, skull_width=1e-2)
    mode = find_mode(posterior.target, np.asarray(ravel_pytree(posterior.unconstrain(posterior.reference()))[0]))
    root = np.linalg.cholesky(exact.precision).T
    highest = np.full(len(mode), np.inf)
    highest[::3] = wall - MESH.points[posterior.sampled][:, 0]
    expected = lsq_linear(root, root @ exact.mean, (-np.inf, highest), tol=1e-12).x
    assert abs(mode - expected).max() < 2e-3 < 0.1 < abs(mode - exact.mean).max()


def test_a_gaussian_is_found_from_beside_it():
    """One Newton step from a place where the force is not zero gives the mean."""
    exact = problem().exact
    place = exact.mean + np.tile([3.0, 0, 0], len(exact.mean) // 3)
    centre = np.asarray(
        recentre(problem().posterior.target, laplace(problem().posterior.target, place), [place]).centre
    )
    sd = np.sqrt(np.diag(np.linalg.inv(exact.precision)))
    assert (abs(centre - exact.mean) / sd).max() < 0.02 < (abs(place - exact.mean) / sd).max()


@pytest.mark.slow
def test_curvature_of_parameters_is_the_hessian():
    images = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    prior = br.PriorConfig(alpha=2.0, beta=2.0, low=0.1, high=5.0)
    options = {"interpolation": "cubic", "t_elastic": 30.0, "rigid_sd": 1.0}
    posterior = posterior_of(*images, MESH, priors={"lam": prior, "mu": prior}, **options)
    flat = np.asarray(ravel_pytree(posterior.initial(jax.random.key(0)))[0])
    reference = laplace(posterior.target, flat)
    precision = np.linalg.inv(np.asarray(reference.factor @ reference.factor.T))

    slope = jax.grad(lambda x: -logdensity(posterior.target, posterior.data, unravel(posterior.target)(x)))
    hessian_row = jax.jit(lambda direction: jax.jvp(slope, (jnp.asarray(flat),), (direction,))[1])
    count = len(flat) - 3 * len(posterior.sampled)
    for k, direction in enumerate(np.eye(len(flat))[:count]):
        row = np.asarray(hessian_row(direction))
        np.testing.assert_allclose(precision[k, count:], row[count:], rtol=1e-4, atol=1e-5 * abs(row).max())


def test_a_curvature_with_its_remainder_is_made_convex():
    """The sum itself where it is convex; along one direction it is not, and there its size counts."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 4))
    convex = root @ root.T + np.eye(4)
    for size, expected in ((0.5, 1.5), (-0.5, 0.5), (-0.9, 0.25), (-3.0, 2.0), (6.0, 7.0)):
        lower = np.linalg.cholesky(convex)
        first = np.outer(lower[:, 0], lower[:, 0])
        np.testing.assert_allclose(_add_convexly(convex, size * first), convex + (expected - 1) * first, atol=1e-12)


def test_parameters_that_nothing_is_known_of_have_the_prior_s_width():
    """No contrast and no deformation: uniform up to `high` is N(0, 1) in their scores."""
    flat = smooth_image(MESH.points, seed=1)
    flat = flat.with_voxels(np.zeros(flat.shape))
    posterior = posterior_of(flat, flat, MESH, priors={"lam": {"high": 20.0}, "mu": {"high": 5.0}}, rigid_sd=1.0)
    position = {**posterior.unconstrain(posterior.reference()), "lam": jnp.array([-1.0, 0.0, 2.0])}
    flat = np.asarray(ravel_pytree(position)[0])
    precision = precision_at(posterior.target, flat)
    count = len(precision) - 3 * len(posterior.sampled)
    assert count == 5
    np.testing.assert_allclose(precision[:count], np.eye(len(precision))[:count], atol=1e-6)
    rows = hessian_rows(posterior.target, posterior.data, flat, np.arange(count))
    np.testing.assert_allclose(rows, -np.eye(len(flat))[:count], atol=1e-6)


def smooth_posterior():
    images = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    return posterior_of(*images, MESH, interpolation="cubic", rigid_sd=1.0)


@pytest.mark.parametrize("above", [0.1, 1.0, 20.0, 300.0])
def test_a_parameter_far_above_its_scale_is_as_wide_as_its_logarithm(above):
    """exp(z − e^z) has the variance π²/6: whatever the unit, the reference is not much narrower."""
    posterior = smooth_posterior()
    x = stats.expon.ppf((np.arange(4000) + 0.5) / 4000, scale=10.0 * above)
    z = np.asarray(posterior.data.blocks["lam"].unconstrain(jnp.asarray(x)[:, None] * jnp.array([0.0, 1.0, 0.0])))[:, 1]
    position = posterior.unconstrain(posterior.reference())
    median_position = {**position, "lam": position["lam"].at[1].set(np.median(z))}
    least = posterior.target.coordinates.least_curvature(posterior.data, median_position)["lam"][1]
    assert 0.5 < z.std() * np.sqrt(least) < 1.5


def test_a_parameter_that_runs_away_is_told():
    posterior = smooth_posterior()
    away = posterior.unconstrain(posterior.reference() | {"lam": jnp.array([0.01, 1e13, 10.0])})
    with pytest.raises(br.InputError, match="λ, μ or a temperature runs away"):
        precision_at(posterior.target, np.asarray(ravel_pytree(away)[0]))


def test_a_search_without_an_end_is_told():
    """Without contrast, and flat priors without bound, λ and μ grow for ever."""
    flat = smooth_image(MESH.points, seed=1)
    flat = flat.with_voxels(np.zeros(flat.shape))
    posterior = posterior_of(flat, flat, MESH, rigid_sd=1.0)
    start = np.asarray(ravel_pytree(posterior.unconstrain(posterior.reference()))[0])
    with pytest.raises(br.InputError, match="runs away"):
        find_mode(posterior.target, start)
