"""Landmarks and observations from outside the package, against the exact Gaussian that they give."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import bayesreg as br
from bayesreg.fem.location import interpolation_at
from bayesreg.model import external_curvature
from bayesreg.model.adequacy import describe_observations
from bayesreg.model.build import require_observations
from bayesreg.model.curvature import _assemble, displacement_curvature
from bayesreg.model.external_curvature import FixedState, _curvature_of_term
from bayesreg.model.observations.left_out import leave_out, predict_at_mean
from bayesreg.model.observations.point_noise import NormalNoise
from bayesreg.model.state import State
from bayesreg.model.term import ExternalTerm, PointCurvature, SharedCurvature
from bayesreg.types import Equilibrium
from tests.options import model_of
from tests.oracles import paper
from tests.phantoms import box_mesh, smooth_image

MESH = box_mesh(2)
LAM, MU = np.array([0.5, 1.0, 1.5]), np.array([0.7, 1.0, 1.4])
T_ELASTIC, RIGID_SD = 20.0, 0.8
CHAINS = 32
MODEL = model_of(
    fixed={name: dict(zip(MESH.names, values.tolist(), strict=True)) for name, values in (("lam", LAM), ("mu", MU))},
    t_elastic=T_ELASTIC,
    rigid_sd=RIGID_SD,
)


class MeanDisplacement:
    """From outside the package: the mean displacement of a region was measured."""

    name = "region"

    def __init__(self, points, measured, sd):
        self.points, self.measured, self.sd = points, measured, sd

    def log(self, state):
        away = state.at(self.points).mean(axis=0) - self.measured
        return -0.5 * (away @ away) / self.sd**2


class Distance:
    """From outside the package, and not linear in the displacements: how far apart two places lie now."""

    name = "distance"

    def __init__(self, first, second, measured, sd):
        self.points, self.measured, self.sd = np.stack([first, second]), measured, sd

    def log(self, state):
        first, second = self.points + state.at(self.points)
        return -0.5 * ((jnp.linalg.norm(first - second) - self.measured) / self.sd) ** 2


def places(count=9):
    rng = np.random.default_rng(5)
    points = rng.uniform(2, 18, (count, 3))
    return points, points + rng.normal(0.4, 0.5, (count, 3)), rng.uniform(0.2, 0.6, count)


REGION = np.array([[5.0, 6.0, 7.0], [6.0, 6.0, 8.0], [5.5, 7.0, 7.5]]), np.array([1.0, -0.5, 0.2]), 0.15


def landmarks():
    points, moved, sd = places()
    return br.Landmarks(points, moved, sd, noise=NormalNoise())


@cache
def posterior(with_region=False):
    observed = [landmarks(), *([MeanDisplacement(*REGION)] if with_region else [])]
    return br.build_posterior(MESH, observed, MODEL)


def barycentric(points):
    """Rows that take nodal values to points, by a linear solve in every cell."""
    rows = np.zeros((len(points), len(MESH.points)))
    for row, point in zip(rows, points, strict=True):
        for cell in MESH.cells:
            weights = np.linalg.solve(np.vstack([MESH.points[cell].T, np.ones(4)]), [*point, 1.0])
            if weights.min() > -1e-9:
                row[cell] = weights
                break
    return rows


@cache
def prior():
    """Precision of the flat u_B, and what takes it to all nodes, by dense matrices."""
    K = np.asarray(paper.stiffness(MESH.points, MESH.cells, LAM[MESH.tissue], MU[MESH.tissue]).todense())
    boundary = (3 * MESH.boundary[:, None] + np.arange(3)).ravel()
    interior = np.setdiff1d(np.arange(len(K)), boundary)
    extension = np.zeros((len(K), len(boundary)))
    extension[boundary] = np.eye(len(boundary))
    extension[interior] = -np.linalg.solve(K[np.ix_(interior, interior)], K[np.ix_(interior, boundary)])
    modes = np.linalg.qr(rigid(MESH.points[MESH.boundary]))[0]
    return extension.T @ K @ extension / T_ELASTIC + modes @ modes.T / (len(MESH.boundary) * RIGID_SD**2), extension


@cache
def exact(with_region=False, without=None):
    """Mean and covariance of the flat u_B, by dense matrices of its own; without one landmark."""
    precision, extension = prior()
    force = np.zeros(len(precision))
    remaining = np.delete(np.arange(9), [] if without is None else without)
    points, moved, sd = (array[remaining] for array in places())
    observed = [(np.kron(barycentric(points), np.eye(3)), (moved - points).ravel(), np.repeat(sd, 3))]
    if with_region:
        region, measured, error = REGION
        mean = barycentric(region).mean(axis=0, keepdims=True)
        observed.append((np.kron(mean, np.eye(3)), measured, np.full(3, error)))
    for rows, value, error in observed:
        J = rows @ extension / error[:, None]
        precision, force = precision + J.T @ J, force + J.T @ (value / error)
    return np.linalg.solve(precision, force), np.linalg.inv(precision)


def rigid(points):
    """Three shifts and three infinitesimal turns, as columns."""
    shifts = np.tile(np.eye(3), (len(points), 1))
    turns = [np.cross(np.broadcast_to(axis, points.shape), points).ravel() for axis in np.eye(3)]
    return np.column_stack([shifts, *turns])


@pytest.mark.parametrize("with_region", [False, True])
def test_density_is_the_gaussian(with_region):
    mean, covariance = exact(with_region)
    post, precision = posterior(with_region), np.linalg.inv(covariance)

    def density(flat):
        return float(post.logdensity_constrained({"u_boundary": flat.reshape(-1, 3), "lam": LAM, "mu": MU}))

    at_mean = density(mean)
    for step in np.random.default_rng(0).normal(size=(5, len(mean))):
        for sign in (-1, 1):
            assert density(mean + sign * step) - at_mean == pytest.approx(-0.5 * step @ precision @ step, rel=1e-6)


@pytest.mark.parametrize("with_region", [False, True])
def test_curvature_is_the_gaussians(with_region):
    post = posterior(with_region)
    curvature = post.target.mode_search.curvature(post.data, post.estimands(post.reference()))
    np.testing.assert_allclose(curvature.gauss_newton, np.linalg.inv(exact(with_region)[1]), rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(curvature.remainder, 0, atol=1e-12)


@pytest.mark.parametrize("with_region", [False, True])
@pytest.mark.parametrize("sampler", ["hmc", "laplace"])
def test_samplers_meet_mean_and_covariance(sampler, with_region):
    samples = br.sample(posterior(with_region), sampler, chains=CHAINS, draws=160, seed=1, block=160, progress=False)
    draws = samples.idata.posterior["u_boundary"].values.reshape(CHAINS, 160, -1)[:, 40:]
    mean, covariance = exact(with_region)
    whitened = (draws - mean) @ np.linalg.cholesky(np.linalg.inv(covariance))
    for moment, expected in ((whitened, 0.0), (whitened**2, 1.0)):
        per_chain = moment.mean(axis=1)
        z = (per_chain.mean(axis=0) - expected) / (per_chain.std(axis=0, ddof=1) / np.sqrt(CHAINS))
        assert abs(z).max() < 5
        assert (z**2).mean() == pytest.approx(1.0, abs=0.6)


def test_left_out_landmarks_are_predicted_as_by_a_posterior_without_them():
    post = posterior(True)
    mean = jnp.asarray(exact(True)[0].reshape(-1, 3))
    left_out = leave_out(predict_at_mean(post, post.data.terms["landmarks"], {"u_boundary": mean}), NormalNoise())
    points, moved, sd = places()
    for k in range(len(points)):
        rows = np.kron(barycentric(points[k : k + 1]), np.eye(3)) @ prior()[1]
        without, covariance = exact(True, k)
        np.testing.assert_allclose(left_out.residual[k], moved[k] - points[k] - rows @ without, rtol=1e-5, atol=1e-7)
        expected = rows @ covariance @ rows.T + sd[k] ** 2 * np.eye(3)
        np.testing.assert_allclose(left_out.covariance[k], expected, rtol=1e-5, atol=1e-8)


def test_a_landmark_that_nothing_else_determines_is_told():
    """Without a rigid prior three landmarks say where the body is; any two of them leave a turn about their line."""
    model = MODEL.model_copy(update={"rigid_sd": None})
    rest = {"u_boundary": jnp.zeros((len(MESH.boundary), 3))}
    points, moved, sd = (array[:3] for array in places())
    post = br.build_posterior(MESH, [br.Landmarks(points, moved, sd, noise=NormalNoise())], model)
    left_out = leave_out(predict_at_mean(post, post.data.terms["landmarks"], rest), NormalNoise())
    assert np.isnan(left_out.residual).all()
    assert np.isinf(left_out.covariance).all()
    assert np.isnan(left_out.share).all()


# The wider prior allows the sd of the joint mode, next to zero, where the nodes follow every landmark.
@pytest.mark.parametrize(("median", "log_sd"), [(0.3, 0.7), (1.5, 1.0)])
def test_an_inferred_sd_has_the_posterior_of_its_evidence(median, log_sd):
    """The displacements are integrated out in closed form: the shifts are N(0, A Σ Aᵀ + sd² I) given sd."""
    points, moved, _ = places()
    observed = [br.Landmarks(points, moved, br.ScalePrior(median=median, log_sd=log_sd), noise=NormalNoise())]
    post = br.build_posterior(MESH, observed, MODEL)
    precision, extension = prior()
    A = np.kron(barycentric(points), np.eye(3)) @ extension
    spread, shift = A @ np.linalg.solve(precision, A.T), (moved - points).ravel()
    grid = np.linspace(np.log(0.3) - 4, np.log(0.3) + 4, 400)
    height = [
        stats.multivariate_normal.logpdf(shift, np.zeros(len(shift)), spread + np.exp(2 * s) * np.eye(len(shift)))
        + stats.norm.logpdf(s, np.log(median), log_sd)
        for s in grid
    ]
    weight = np.exp(np.array(height) - max(height))
    weight /= weight.sum()
    expected = weight @ grid
    deviation = np.sqrt(weight @ (grid - expected) ** 2)

    samples = br.sample(post, "hmc", chains=CHAINS, draws=120, seed=2, block=120, progress=False)
    draws = np.log(samples.idata.posterior["landmarks_sd"].values)[:, 20:]
    error = draws.mean(axis=1).std(ddof=1) / np.sqrt(CHAINS)
    assert abs(draws.mean() - expected) < 4 * error + 0.02 * deviation
    assert draws.std() == pytest.approx(deviation, rel=0.12)

    # Laplace's approximation is at the evidence's greatest value, and as wide as its curvature there.
    best = np.argmax(height)
    second = (height[best + 1] - 2 * height[best] + height[best - 1]) / (grid[1] - grid[0]) ** 2
    samples = br.sample(post, "laplace", chains=CHAINS, draws=120, seed=2, block=120, progress=False)
    draws = np.log(samples.idata.posterior["landmarks_sd"].values)
    assert draws.mean() == pytest.approx(grid[best], abs=0.1 * deviation + grid[1] - grid[0])
    assert draws.std() == pytest.approx((-second) ** -0.5, rel=0.05)


def test_the_papers_kernel_runs_with_them():
    samples = br.sample(posterior(True), "rwmh", chains=2, draws=40, thin=2, seed=1, progress=False, sigma_u=0.05)
    assert 0.05 < float(samples.idata.sample_stats["acceptance_rate"].mean()) < 0.99


def test_terms_have_their_names_and_add_up():
    post = posterior(True)
    values = {"u_boundary": 0.1 * np.ones((len(MESH.boundary), 3)), "lam": LAM, "mu": MU}
    terms = {name: float(value) for name, value in post.energies(values).items()}
    assert {"landmarks", "region", "elastic", "rigid", "support", "solved"} <= set(terms)
    points, moved, sd = places()
    assert terms["landmarks"] == pytest.approx(-0.5 * ((((moved - points) - 0.1) / sd[:, None]) ** 2).sum())
    total = sum(value for name, value in terms.items() if not name.endswith("_energy"))
    assert float(post.logdensity_constrained(values)) == pytest.approx(total)


def test_images_and_landmarks_are_one_density():
    fixed, moving = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    both = br.build_posterior(MESH, [br.ImagePair(fixed, moving), landmarks()], MODEL)
    short = br.build_posterior(MESH, [br.ImagePair(fixed, moving)], MODEL)
    values = {"u_boundary": 0.3 * np.sin(MESH.points[MESH.boundary]), "lam": LAM, "mu": MU}
    energies = both.energies(values)
    expected = float(short.logdensity_constrained(values)) + float(energies["landmarks"])
    assert float(both.logdensity_constrained(values)) == pytest.approx(expected, rel=1e-12)
    curvature = both.target.mode_search.curvature(both.data, both.estimands(values))
    alone = short.target.mode_search.curvature(short.data, short.estimands(values))
    assert np.linalg.eigvalsh(curvature.gauss_newton - alone.gauss_newton).min() > -1e-8


def test_curvature_of_a_term_from_outside_is_the_dense_hessian():
    """Its convex part, and in the unknowns that the term looks at alone: each costs a product."""
    term = Distance(np.array([4.0, 5.0, 6.0]), np.array([13.0, 12.0, 15.0]), measured=15.0, sd=0.5)
    mesh = box_mesh(4)
    post = br.build_posterior(mesh, [term], model_of(sampled="all"))
    u = 0.5 * np.random.default_rng(0).normal(size=mesh.points.shape)

    def energy(flat):
        solved = Equilibrium(flat.reshape(-1, 3), jnp.zeros(()), jnp.zeros((), int), jnp.array(True))
        return -term.log(State({}, jnp.zeros(0), jnp.zeros(0), solved, post.data.body.system.elements, mesh))

    dense = np.asarray(jax.hessian(energy)(u.ravel()))
    eigenvalues, vectors = np.linalg.eigh(dense)
    assert eigenvalues.min() < -0.1 < 0.1 < eigenvalues.max()
    convex = (vectors * np.maximum(eigenvalues, 0)) @ vectors.T
    fixed_state = FixedState(post.data, {}, jnp.zeros(len(mesh.cells)), jnp.zeros(len(mesh.cells)))
    curvature = _curvature_of_term(ExternalTerm(term), fixed_state, jnp.asarray(u)).toarray()
    np.testing.assert_allclose(curvature, convex, atol=1e-10 * eigenvalues.max())


@pytest.mark.parametrize("count", [0, 1, 10])
def test_a_term_from_outside_costs_the_directions_it_looks_at(count, monkeypatch):
    """Ten nodes are 30 unknowns, also at rest, where the slope of the term is zero."""

    class OfNodes:
        name, nodes = "nodes", np.arange(count) * 3

        def log(self, state):
            return -0.5 * (state.u[self.nodes] ** 2).sum() + 0.0 * state.u.sum()

    mesh, requested = box_mesh(4), []
    post = br.build_posterior(mesh, [OfNodes()], model_of(sampled="all"))
    products = external_curvature._products

    def counted(term, fixed_state, flat, directions):
        requested.append(np.asarray(directions))
        return products(term, fixed_state, flat, directions)

    monkeypatch.setattr(external_curvature, "_products", counted)
    without = post.data.without_term("nodes")
    at_rest, u = post.data.blocks, jnp.zeros(mesh.points.shape)
    values = {name: block.reference() for name, block in at_rest.items()}
    full, rest = (displacement_curvature(data, values, u).gauss_newton for data in (post.data, without))
    expected = (3 * OfNodes.nodes[:, None] + np.arange(3)).ravel()
    np.testing.assert_array_equal(np.concatenate([[], *requested]), expected)
    np.testing.assert_allclose(np.diag(full - rest), np.isin(np.arange(u.size), expected), atol=1e-9)
    assert len(expected) == 3 * count < u.size


def test_curvature_that_points_share_is_the_sum_of_products():
    rng, points = np.random.default_rng(0), places()[0]
    groups, vectors, matrices = rng.integers(0, 3, len(points)), rng.normal(size=(2, 9, 3)), rng.normal(size=(9, 3, 3))
    nodes, weights = interpolation_at(MESH, points)
    shared = SharedCurvature(jnp.asarray(groups), jnp.asarray(vectors), jnp.array([-1.0, 1.0]))
    curvature = _assemble(len(MESH.points), PointCurvature(*map(jnp.asarray, (nodes, weights, matrices)), shared))
    of_points = np.zeros((9, 3, 9, 3))
    for first in range(9):
        of_points[first, :, first] += matrices[first]
        for second in np.flatnonzero(groups == groups[first]):
            of_points[first, :, second] += np.outer(vectors[1, first], vectors[1, second])
            of_points[first, :, second] -= np.outer(vectors[0, first], vectors[0, second])
    rows = np.kron(barycentric(points), np.eye(3))
    np.testing.assert_allclose(curvature.toarray(), rows.T @ of_points.reshape(27, 27) @ rows, atol=1e-12)


class Own:
    name = "own"

    def __init__(self, log, **attributes):
        self.log = log
        vars(self).update(attributes)


TWO = br.Landmarks([[1.0, 1, 1], [2.0, 1, 1]], [[1.0, 1, 1], [2.0, 1, 1]], 1.0)
LOOSE = MODEL.model_copy(update={"rigid_sd": None})


@pytest.mark.parametrize(
    ("observations", "message"),
    [
        ([], "nothing observed"),
        ([3], "needs a name .* and a function log"),
        ([Own(lambda state: jnp.zeros(3))], "must give one real number, got shape"),
        ([Own(lambda state: None)], "must give one real number, got NoneType"),
        ([Own(3)], "needs a name .* and a function log"),
        ([Own(lambda state: jnp.zeros(()), name=None)], "needs a name .* and a function log"),
        ([Own(lambda state: jnp.zeros(()), name="prior_lam")], "'prior_lam' of an observation is taken"),
        ([Own(lambda state: jnp.log(state.u[0, 0] - 1.0))], "'own' is not a number where nothing has moved"),
        ([Own(lambda state: -jnp.linalg.norm(state.u[0]))], "'own' has a derivative that is not a number"),
        ([Own(lambda state: state.at([1.0, 1.0, 1.0]).sum())], "points of shape"),
        ([landmarks(), landmarks()], "'landmarks' of an observation is taken"),
        ([br.Landmarks([[1.0, 1, 1]], [[1.0, 1, 1]], 1.0, name="elastic")], "'elastic' of an observation is taken"),
        (
            [br.Landmarks([[1.0, 1, 99]], [[1.0, 1, 1]], 1.0, labels=["tip"])],
            "landmarks: 1 of 1 points lie .* outside the mesh, .*: tip; fewer than 4 points are left",
        ),
        ([MeanDisplacement(np.array([[0.0, 0.0, 99.0]]), np.zeros(3), 1.0)], "outside the mesh"),
    ],
)
def test_wrong_observations_are_told(observations, message):
    with pytest.raises(br.InputError, match=message):
        br.build_posterior(MESH, observations, MODEL)


def test_two_readings_tell_the_sd_of_one():
    rng, sd = np.random.default_rng(0), np.array([0.3, 0.6, 1.0])
    fixed = rng.uniform(2, 18, (4000, 3))
    first, second = (fixed + sd * rng.normal(size=fixed.shape) for _ in range(2))
    observation = br.Landmarks(fixed, first, None, second_points=second)
    medians = [prior.median for _, prior in observation.scales.values()]
    np.testing.assert_allclose(medians, sd, rtol=0.05)
    assert [name for name, _ in observation.scales.values()] == [f"landmarks_sd_{axis}" for axis in "xyz"]
    known = br.Landmarks(fixed, first, 2.0, second_points=second)
    assert not known.scales
    np.testing.assert_allclose(known.reading_sd, medians)
    with pytest.raises(br.InputError, match="both readings of the moving points are equal along z, and tell no sd"):
        br.Landmarks(fixed, first, None, second_points=np.c_[second[:, :2], first[:, 2]])
    with pytest.raises(br.InputError, match="one for each of 4000 pairs"):
        br.Landmarks(fixed, first, None, second_points=second[1:])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((2, 3)), np.zeros((3, 3)), 1.0), "must both have shape"),
        ((np.zeros((2, 3)), np.zeros((2, 3)), [1.0, 2.0, 3.0]), "one for each point"),
        ((np.zeros((2, 3)), np.zeros((2, 3)), 0.0), "must be positive"),
        ((np.zeros((2, 3)), np.zeros((2, 3)), "wide"), "sd must be a number, 2 numbers or a ScalePrior; got 'wide'"),
        ((np.zeros((2, 3)), np.zeros((2, 3)), None), "sd is not a number"),
        (([[1.0, 2.0], [1.0]], np.zeros((2, 3)), 1.0), "points must be numbers"),
        ((np.zeros((1, 3)), np.full((1, 3), np.nan), 1.0), "finite number"),
        ((np.zeros((2, 3)), np.zeros((2, 3)), 1.0, "pairs", ["one"]), "pairs: labels must be a list of 2"),
    ],
)
def test_wrong_landmarks_are_told(arguments, message):
    with pytest.raises(br.InputError, match=message):
        br.Landmarks(*arguments)


def test_one_observation_alone_is_put_in_a_list():
    with pytest.raises(br.InputError, match="observations must be a list, got Landmarks"):
        require_observations(landmarks())


def test_landmarks_must_bound_the_rigid_motions():
    """Two points, or three on a line, leave them free unless a prior or nodes that are held do not."""
    for few in (TWO, br.Landmarks([[x, 1.0, 1.0] for x in (0.5, 1.0, 1.5)], np.zeros((3, 3)), 1.0)):
        with pytest.raises(br.InputError, match="the posterior would be improper; give at least three"):
            br.build_posterior(MESH, [few], LOOSE)
    held = LOOSE.model_copy(update={"elastic_prior": br.Boltzmann(held={int(MESH.boundary[0]): (0.0, 0.0, 0.0)})})
    for model, observations in ((MODEL, [TWO]), (held, [TWO]), (LOOSE, [landmarks()])):
        br.build_posterior(MESH, observations, model)


def test_without_images_there_is_no_temperature_of_theirs():
    assert set(posterior().reference()) == {"u_boundary", "lam", "mu", "t_elastic"}


def test_unknown_names_of_values_are_told():
    post = posterior()
    with pytest.raises(br.InputError, match="values hold the unknown t_simlarity"):
        post.logdensity_constrained({**post.reference(), "t_simlarity": 1.0})


OF_YOUR_OWN = {"kind": "own", "title": "an observation of your own"}


def test_observations_say_how_they_fit():
    """By the root of the mean square of their residuals over the sd, if they know these."""
    points, moved, sd = places()
    observation = Own(lambda state: -0.5 * (state.u[3] ** 2).sum(), standardised_residual=lambda state: state.u[3])
    post = br.build_posterior(MESH, [landmarks(), observation, Own(lambda state: state.u[0, 0], name="shift")], MODEL)
    descriptions = describe_observations(post, post.reference())
    z = (moved - points) / sd[:, None]
    assert descriptions["landmarks"] == {
        "kind": "landmarks",
        "title": "pairs of points",
        "log": pytest.approx(-0.5 * (z**2).sum()),
        "values": z.size,
        "residual_rms": pytest.approx(np.sqrt((z**2).mean())),
    }
    assert descriptions["own"] == {**OF_YOUR_OWN, "log": 0.0, "values": 3, "residual_rms": 0.0}
    assert descriptions["shift"] == {**OF_YOUR_OWN, "log": 0.0}


def test_a_posterior_without_a_mesh_is_told():
    with pytest.raises((br.InputError, TypeError), match="mesh"):
        br.build_posterior(None, [landmarks()])
