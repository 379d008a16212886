"""Random loads as the prior of the displacements: SciPy's Gaussian, refinement, and the search for their size."""

from __future__ import annotations

import jax
import numpy as np
import pytest
import scipy.linalg
from scipy import stats
from scipy.optimize import minimize

import bayesreg as br
from bayesreg.fem.elements import boundary_areas
from bayesreg.inference.gaussian.mode_search import find_mode
from bayesreg.inference.layout import flat_position, unravel
from bayesreg.model.observations.point_noise import NormalNoise
from bayesreg.model.options import PriorConfig
from tests.model.test_gradients import assert_gradient
from tests.options import model_of, posterior_of
from tests.oracles import paper
from tests.phantoms import LAM, MU, ball_mesh, box_mesh, refined, smooth_image

MESH = ball_mesh(spacing=30.0)
LOADS = {"body_load": 0.3, "surface_load": 0.7}
PRIORS = {name: PriorConfig(high=60.0) for name in ("lam", "mu")}
OPTIONS = {"priors": PRIORS, **LOADS}


def posterior(mesh=MESH, **options):
    images = (smooth_image(mesh.points, seed=seed) for seed in (1, 2))
    return posterior_of(*images, mesh, **(OPTIONS | options))


def values(mesh=MESH, seed=0):
    u = np.random.default_rng(seed).normal(size=mesh.points.shape)
    return {"u_boundary": u, "lam": LAM, "mu": MU}


def covariance(mesh, lam, mu, body_load, surface_load):
    """Of displacements without rigid motions under loads that are in balance, by dense linear algebra."""
    K = paper.stiffness(mesh.points, mesh.cells, lam[mesh.tissue], mu[mesh.tissue]).toarray()
    volumes, areas = np.zeros(len(mesh.points)), np.zeros(len(mesh.points))
    for cell, volume in zip(mesh.cells, mesh.volumes, strict=True):
        volumes[cell] += volume / 4
    for face in mesh.boundary_faces:
        a, b, c = mesh.points[face]
        areas[face] += np.linalg.norm(np.cross(b - a, c - a)) / 6
    loads = np.diag(np.repeat(body_load**2 * volumes + surface_load**2 * areas, 3))
    eigenvalues, vectors = np.linalg.eigh(K)
    rigid = vectors[:, :6]
    assert abs(eigenvalues[:6]).max() < 1e-9 * eigenvalues[-1]
    in_balance = loads - loads @ rigid @ np.linalg.solve(rigid.T @ loads @ rigid, rigid.T @ loads)
    inverse = np.linalg.pinv(K, 1e-10, hermitian=True)
    return inverse @ in_balance @ inverse, rigid


def test_the_prior_is_scipys_gaussian():
    state = values()
    C, rigid = covariance(MESH, LAM, MU, **LOADS)
    u = state["u_boundary"].ravel() - rigid @ (rigid.T @ state["u_boundary"].ravel())
    log_prior = float(posterior().energies(state)["elastic"])
    gaussian = stats.multivariate_normal(np.zeros(len(u)), C, allow_singular=True)
    assert log_prior == pytest.approx(gaussian.logpdf(u), rel=1e-8)


def test_rigid_motions_cost_nothing():
    post, state = posterior(), values()
    moved = state["u_boundary"] + [3.0, -1.0, 2.0] + np.cross([0.1, 0.05, -0.02], MESH.points)
    terms = [float(post.energies(state | {"u_boundary": u})["elastic"]) for u in (state["u_boundary"], moved)]
    assert terms[0] == pytest.approx(terms[1], rel=1e-9)


def test_its_gradient_is_that_of_differences():
    loads = {name: {"median": size, "log_sd": 1.0} for name, size in LOADS.items()}
    post = posterior(**loads, interpolation="cubic")
    assert {"body_load", "surface_load"} < set(post.reference())
    assert_gradient(post.logdensity, post.initial(jax.random.key(0)))


def test_areas_are_those_of_the_surface():
    assert boundary_areas(box_mesh(size=20.0)).sum() == pytest.approx(6 * 400.0)
    assert (boundary_areas(MESH)[MESH.interior] == 0).all()


@pytest.mark.parametrize(("prior", "growth"), [("loads", (0.8, 1.3)), ("boltzmann", (1.5, 2.5))])
def test_the_variance_of_a_point_keeps_its_size_where_the_mesh_is_refined(prior, growth):
    """That of exp(−E_r / T_r) grows as one over the length of an edge."""
    variances = []
    for mesh in (box_mesh(3), refined(box_mesh(3))):
        lam, mu = np.full(3, 5.0), np.ones(3)
        if prior == "loads":
            C, _ = covariance(mesh, lam, mu, **LOADS)
        else:
            K = paper.stiffness(mesh.points, mesh.cells, lam[mesh.tissue], mu[mesh.tissue]).toarray()
            C = np.linalg.pinv(K, 1e-10, hermitian=True)
        inside = np.repeat((abs(mesh.points - 10.0) < 5.5).all(axis=1), 3)
        variances.append(np.diag(C)[inside].mean())
    assert growth[0] < variances[1] / variances[0] < growth[1]


@pytest.mark.long
def test_the_size_of_loads_and_stiffness_lie_where_their_evidence_is_greatest():
    """Points at all nodes make all else Gaussian: the evidence by dense linear algebra, rigid motions projected out."""
    sd, count = 0.2, 3 * len(MESH.points)
    C, rigid = covariance(MESH, LAM, MU, 0.5, 0.2)
    rng = np.random.default_rng(1)
    u = np.linalg.cholesky(C + 1e-9 * np.eye(count)) @ rng.normal(size=count)
    moved = (u + sd * rng.normal(size=count)).reshape(-1, 3)
    inferred = {name: {"median": 0.3, "log_sd": 2.0} for name in LOADS}
    fixed = {"lam": dict(zip(MESH.names, LAM.tolist(), strict=True)), "mu": {"csf": 0.5, "gm": 1.0}}
    model = model_of(**OPTIONS | inferred, fixed=fixed)
    points = br.Landmarks(MESH.points, MESH.points + moved, sd=sd, noise=NormalNoise())
    post = br.build_posterior(MESH, [points], model)
    apart = scipy.linalg.null_space(rigid.T)

    def minus_evidence(theta):
        """Of the logarithms of both loads and the Normal score of μ of WM, with the priors."""
        body, surface = np.exp(theta[:2])
        mu = np.r_[MU[:2], 60.0 * stats.norm.cdf(theta[2])]
        marginal = apart.T @ (covariance(MESH, LAM, mu, body, surface)[0] + sd**2 * np.eye(count)) @ apart
        logs = stats.norm.logpdf(theta[:2], np.log(0.3), 2.0).sum() + stats.norm.logpdf(theta[2])
        return -stats.multivariate_normal.logpdf(apart.T @ moved.ravel(), cov=marginal) - logs

    start = np.asarray(flat_position(post.target, post.data, post.target.coordinates.reference()))
    mode = unravel(post.target)(find_mode(post.target, start))
    mode = np.r_[mode["body_load"], mode["surface_load"], mode["mu"]]
    best = minimize(minus_evidence, mode + 0.2, method="Nelder-Mead", options={"xatol": 1e-4}).x
    np.testing.assert_allclose(mode, best, atol=0.02)
    np.testing.assert_allclose(np.exp(best[0]), 0.5, rtol=0.5)


@pytest.mark.parametrize(
    ("prior", "says"),
    [
        ({"kind": "loads", "nodes": "boundary"}, "loads.nodes"),
        ({"kind": "loads", "normalised": False}, "loads.normalised"),
        ({"kind": "loads", "temperature": 5.0}, "loads.temperature"),
        ({"kind": "loads", "held": {0: (0.0, 0.0, 0.0)}}, "loads.held"),
        ({"kind": "loads", "body": None}, "loads.body"),
        ({"kind": "boltzmann", "body": 0.3}, "boltzmann.body"),
        ("load", "'load' found using 'kind'"),
    ],
)
def test_a_prior_has_no_option_of_the_other(prior, says):
    with pytest.raises(ValueError, match=says):
        br.ModelConfig(elastic_prior=prior)


def test_its_parts_are_those_of_the_mesh():
    prior = br.RandomLoads().on(MESH, None)
    assert float(prior.volumes.sum()) == pytest.approx(MESH.volumes.sum())
    assert prior.name == "elastic"


def test_the_preset_is_a_model_that_what_is_given_replaces():
    preset = br.ModelConfig(preset="registration")
    assert preset.elastic_prior == br.RandomLoads()
    assert preset.elastic_prior.nodes == "all"
    assert br.ModelConfig(**preset.model_dump()) == preset
    assert br.ModelConfig(preset="registration", elastic_prior={"body": 0.2}).elastic_prior == br.RandomLoads(body=0.2)
    boltzmann = br.Boltzmann(temperature=5.0)
    for prior in (boltzmann, {"kind": "boltzmann", "temperature": 5.0}):
        assert br.ModelConfig(preset="registration", elastic_prior=prior).elastic_prior == boltzmann
    assert br.ModelConfig() == br.ModelConfig(preset="paper")
    assert br.ModelConfig(elastic_prior={"temperature": 5.0}).elastic_prior == boltzmann
