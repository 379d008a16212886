"""The Gibbs sampler and its marginal posterior, against dense algebra and other samplers."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

import bayesreg as br
from bayesreg.fem.elasticity import stiffness
from bayesreg.inference.samplers.registry import choose_sampler
from bayesreg.model.marginal import Marginal
from bayesreg.model.observations.left_out import predict_at_draws
from bayesreg.model.observations.point_noise import NormalNoise, StudentTNoise
from bayesreg.model.point_algebra import algebra_of
from bayesreg.model.state import state_of
from tests.phantoms import box_mesh

BOX = box_mesh(2)
MESH = br.TetMesh.from_arrays(BOX.points, BOX.cells, np.zeros(len(BOX.cells), int), ("organ",))
RNG = np.random.default_rng(3)
FIXED = RNG.uniform(2, 18, (9, 3))
# One point is wrong, and one lies outside the mesh.
FIXED[0, 0] = -1.0
MOVING = FIXED * np.array([0.95, 1.0, 1.05]) + RNG.normal(0.5, 0.4, FIXED.shape)
MOVING[3] += 6.0
FIXED_STIFFNESS = {"mu": {"organ": 1.0}, "lam": {"organ": 1.0}}
SCALES = {"body_load": 0.05, "surface_load": 0.2, "landmarks_sd": 0.6}


@cache
def posterior(noise=None, sd=None, least_volume=0.0, known_loads=False, known_lam=None) -> br.Posterior:
    loads = br.RandomLoads(body=0.5, surface=0.2) if known_loads else br.RandomLoads()
    fixed = {"mu": {"organ": 1.0}} | ({} if known_lam is None else {"lam": {"organ": known_lam}})
    model = br.ModelConfig(preset="registration", elastic_prior=loads, least_volume=least_volume, fixed=fixed)
    points = br.Landmarks(FIXED, MOVING, sd or br.ScalePrior(median=1.0), noise=noise or StudentTNoise())
    return br.build_posterior(MESH, [points], model)


def marginal_of(posterior: br.Posterior) -> Marginal:
    return posterior.target.prepare_marginal()


def estimands(u=None, **changed) -> dict:
    values = {**SCALES, "lam": np.array([3.0]), "u_boundary": np.zeros(MESH.points.shape) if u is None else u}
    return {name: jnp.asarray(value) for name, value in (values | changed).items()}


def dense_conditional(posterior: br.Posterior, given: dict, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the precision and the mean of u given all else, from matrices in the nodes."""
    term, elastic = posterior.data.terms["landmarks"], posterior.data.terms["elastic"]
    ones = np.ones(len(MESH.cells))
    K = stiffness(MESH, float(given["lam"][0]) * ones, ones).toarray()
    variances = np.repeat(np.asarray(elastic.variances(given)), 3)
    B = np.zeros((3 * len(FIXED), MESH.points.size))
    for k, (nodes, shares) in enumerate(zip(np.asarray(term.nodes), np.asarray(term.weights), strict=True)):
        for node, share in zip(nodes, shares, strict=True):
            B[3 * k : 3 * k + 3, 3 * node : 3 * node + 3] += share * np.eye(3)
    precisions = (weights[:, None] / np.asarray(term.sd(given)) ** 2).ravel()
    precision = K @ (K / variances[:, None]) + B.T @ (precisions[:, None] * B)
    return precision, np.linalg.solve(precision, B.T @ (precisions * np.asarray(term.shift).ravel()))


def test_the_marginal_density_is_the_joint_one_with_u_integrated_out():
    """Laplace's integral, which is exact for Normal errors, of the density of the posterior itself."""
    own = posterior(NormalNoise())
    marginal, ones = marginal_of(own), np.ones(len(FIXED))
    differences = []
    by_lam = [{"lam": np.array([lam])} for lam in (1e-6, 0.01, 0.4, 12.0, 99.9, 2000.0)]
    for changed in (*by_lam, {"body_load": 1.0}, {"landmarks_sd": 0.2, "body_load": 1.0}, {"surface_load": 2.0}):
        given = estimands(**changed)
        precision, mean = dense_conditional(own, given, ones)
        joint = own.logdensity_constrained({**given, "u_boundary": mean.reshape(-1, 3), "mu": np.ones(1)})
        integral = float(joint) - np.linalg.slogdet(precision)[1] / 2
        differences.append(float(marginal.log(given, jnp.asarray(ones))) - integral)
    np.testing.assert_allclose(differences, differences[0], atol=1e-5)


def test_displacements_are_drawn_from_their_conditional():
    own, weights = posterior(NormalNoise()), np.linspace(0.3, 2.0, len(FIXED))
    precision, mean = dense_conditional(own, estimands(), weights)
    marginal = marginal_of(own)
    draw = jax.jit(jax.vmap(lambda key: marginal.draw_displacements(key, estimands(), jnp.asarray(weights))))
    draws = np.asarray(draw(jax.random.split(jax.random.key(1), 4000))).reshape(4000, -1)
    whitened = (draws - mean) @ np.linalg.cholesky(precision)
    assert np.abs(whitened.mean(axis=0)).max() < 5 / np.sqrt(4000)
    covariance = np.cov(whitened, rowvar=False)
    assert np.abs(np.diag(covariance) - 1).max() < 6 * np.sqrt(2 / 4000)
    assert np.abs(covariance - np.diag(np.diag(covariance))).max() < 6 / np.sqrt(4000)


def interpolation_of(own: br.Posterior) -> np.ndarray:
    """Return the rows of every point, (k, 3, unknowns)."""
    unit = jnp.eye(MESH.points.size).reshape(-1, 3, MESH.points.size)
    return np.asarray(own.data.terms["landmarks"].interpolate(unit))


def test_each_left_out_point_is_predicted_by_the_others():
    """From matrices in the nodes, in which the point has no weight."""
    own = posterior(NormalNoise())
    term, every = own.data.terms["landmarks"], [estimands(), estimands(body_load=1.0, landmarks_sd=0.1, lam=[40.0])]
    draws = {name: np.stack([given[name] for given in every]) for name in every[0]} | {"mu": np.ones((2, 1))}
    predictions = predict_at_draws(marginal_of(own), term, draws)
    for s, given in enumerate(every):
        np.testing.assert_allclose(predictions.sd[s], term.sd(given))
        for k, rows in enumerate(interpolation_of(own)):
            precision, mean = dense_conditional(own, given, (np.arange(len(FIXED)) != k).astype(float))
            residual, covariance = np.asarray(term.shift)[k] - rows @ mean, rows @ np.linalg.solve(precision, rows.T)
            np.testing.assert_allclose(predictions.residual[s, k], residual, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(predictions.covariance[s, k], covariance, rtol=1e-5, atol=1e-6)


def test_weighted_draws_have_not_seen_the_landmark():
    """Against quadratures of the density of an unknown sd, of all points and of all points but one."""
    moving = MOVING.copy()
    moving[3] -= 6.0

    def posterior_of(points: np.ndarray) -> br.Posterior:
        loads = br.RandomLoads(body=0.05, surface=0.2)
        model = br.ModelConfig(preset="registration", elastic_prior=loads, least_volume=0.0, fixed=FIXED_STIFFNESS)
        landmarks = br.Landmarks(FIXED[points], moving[points], br.ScalePrior(median=1.0), noise=NormalNoise())
        return br.build_posterior(MESH, [landmarks], model)

    sd, everything = jnp.exp(jnp.linspace(-4.0, 3.0, 1401)), np.arange(len(FIXED))
    nodes = jnp.zeros((len(sd), *MESH.points.shape))

    def shares_of(own: br.Posterior) -> np.ndarray:
        """Return the posterior probability of every sd."""
        marginal, ones = marginal_of(own), jnp.ones(len(own.observations["landmarks"].labels))
        log = jax.vmap(lambda sd: marginal.log({"landmarks_sd": sd, "u_boundary": nodes[0]}, ones))(sd) + jnp.log(sd)
        return np.exp(log - log.max()) / np.exp(log - log.max()).sum()

    whole = posterior_of(everything)
    draws = {"landmarks_sd": sd, "u_boundary": nodes, **{name: np.ones((len(sd), 1)) for name in ("lam", "mu")}}
    draws |= {name: np.full(len(sd), size) for name, size in (("body_load", 0.05), ("surface_load", 0.2))}
    predictions = predict_at_draws(marginal_of(whole), whole.data.terms["landmarks"], draws)
    weighted = shares_of(whole)[:, None] * predictions.weights
    for k in (0, 4, 8):
        expected = shares_of(posterior_of(everything[everything != k]))
        np.testing.assert_allclose(weighted[:, k] / weighted[:, k].sum(), expected, atol=1e-6)


def test_a_surface_that_tells_nothing_leaves_the_predictions_of_points_as_they_are():
    model = br.ModelConfig(preset="registration", least_volume=0.0, fixed={"mu": {"organ": 1.0}})
    points = br.Landmarks(FIXED, MOVING, br.ScalePrior(median=1.0), noise=NormalNoise())
    top = np.c_[np.random.default_rng(3).uniform(5, 15, (30, 2)), np.full(30, 20.0)]
    surface = br.Surface(top, sd=1e4, noise=NormalNoise())
    draws = {name: np.asarray(value)[None] for name, value in estimands().items()} | {"mu": np.ones((1, 1))}
    alone, beside = (
        predict_at_draws(marginal_of(own), own.data.terms["landmarks"], draws)
        for own in (posterior(NormalNoise()), br.build_posterior(MESH, [points, surface], model))
    )
    for expected, predicted in zip(alone, beside, strict=True):
        np.testing.assert_allclose(predicted, expected, rtol=1e-4, atol=1e-5)


def test_weights_of_the_others_stay_when_a_point_is_left_out():
    own, weights = posterior(), np.linspace(0.1, 2.0, len(FIXED))
    marginal, shift = marginal_of(own), np.asarray(own.data.terms["landmarks"].shift)
    given = (np.asarray(array)[None] for array in marginal.given({**estimands(), "mu": np.ones(1)}, weights))
    (pulls,), (information,) = algebra_of(marginal.number).leave_out(*given)
    for k, rows in enumerate(interpolation_of(own)):
        precision, mean = dense_conditional(own, estimands(), np.where(np.arange(len(FIXED)) == k, 0.0, weights))
        variance = np.diag(np.asarray(own.data.terms["landmarks"].sd(estimands()))[k] ** 2 / weights[k])
        np.testing.assert_allclose(np.linalg.solve(information[k], pulls[k]), shift[k] - rows @ mean, atol=1e-5)
        expected = rows @ np.linalg.solve(precision, rows.T) + variance
        np.testing.assert_allclose(np.linalg.inv(information[k]), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.long
def test_lam_has_the_posterior_of_a_quadrature():
    own, ones = posterior(NormalNoise(), sd=0.5, known_loads=True), jnp.ones(len(FIXED))
    marginal, u = marginal_of(own), estimands()["u_boundary"]
    lam = np.linspace(1e-3, 400.0, 4001)
    log = jax.jit(jax.vmap(lambda lam: marginal.log({"lam": lam[None], "u_boundary": u}, ones)))
    density = np.asarray(log(jnp.asarray(lam)))
    cumulative = integrate.cumulative_trapezoid(np.exp(density - density.max()), lam, initial=0)
    draws = np.asarray(br.sample(own, draws=600, seed=4, progress=False).idata.posterior["lam"]).ravel()
    position = np.interp(draws, lam, cumulative / cumulative[-1])
    # Draws are correlated; every fifth is as good as independent.
    assert stats.kstest(position[::5], "uniform").pvalue > 0.001


@pytest.mark.long
def test_it_agrees_with_hamiltonian_trajectories_before_a_barrier():
    """With few hyperparameters; where loads are inferred, trajectories need many more draws."""
    own, moments = posterior(least_volume=0.95, known_loads=True, known_lam=3.0), []
    for name in ("gibbs", "hmc"):
        samples = br.sample(own, name, draws=300, seed=6, progress=False)
        draws, ess = samples.idata.posterior, samples.convergence.ess_bulk
        values = np.c_[np.log(draws["landmarks_sd"]).values.ravel(), draws["u_boundary"].values.reshape(1200, -1)]
        sizes = np.r_[float(ess["landmarks_sd"]), np.ravel(ess["u_boundary"])]
        moments.append((values.mean(axis=0), values.std(axis=0), sizes))
        if name == "gibbs":
            assert (samples.tally.acceptance < samples.tally.steps).all()
    (mean, sd, ess), (other_mean, other_sd, other_ess) = moments
    z = (mean - other_mean) / np.hypot(sd / np.sqrt(ess), other_sd / np.sqrt(other_ess))
    assert np.abs(z).max() < 4.5
    assert np.abs(np.log(sd / other_sd)).max() < 4 / np.sqrt(min(ess.min(), other_ess.min()))


def test_the_default_is_gibbs_where_it_can_be():
    assert choose_sampler("auto", posterior().target).name == "gibbs"
    two_tissues = br.TetMesh.from_arrays(MESH.points, MESH.cells, np.arange(len(MESH.cells)) % 2, ("a", "b"))
    points = br.Landmarks(FIXED, MOVING, 1.0)
    other = br.build_posterior(two_tissues, [points], br.ModelConfig(preset="registration"))
    assert choose_sampler("auto", other.target).name == "hmc"
    assert choose_sampler("gibbs", other.target).name == "gibbs"
    by_element = br.ModelConfig(preset="registration", elasticity="element")
    with pytest.raises(br.InputError, match="points and surfaces alone"):
        choose_sampler("gibbs", br.build_posterior(MESH, [points], by_element).target)


def test_the_same_seed_gives_the_same_draws_in_any_blocks():
    whole, parts = (br.sample(posterior(), draws=20, seed=2, block=block, progress=False) for block in (20, 7))
    for name in ("lam", "u_boundary"):
        np.testing.assert_array_equal(*(np.asarray(samples.idata.posterior[name]) for samples in (whole, parts)))


def test_an_outlier_of_40_mm_is_named_and_moves_nothing_else():
    fixed = np.random.default_rng(5).uniform(1, 19, (30, 3))
    shift = 0.05 * (fixed - 10) + np.random.default_rng(6).normal(0, 0.1, fixed.shape)
    outlier = np.zeros_like(fixed)
    outlier[7, 0] = 40.0
    means = []
    for moving in (fixed + shift, fixed + shift + outlier):
        points = br.Landmarks(fixed, moving, br.ScalePrior(median=1.0, log_sd=2.0))
        own = br.build_posterior(MESH, [points], br.ModelConfig(preset="registration"))
        draws = br.sample(own, chains=2, draws=100, seed=1, progress=False).idata.posterior
        mean = {name: draws[name].mean(("chain", "draw")).values for name in own.reference()}
        observation = own.observations["landmarks"]
        state = state_of(own.data.body, own.data.blocks, own.fill(mean))
        every = {name: draws[name].values.reshape(-1, *draws[name].shape[2:]) for name in own.reference()}
        means.append(
            (own.data.terms["landmarks"].predicted(state), observation.doubts(observation.summarise(own, state, every)))
        )
    (without, no_doubt), (with_outlier, doubts) = means
    assert no_doubt == []
    assert len(doubts) == 1
    assert "1 pair of points is probably wrong" in doubts[0]
    assert ": 8 (" in doubts[0]
    assert np.abs(with_outlier - without).max() < 0.1
