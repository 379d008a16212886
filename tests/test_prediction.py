"""What is computed of the draws at the end of a run, against plain loops over them."""

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest
import xarray as xr
from scipy import stats

import bayesreg as br
from bayesreg.model.observations.images.discrepancies import DISCREPANCIES, discrepancies
from bayesreg.model.observations.images.report import predictive_p
from bayesreg.pose import Pose
from bayesreg.workflow.prediction import default_places, mean_values, predict, require_inside
from tests.options import posterior_of
from tests.phantoms import box_mesh, smooth_image

MESH = box_mesh(3)
REST = Pose.identity()
PLACES = {"corner": tuple(MESH.points[0]), "within": (9.0, 11.0, 8.0)}


@cache
def problem() -> tuple[br.Posterior, xr.Dataset, np.ndarray]:
    """A posterior whose fixed image is the moving one, moved and with the noise of the model; draws near the truth."""
    rng = np.random.default_rng(0)
    moving = smooth_image(MESH.points, seed=2, blur=3.0)
    posterior = posterior_of(moving, moving, MESH, t_similarity=0.05)
    images = posterior.images
    truth = {
        name: np.array(value) for name, value in posterior.reference().items() if name in ("u_boundary", "lam", "mu")
    }
    truth["u_boundary"] += 0.5 * np.sin(MESH.points[posterior.sampled] / 6)
    u = np.asarray(posterior.evaluate(truth).u)
    weights = np.asarray(images.quadrature.weights)
    noise = np.sqrt(0.05 / (2 * weights)) * rng.normal(size=len(weights))
    shown = images.fixed_values - posterior.images.residuals(u) + noise
    posterior = replace(posterior, data=posterior.data.with_term("images", images._replace(fixed_values=shown)))
    draws = {name: np.broadcast_to(value, (3, 12, *value.shape)) for name, value in truth.items()}
    draws["u_boundary"] = draws["u_boundary"] + 0.02 * rng.normal(size=draws["u_boundary"].shape)
    draws["u_boundary"][2, :6] += 2.5
    dims = {"u_boundary": ["node", "axis"], "lam": ["tissue"], "mu": ["tissue"]}
    dataset = xr.Dataset({name: (["chain", "draw", *dims[name]], values) for name, values in draws.items()})
    return posterior, dataset, u


@cache
def everywhere() -> np.ndarray:
    """u of every node, (chain, draw, n, 3), one draw at a time."""
    posterior, draws, _ = problem()
    single_draws = [[draws.isel(chain=c, draw=d) for d in range(12)] for c in range(3)]
    return np.array([[posterior.evaluate({n: x[n].to_numpy() for n in x}).u for x in chain] for chain in single_draws])


@cache
def predicted():
    posterior, draws, _ = problem()
    mean, sd = everywhere().mean(axis=(0, 1)), everywhere().std(axis=(0, 1))
    return predict(posterior, draws, mean_values(posterior, draws, mean), mean, sd, PLACES, seed=1, pose=REST)


def test_maps_are_those_of_all_draws():
    u, prediction = everywhere(), predicted()
    distance = np.linalg.norm(u - u.mean(axis=(0, 1)), axis=-1)
    np.testing.assert_allclose(prediction.chain_mean, u.mean(axis=1), atol=1e-6)
    np.testing.assert_allclose(prediction.far, (distance > 2).mean(axis=(0, 1)))
    np.testing.assert_allclose(prediction.reach, np.quantile(distance, 0.95, axis=(0, 1)), atol=1e-6)
    assert prediction.far.min() > 0.1


def test_places_move_as_the_mesh_does():
    prediction = predicted()
    np.testing.assert_allclose(prediction.place_draws[:, :, 0], everywhere()[:, :, 0], atol=1e-6)
    # The mesh as a function: any other way to interpolate on tetrahedra, here by volumes.
    place = np.array(PLACES["within"])
    shares = np.array([_shares(MESH.points[cell], place) for cell in MESH.cells])
    holding = int(np.argmax(shares.min(axis=1)))
    expected = np.einsum("a,cdai->cdi", shares[holding], everywhere()[:, :, MESH.cells[holding]])
    np.testing.assert_allclose(prediction.place_draws[:, :, 1], expected, atol=1e-6)
    assert list(prediction.place_names) == ["corner", "within"]


def _shares(corners: np.ndarray, place: np.ndarray) -> np.ndarray:
    volume = np.linalg.det(corners[1:] - corners[0])
    shares = []
    for k in range(4):
        moved = corners.copy()
        moved[k] = place
        shares.append(np.linalg.det(moved[1:] - moved[0]) / volume)
    return np.array(shares)


def test_noise_of_the_model_passes_the_checks():
    prediction = predicted()
    near = prediction.observations["images/observed"][:2], prediction.observations["images/replicated"][:2]
    for k in range(len(DISCREPANCIES)):
        assert 0.02 < predictive_p(near[0][..., k], near[1][..., k]) < 0.98, DISCREPANCIES[k]


def test_a_wrong_displacement_fails_them():
    prediction = predicted()
    wrong = prediction.observations["images/observed"][2, :6], prediction.observations["images/replicated"][2, :6]
    assert [predictive_p(wrong[0][..., k], wrong[1][..., k]) for k in (0, 2)] == [0.0, 0.0]


def test_replications_differ_between_draws_and_follow_the_seed():
    posterior, draws, _ = problem()
    prediction = predicted()
    assert len(np.unique(prediction.observations["images/replicated"][..., 0])) == 36
    mean = everywhere().mean(axis=(0, 1))
    again = predict(
        posterior,
        draws,
        mean_values(posterior, draws, mean),
        mean,
        np.zeros_like(mean),
        {},
        seed=1,
        pose=REST,
    )
    np.testing.assert_array_equal(again.observations["images/replicated"], prediction.observations["images/replicated"])


def test_the_residual_at_the_truth_is_standard_normal():
    posterior, _, u = problem()
    z = np.asarray(posterior.images.scaled_residual(u, {"t_similarity": np.array(0.05)}))
    assert z.std() == pytest.approx(1, abs=4 / np.sqrt(2 * len(z)))
    np.testing.assert_allclose(posterior.images.scaled_residual(u, {"t_similarity": np.array(0.2)}), z / 2, rtol=1e-12)


def test_a_sampled_temperature_sets_the_unit_of_its_draw():
    posterior, draws, _ = problem()
    posterior = _Heated(**vars(posterior))
    heated = draws.assign(t_similarity=(("chain", "draw"), np.full((3, 12), 0.2)))
    mean = everywhere().mean(axis=(0, 1))
    prediction = predict(posterior, heated, mean_values(posterior, heated, mean), mean, mean, PLACES, seed=1, pose=REST)
    np.testing.assert_allclose(
        prediction.observations["images/observed"][..., :2],
        predicted().observations["images/observed"][..., :2] / 2,
        rtol=1e-6,
    )
    np.testing.assert_allclose(
        prediction.observations["images/residual"], predicted().observations["images/residual"] / 2, rtol=1e-5
    )


class _Heated(br.Posterior):
    """A posterior in which T_s is sampled too, as far as `predict` can see."""

    def reference(self):
        return {**super().reference(), "t_similarity": np.array(0.05)}

    def evaluate(self, values):
        return super().evaluate({name: value for name, value in values.items() if name != "t_similarity"})


def test_discrepancies_are_those_of_a_plain_loop():
    rng = np.random.default_rng(3)
    cells = np.sort(rng.integers(0, len(MESH.cells), 3 * len(MESH.cells)))
    z = rng.normal(size=len(cells)) + 0.5 * np.sin(MESH.points[MESH.cells].mean(axis=1)[cells, 0])
    sums = {c: z[cells == c].sum() / np.sqrt((cells == c).sum()) for c in np.unique(cells)}
    pairs = [
        (sums[a], sums[b])
        for a in range(len(MESH.cells))
        for b in range(a)
        if len(set(MESH.cells[a]) & set(MESH.cells[b])) == 3 and a in sums and b in sums
    ]
    first, second = np.array(pairs).T
    expected = [np.sqrt(np.mean(z**2)), max(abs(z)), (first * second).sum() / ((first**2 + second**2) / 2).sum()]
    np.testing.assert_allclose(discrepancies(z, cells, MESH.neighbours, len(MESH.cells)), expected, rtol=1e-10)


def test_a_place_outside_the_mesh_is_refused():
    with pytest.raises(br.InputError, match=r"place 'far' at \[99.0, 0.0, 0.0\] mm lies outside the mesh"):
        require_inside(MESH, PLACES | {"far": (99.0, 0.0, 0.0)})
    require_inside(MESH, PLACES)
    require_inside(MESH, {})


def test_chosen_places_are_where_their_names_say():
    rng = np.random.default_rng(4)
    u_mean, u_sd = rng.normal(size=(2, len(MESH.points), 3))
    u_mean[7], u_sd[9] = 50, 50
    places = default_places(MESH, u_mean, u_sd)
    assert places["largest shift"] == tuple(MESH.points[7])
    assert places["largest sd"] == tuple(MESH.points[9])
    low, high = MESH.points.min(axis=0), MESH.points.max(axis=0)
    depth = np.minimum(MESH.points - low, high - MESH.points).min(axis=1)
    place = np.array(places["deepest point"])
    assert np.minimum(place - low, high - place).min() > 0.7 * depth.max()
    require_inside(MESH, places)
    assert [name for name in places if name.startswith("middle")] == ["middle of CSF", "middle of GM", "middle of WM"]


@pytest.mark.long
def test_replicates_follow_students_t_where_the_model_does():
    """The data are drawn from the model: no discrepancy is extreme, as all were with Normal replicates."""
    rng, nu = np.random.default_rng(1), 3.0
    moving = smooth_image(MESH.points, seed=2, blur=3.0)
    options = {"t_similarity": 0.05, "similarity": "student_t", "degrees_of_freedom": nu, "quadrature": "gauss32"}
    posterior = posterior_of(moving, moving, MESH, **options)
    images = posterior.images
    noise = np.sqrt(0.05 / (2 * np.asarray(images.quadrature.weights))) * rng.standard_t(nu, len(images.fixed_values))
    shown = images._replace(fixed_values=images.fixed_values + noise)
    posterior = replace(posterior, data=posterior.data.with_term("images", shown))
    at_rest = {name: np.asarray(posterior.reference()[name]) for name in ("u_boundary", "lam", "mu")}
    dims = {"u_boundary": ["node", "axis"], "lam": ["tissue"], "mu": ["tissue"]}
    draws = xr.Dataset(
        {n: (["chain", "draw", *dims[n]], np.broadcast_to(x, (2, 150, *x.shape))) for n, x in at_rest.items()}
    )
    zero = np.zeros_like(MESH.points)
    prediction = predict(posterior, draws, mean_values(posterior, draws, zero), zero, zero, PLACES, seed=0, pose=REST)
    checked = prediction.of_observation("images")
    for k, name in enumerate(DISCREPANCIES):
        assert 0.01 < predictive_p(checked["observed"][..., k], checked["replicated"][..., k]) < 0.99, name


@pytest.mark.parametrize(
    ("similarity", "distribution"), [("ssd", stats.norm()), ("student_t", stats.t(4.0))], ids=["ssd", "student_t"]
)
def test_replicated_noise_has_the_distribution_of_the_likelihood(similarity, distribution):
    image = smooth_image(MESH.points, seed=2)
    options = {"t_similarity": 0.05, "similarity": similarity, "quadrature": "gauss32"}
    posterior = posterior_of(image, image, MESH, **options)
    noise = posterior.images.standardised_noise(jax.random.key(0), np.zeros_like(MESH.points))
    assert stats.kstest(np.asarray(noise), distribution.cdf).pvalue > 1e-3
