"""Local correlation against loops over windows."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from scipy import stats

import bayesreg as br
from bayesreg.model.observations.images.likelihood import ImageLikelihood
from bayesreg.model.observations.images.local_correlation import LEAST, RIDGE, windows_of
from bayesreg.model.observations.images.pointwise import Intensities
from bayesreg.pose import Pose
from bayesreg.workflow.prediction import mean_values, predict
from tests.model.test_gradients import assert_gradient
from tests.options import posterior_of
from tests.phantoms import LAM, MU, ball_mesh, smooth_image

MESH = ball_mesh(spacing=24.0)
OPTIONS = {"similarity": "lncc", "t_similarity": 5.0, "t_elastic": 100.0, "interpolation": "cubic", "window_mm": 20.0}
SQUARES = {name: value for name, value in OPTIONS.items() if name != "window_mm"} | {"similarity": "ssd"}
KNOWN = {name: dict(zip(MESH.names, x.tolist(), strict=True)) for name, x in (("lam", LAM), ("mu", MU))}


@cache
def images():
    return tuple(smooth_image(MESH.points, seed=seed) for seed in (1, 2))


def posterior(moving=None, **options):
    fixed, default_moving = images()
    return posterior_of(fixed, moving or default_moving, MESH, **(OPTIONS | options))


def values(seed=0, **temperatures):
    u = np.random.default_rng(seed).normal(size=(len(MESH.boundary), 3))
    return {"u_boundary": jnp.asarray(u), "lam": LAM, "mu": MU, **temperatures}


def compared(post, state):
    """f, the warped m and the weights at the quadrature points."""
    term = post.images
    return [np.asarray(x) for x in (term.fixed_values, term.predicted(post.evaluate(state).u), term.quadrature.weights)]


def fitted(post, state):
    """The map a, b of every point and the energy, by least squares in a loop over windows."""
    f, m, w = compared(post, state)
    windows, ridge = np.asarray(post.images.similarity.windows.label), float(post.images.similarity.ridge)
    gain, offset, energy = np.empty_like(f), np.empty_like(f), 0.0
    for window in np.unique(windows):
        inside = windows == window
        root = np.sqrt(w[inside])
        rows = np.column_stack([root * m[inside], root])
        rows = np.vstack([rows, [np.sqrt(w[inside].sum() * ridge), 0.0]])
        coefficients, squares, rank, _ = np.linalg.lstsq(rows, np.append(root * f[inside], 0.0), rcond=None)
        assert rank == 2
        gain[inside], offset[inside], energy = coefficients[0], coefficients[1], energy + squares[0]
    return gain, offset, energy


@pytest.mark.parametrize(
    "options",
    [{}, {"quadrature": "gauss32", "window_mm": 7.0}, {"quadrature": "voxels", "interpolation": "linear"}],
    ids=["gauss4", "gauss32", "voxels"],
)
def test_energy_and_residuals_are_those_of_fits_in_a_loop(options):
    post, state = posterior(**options), values()
    gain, offset, energy = fitted(post, state)
    f, m, _ = compared(post, state)
    assert post.images.similarity.windows.number > 3
    assert float(post.energies(state)["similarity_energy"]) == pytest.approx(energy, rel=1e-9)
    assert float(post.energies(state)["images"]) == pytest.approx(-energy / 5.0, rel=1e-9)
    residuals = post.images.residuals(post.evaluate(state).u)
    np.testing.assert_allclose(residuals, f - gain * m - offset, atol=1e-9)


def test_energy_is_what_the_correlations_leave_of_the_variance():
    post, state = posterior(), values()
    f, m, w = compared(post, state)
    windows, expected = np.asarray(post.images.similarity.windows.label), 0.0
    for window in np.unique(windows):
        inside = windows == window
        (of_f, of_both), (_, of_m) = np.cov(f[inside], m[inside], aweights=w[inside], ddof=0)
        expected += w[inside].sum() * of_f * (1 - of_both**2 / (of_f * of_m))
    assert float(post.energies(state)["similarity_energy"]) == pytest.approx(expected, rel=20 * RIDGE)
    squares = posterior_of(*images(), MESH, **SQUARES)
    assert expected < float(squares.energies(state)["similarity_energy"])


@pytest.mark.parametrize("width", [2.0, 9.0, 1000.0])
def test_windows_are_small_hold_enough_points_and_part_them(width):
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, (40, 25, 30), (3000, 3))
    windows = windows_of(positions, width)
    label = np.asarray(windows.label)
    sizes = np.bincount(label)
    assert len(sizes) == windows.number
    assert sizes.min() >= LEAST
    sides = np.array([np.ptp(positions[label == k], axis=0).max() for k in range(windows.number)])
    assert ((sides <= width) | (sizes < 2 * LEAST)).all()
    assert (windows.number == 1) == (width > 40)
    x = rng.normal(size=(3000, 2))
    np.testing.assert_allclose(windows.sums(x), np.stack([x[label == k].sum(axis=0) for k in label]), atol=1e-12)


@pytest.mark.parametrize(("gain", "offset"), [(2.0, 0.3), (-1.0, 0.0), (-300.0, 1e4)])
def test_affine_maps_of_the_moving_image_change_nothing(gain, offset):
    moving = images()[1]
    post, changed = posterior(), posterior(moving.with_voxels(gain * np.asarray(moving.voxels) + offset))

    def slope(post):
        return jax.value_and_grad(lambda u: post.logdensity_constrained({**values(), "u_boundary": u}))

    (height, gradient), (changed_height, changed_gradient) = (slope(p)(values()["u_boundary"]) for p in (post, changed))
    assert float(changed_height) == pytest.approx(float(height), rel=1e-8)
    np.testing.assert_allclose(changed_gradient, gradient, atol=1e-7 * float(abs(gradient).max()))


def test_a_smooth_bias_field_changes_little():
    """Half as bright again from one side to the other: a tenth of what it does to the squared differences."""
    _, moving = images()
    along = (moving.grid_points()[..., 0] - MESH.points[:, 0].min()) / np.ptp(MESH.points[:, 0])
    biased = moving.with_voxels(np.asarray(moving.voxels) * (1 + 0.5 * along))
    changes = {}
    for options in (SQUARES, OPTIONS | {"window_mm": 8.0}):
        # Where the images agree and nothing is left to explain.
        post = posterior_of(moving, biased, MESH, **(options | {"quadrature": "gauss32"}))
        changes[options["similarity"]] = float(post.energies(post.reference())["similarity_energy"])
    assert 0 < changes["lncc"] < 0.01 * changes["ssd"]


def test_gradient():
    prior = {"median": 5.0, "log_sd": 0.7}
    post = posterior(t_similarity=prior, fixed=KNOWN, independent_points=200.0, quadrature="gauss32", window_mm=8.0)
    assert_gradient(post.logdensity, post.unconstrain(values(t_similarity=jnp.asarray(3.0))))


def test_derivatives_of_the_energy_are_those_of_the_loop():
    """In f, m and the weights, and the second one in m, in which the maps follow m."""
    post = posterior()
    rng = np.random.default_rng(0)
    arrays = [jnp.asarray(x) for x in compared(post, values())]

    def energy(*intensities):
        return post.images.similarity.energy(Intensities(*intensities), jnp.asarray(5.0))

    slopes = jax.grad(energy, argnums=(0, 1, 2))
    for k, step in ((0, 1e-5), (1, 1e-5), (2, 1e-2)):
        d = jnp.asarray(rng.normal(size=len(arrays[0])))
        ahead, behind = ([p + sign * step * d * (j == k) for j, p in enumerate(arrays)] for sign in (1, -1))
        expected = float(energy(*ahead) - energy(*behind)) / (2 * step)
        assert float(slopes(*arrays)[k] @ d) == pytest.approx(expected, rel=1e-5)
        if k == 1:
            along = jax.jvp(lambda m: slopes(arrays[0], m, arrays[2])[1], (arrays[1],), (d,))[1]
            bend = (slopes(*ahead)[1] - slopes(*behind)[1]) / (2 * step)
            np.testing.assert_allclose(along, bend, atol=1e-4 * float(abs(bend).max()))


def test_curvature_in_the_displacements_is_the_hessian():
    """With its remainder, against differences of the gradient; Gauss and Newton's part is positive semidefinite."""
    post, state = posterior(fixed=KNOWN, quadrature="gauss32", rigid_sd=0.5), values()
    curvature = post.target.mode_search.curvature(post.data, {"u_boundary": state["u_boundary"]})
    slope = jax.jit(jax.grad(lambda u: -post.logdensity_constrained({**state, "u_boundary": u})))
    for direction in np.random.default_rng(1).normal(size=(3, *state["u_boundary"].shape)):
        ahead, behind = (slope(state["u_boundary"] + sign * 1e-4 * direction) for sign in (1, -1))
        expected = np.ravel(ahead - behind) / 2e-4
        product, rest = (matrix @ direction.ravel() for matrix in (curvature.gauss_newton, curvature.remainder))
        np.testing.assert_allclose(product + rest, expected, atol=1e-4 * abs(expected).max())
        assert abs(rest).max() > 0.01 * abs(product).max()
    assert np.linalg.eigvalsh(curvature.gauss_newton).min() > 0


def test_gauss_and_newtons_curvature_is_that_of_the_projected_residuals():
    """2 JᵀJ with J = a √w less what an affine map of m explains of it in the point's window, at any residual."""
    post, state = posterior(), values()
    f, m, w = compared(post, state)
    gain, _, _ = fitted(post, state)
    convexity = post.images.similarity.convexity(Intensities(*map(jnp.asarray, (f, m, w))), jnp.asarray(1.0))
    label, dense = np.asarray(post.images.similarity.windows.label), np.diag(np.asarray(convexity.diagonal))
    for vector, sign in zip(np.asarray(convexity.shared.vectors), np.asarray(convexity.shared.signs), strict=True):
        dense += sign * np.outer(vector, vector) * (label[:, None] == label)
    for window in np.unique(label):
        inside = label == window
        root = np.sqrt(w[inside])
        basis = np.linalg.qr(root[:, None] * np.column_stack([m[inside], np.ones(inside.sum())]))[0]
        J = (np.eye(len(root)) - basis @ basis.T) * (root * gain[inside])
        np.testing.assert_allclose(dense[np.ix_(inside, inside)], 2 * J.T @ J, atol=20 * RIDGE * abs(J.T @ J).max())
    assert np.linalg.eigvalsh(dense).min() > -1e-9


def test_the_normaliser_counts_two_degrees_of_freedom_of_each_window():
    """The likelihood is a Normal density of what no affine map of m in any window explains."""
    post = posterior(t_similarity={"median": 5.0})
    f, m, w = compared(post, values(t_similarity=5.0))
    label = np.asarray(post.images.similarity.windows.label)
    member = (label[:, None] == np.arange(label.max() + 1)).astype(float)
    maps = np.sqrt(w)[:, None] * np.hstack([member, member * m[:, None]])
    contrasts = np.linalg.svd(maps)[0][:, maps.shape[1] :]
    assert contrasts.shape[1] == len(f) - 2 * post.images.similarity.windows.number > 0
    z = contrasts.T @ (np.sqrt(w) * f)
    difference, expected = (
        np.diff([function(t) for t in (0.5, 6.0)])[0]
        for function in (
            lambda t: float(post.energies(values(t_similarity=t))["images"]),
            lambda t: stats.norm.logpdf(z, scale=np.sqrt(t / 2)).sum(),
        )
    )
    assert difference == pytest.approx(expected, rel=20 * RIDGE)


def test_replicates_have_the_maps_of_the_data_and_the_noise_of_the_model():
    post, state, count = posterior(), values(), 3000
    u, term = post.evaluate(state).u, post.images
    f, m, w = compared(post, state)
    draws = np.asarray(
        jax.vmap(lambda key: term.standardised_noise(key, u))(jax.random.split(jax.random.key(0), count))
    )
    explained = np.zeros((count, len(f)))
    leverage = np.zeros(len(f))
    label = np.asarray(term.similarity.windows.label)
    for window in np.unique(label):
        inside = label == window
        basis = np.linalg.qr(np.sqrt(w[inside])[:, None] * np.column_stack([m[inside], np.ones(inside.sum())]))[0]
        explained[:, inside] = draws[:, inside] @ basis @ basis.T
        leverage[inside] = (basis**2).sum(axis=1)
    assert abs(explained).max() < 0.05
    # χ² of one degree of freedom has the variance 2.
    assert abs((draws**2).mean(axis=0) / (1 - leverage) - 1).max() < 6 * np.sqrt(2 / count)
    assert float(term.similarity.variance()) == pytest.approx(1 - leverage.mean(), rel=1e-9)
    assert term.noise_sd(5.0) == pytest.approx(np.sqrt(5.0 * (1 - leverage.mean()) / (2 * w.mean())))
    likelihood = ImageLikelihood(term, term.compared(term.places(u)), jnp.asarray(5.0))
    image = likelihood.sample(jax.random.key(1), (200,)).mean(axis=0)
    gain, offset, _ = fitted(post, state)
    scale = np.sqrt(5.0 / (2 * w))
    assert abs((image - gain * m - offset) / scale).max() < 6 / np.sqrt(200)


def test_predictive_checks_hold_where_the_model_does():
    """Data drawn from the model with a map of its own in every window: no discrepancy is extreme."""
    post = posterior(t_similarity=0.05, quadrature="gauss32", fixed=KNOWN)
    term, rng, zero = post.images, np.random.default_rng(1), np.zeros_like(MESH.points)
    m, w, label = (
        np.asarray(x) for x in (term.predicted(zero), term.quadrature.weights, term.similarity.windows.label)
    )
    gain, offset = rng.normal(size=(2, label.max() + 1))
    f = gain[label] * m + offset[label] + np.sqrt(0.05 / (2 * w)) * rng.normal(size=len(m))
    shown = term._replace(fixed_values=jnp.asarray(f))
    post = replace(post, data=post.data.with_term("images", shown))
    dims = {"u_boundary": ["node", "axis"], "lam": ["tissue"], "mu": ["tissue"]}
    at_rest = {name: np.asarray(post.reference()[name]) for name in dims}
    draws = xr.Dataset(
        {n: (["chain", "draw", *dims[n]], np.broadcast_to(x, (2, 150, *x.shape))) for n, x in at_rest.items()}
    )
    places = {"here": tuple(MESH.points.mean(axis=0))}
    predicted = predict(post, draws, mean_values(post, draws, zero), zero, zero, places, 0, Pose.identity())
    observed, replicated = (predicted.observations[f"images/{which}"] for which in ("observed", "replicated"))
    for k, name in enumerate(("sd", "greatest", "neighbours")):
        assert 0.01 < (observed[..., k] <= replicated[..., k]).mean() < 0.99, name


def test_the_same_windows_serve_smoothed_images():
    post = posterior(quadrature="voxels", fixed=KNOWN)
    estimands = {"u_boundary": values()["u_boundary"]}
    for stage in post.target.mode_search.continuation():
        evaluation = post.target.evaluate_estimands(stage, estimands)
        assert 0 < float(evaluation.similarity_energy) < np.inf


def test_a_constant_moving_image_is_told():
    moving = images()[1]
    with pytest.raises(br.InputError, match="constant in the mesh"):
        posterior(moving.with_voxels(np.ones(moving.shape)))
