"""The density against the plain transcription of the paper, on random states."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
import pytest

from tests.options import posterior_of
from tests.oracles.paper import Paper, Prior
from tests.phantoms import PAPER_LAM, PAPER_MU, ball_mesh, flat_skull, smooth_image

MESH = ball_mesh(spacing=24.0)
FIXED, MOVING = (smooth_image(MESH.points, seed=seed, left_handed=seed == 1) for seed in (1, 2))
T_SIMILARITY, T_ELASTIC = 5.0, 100.0
HELD = {int(MESH.boundary[3]): (0.5, -1.0, 2.0), int(MESH.interior[2]): (1.5, 0.0, -0.5)}
SUBSET = [int(k) for k in (*MESH.boundary[::5], MESH.interior[0], MESH.interior[4])]
ENTRIES = {"tissue": 3, "uniform": 1, "element": len(MESH.cells)}


class State(NamedTuple):
    """One state, as the software's values and as the oracle's arguments."""

    u: np.ndarray
    lam: np.ndarray
    mu: np.ndarray

    @property
    def values(self):
        return {"u_boundary": self.u, "lam": self.lam, "mu": self.mu}


def states(nodes, elasticity, count=4, seed=0):
    rng = np.random.default_rng(seed)
    size = ENTRIES[elasticity]
    return [
        State(
            rng.normal(scale=scale, size=(nodes, 3)),
            10 ** rng.uniform(-0.5, 1.3, size),
            10 ** rng.uniform(-0.7, 0.5, size),
        )
        for scale in np.linspace(0.8, 1.8, count)
    ]


def oracle(sampled, **options):
    arrays = ((image.voxels, image.affine) for image in (FIXED, MOVING))
    defaults = {"t_similarity": T_SIMILARITY, "t_elastic": T_ELASTIC}
    return Paper(MESH.points, MESH.cells, MESH.tissue, *arrays, np.asarray(sampled), **(defaults | options))


def posterior(skull=None, **options):
    defaults = {"t_similarity": T_SIMILARITY, "t_elastic": T_ELASTIC, "fixed": {}}
    return posterior_of(FIXED, MOVING, MESH, skull, **(defaults | options))


def assert_same_density(log_densities, expected, tolerance=1e-9):
    """Equal up to one constant for all states, relative to the spread of the values."""
    log_densities, expected = np.asarray(log_densities), np.asarray(expected)
    assert np.isfinite(expected).all()
    spread = np.ptp(expected)
    assert spread > 20
    assert np.ptp(log_densities - expected) < tolerance * spread


def assert_densities_agree(post, paper, trial, tolerance=1e-9):
    log_densities = [float(post.logdensity_constrained(s.values)) for s in trial]
    assert_same_density(log_densities, [paper.logdensity(*s) for s in trial], tolerance)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("elasticity", ["tissue", "uniform", "element"])
def test_density_is_the_papers(elasticity, interpolation):
    paper = oracle(MESH.boundary, interpolation=interpolation)
    post = posterior(elasticity=elasticity, interpolation=interpolation)
    assert_densities_agree(post, paper, states(len(MESH.boundary), elasticity))


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_density_far_off_the_moving_images_grid(interpolation):
    """Tens of mm: many points leave the grid, where the image continues with its nearest value."""
    trial = [s._replace(u=20 * s.u) for s in states(len(MESH.boundary), "tissue")]
    paper = oracle(MESH.boundary, interpolation=interpolation)
    assert_densities_agree(posterior(interpolation=interpolation), paper, trial)
    reached = MOVING.world_to_voxel(MESH.points[MESH.boundary] + trial[-1].u)
    assert ((reached < 0) | (reached > np.array(MOVING.shape) - 1)).any(axis=1).mean() > 0.1


def test_each_term_has_its_name_and_they_add_up():
    post = posterior(rigid_sd=0.4, priors={"lam": {"alpha": 2.0, "beta": 3.0, "high": 60.0}})
    prior = Prior(2.0, 3.0, 0.0, 60.0)
    paper = oracle(MESH.boundary, rigid_sd=0.4, prior_lam=prior)
    for state in states(len(MESH.boundary), "tissue"):
        terms = {name: float(value) for name, value in post.energies(state.values).items()}
        u = paper.displacement(*state)
        assert terms["similarity_energy"] == pytest.approx(paper.similarity(u), rel=1e-9)
        assert terms["strain_energy"] == pytest.approx(paper.strain(u, state.lam, state.mu), rel=1e-9)
        assert terms["images"] == pytest.approx(-paper.similarity(u) / T_SIMILARITY, rel=1e-9)
        assert terms["elastic"] == pytest.approx(-paper.strain(u, state.lam, state.mu) / T_ELASTIC, rel=1e-9)
        assert terms["rigid"] == pytest.approx(paper.log_rigid(state.u), rel=1e-9)
        assert terms["prior_lam"] == pytest.approx(sum(map(prior.logpdf, state.lam)), rel=1e-9)
        assert terms["prior_mu"] == terms["support"] == terms["solved"] == 0
        total = sum(value for name, value in terms.items() if not name.endswith("_energy"))
        assert float(post.logdensity_constrained(state.values)) == pytest.approx(total, rel=1e-12)


def test_chains_side_by_side_do_not_disturb_one_another():
    """Under vmap, with one chain outside the support and one not a number among them."""
    trial = states(len(MESH.boundary), "tissue")
    trial[1].mu[2] = -1.0
    trial[2].u[4, 1] = np.nan
    post = posterior()
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *(s.values for s in trial))
    log_densities = jax.vmap(post.logdensity_constrained)(batch)
    alone = np.array([float(post.logdensity_constrained(s.values)) for s in trial])
    np.testing.assert_allclose(log_densities, alone, rtol=1e-10)
    np.testing.assert_array_equal(np.isfinite(alone), [True, False, False, True])


@pytest.mark.parametrize("quadrature", ["gauss32", "voxels"])
def test_density_with_other_quadratures(quadrature):
    paper = oracle(MESH.boundary, quadrature=quadrature)
    assert_densities_agree(posterior(quadrature=quadrature), paper, states(len(MESH.boundary), "tissue"))


def test_density_at_the_papers_contrast():
    trial = [s._replace(lam=PAPER_LAM * s.lam, mu=PAPER_MU * s.mu) for s in states(len(MESH.boundary), "tissue")]
    assert_densities_agree(posterior(), oracle(MESH.boundary), trial)


def test_density_with_a_rigid_prior():
    assert_densities_agree(
        posterior(rigid_sd=0.4), oracle(MESH.boundary, rigid_sd=0.4), states(len(MESH.boundary), "tissue")
    )
    weak, strong = (oracle(MESH.boundary, rigid_sd=sd) for sd in (4.0, 0.4))
    state = states(len(MESH.boundary), "tissue")[0]
    assert abs(weak.logdensity(*state) - strong.logdensity(*state)) > 0.1


def test_rigid_prior_is_on_the_root_mean_square_displacement():
    """Translating every sampled node by d mm costs ½ d² / sd², however many nodes there are."""
    post = posterior(rigid_sd=0.7)
    loose = posterior()
    at_rest, moved = (
        State(np.tile([0.0, d, 0.0], (len(MESH.boundary), 1)), PAPER_LAM, PAPER_MU).values for d in (0.0, 2.1)
    )

    def cost(values):
        return float(post.logdensity_constrained(values)) - float(loose.logdensity_constrained(values))

    assert cost(at_rest) - cost(moved) == pytest.approx(0.5 * (2.1 / 0.7) ** 2, rel=1e-9)


@pytest.mark.parametrize("elasticity", ["tissue", "uniform", "element"])
def test_density_with_beta_priors_and_a_fixed_parameter(elasticity):
    """Scaled Beta priors on all that is free; μ of grey matter (uniform: μ) is known and has none."""
    known_entries = {"tissue": [1], "uniform": [0], "element": np.flatnonzero(MESH.tissue == 1)}[elasticity]
    fixed = {"mu": 0.8} if elasticity == "uniform" else {"mu": {"gm": 0.8}}
    priors = {
        "lam": {"alpha": 2.0, "beta": 3.5, "low": 0.1, "high": 40.0},
        "mu": {"alpha": 1.5, "beta": 0.8, "low": 0.05, "high": 9.0},
    }
    paper = oracle(
        MESH.boundary,
        prior_lam=Prior(2.0, 3.5, 0.1, 40.0),
        prior_mu=Prior(1.5, 0.8, 0.05, 9.0),
        free_mu=[i for i in range(ENTRIES[elasticity]) if i not in set(known_entries)],
    )
    trial = states(len(MESH.boundary), elasticity)
    for state in trial:
        state.mu[known_entries] = 0.8
    assert_densities_agree(posterior(elasticity=elasticity, fixed=fixed, priors=priors), paper, trial)


def test_density_with_one_prior_for_each_tissue():
    """Only λ of white matter has a prior that is not flat."""
    priors = {"lam": {"wm": {"alpha": 3.0, "beta": 2.0, "high": 50.0}}}
    trial = states(len(MESH.boundary), "tissue")
    with_prior = posterior(priors=priors)
    flat = oracle(MESH.boundary)
    expected = [flat.logdensity(*s) + Prior(3.0, 2.0, 0.0, 50.0).logpdf(s.lam[2]) for s in trial]
    assert_same_density([float(with_prior.logdensity_constrained(s.values)) for s in trial], expected)


@pytest.mark.parametrize("sampled", ["boundary", "all", "some"])
@pytest.mark.parametrize("held", [{}, HELD], ids=["free", "held"])
def test_density_of_other_sampled_nodes(sampled, held):
    nodes = {"boundary": MESH.boundary, "all": np.arange(len(MESH.points)), "some": np.sort(SUBSET)}[sampled]
    nodes = np.setdiff1d(nodes, list(held))
    post = posterior(sampled=SUBSET[::-1] if sampled == "some" else sampled, held=held)
    assert_densities_agree(post, oracle(nodes, held=held), states(len(nodes), "tissue"))


def test_held_nodes_matter():
    nodes = np.setdiff1d(MESH.boundary, list(HELD))
    elsewhere = dict.fromkeys(HELD, (-2.0, 2.0, 0.0))
    state = states(len(nodes), "tissue")[0]
    log_density, shifted_log_density = (
        posterior(held=held).logdensity_constrained(state.values) for held in (HELD, elsewhere)
    )
    assert abs(float(log_density) - float(shifted_log_density)) > 1


def test_outside_the_support_the_density_is_zero():
    inside = states(len(MESH.boundary), "tissue")[0]
    post = posterior(priors={"lam": {"low": 0.1, "high": 40.0}})
    assert np.isfinite(float(post.logdensity_constrained(inside.values)))
    forbidden = (("mu", -1e-9), ("mu", -3.0), ("mu", np.inf), ("lam", -1.0), ("lam", 0.099), ("lam", 40.1))
    for name, value in forbidden:
        values = {k: v.copy() for k, v in inside.values.items()}
        values[name][0] = value
        assert float(post.logdensity_constrained(values)) == -np.inf, (name, value)


def test_incompressibility_may_vanish():
    """λ = 0 is in the prior's support, and harmless: μ alone keeps the tissue together."""
    trial = states(len(MESH.boundary), "tissue")
    for state in trial:
        state.lam[1] = 0.0
    assert_densities_agree(posterior(), oracle(MESH.boundary), trial)


@pytest.mark.parametrize("name", ["u_boundary", "lam", "mu"])
def test_nan_has_no_density(name):
    values = {k: v.copy() for k, v in states(len(MESH.boundary), "tissue")[0].values.items()}
    values[name].flat[0] = np.nan
    assert float(posterior().logdensity_constrained(values)) == -np.inf


def test_skull_forbids_what_the_oracle_forbids():
    """Random states close to a flat wall; those with a node within 0.01 mm of it are left out."""
    wall = MESH.points[:, 1].max() + 0.4
    skull = flat_skull(MESH.points, axis=1, wall=wall, voxel=2.0)
    post, free = posterior(skull=skull, skull_width=0.0), posterior()
    paper = oracle(MESH.boundary, skull=(skull.voxels, skull.affine))
    counts = {True: 0, False: 0}
    for state in states(len(MESH.boundary), "tissue", count=12, seed=3):
        state.u[:] *= 0.95
        if abs(MESH.points[MESH.boundary, 1] + state.u[:, 1] - wall).min() < 0.01:
            continue
        expected = paper.logdensity(*state)
        counts[bool(np.isfinite(expected))] += 1
        log_density = float(post.logdensity_constrained(state.values))
        assert np.isfinite(log_density) == np.isfinite(expected)
        if np.isfinite(log_density):
            assert log_density == pytest.approx(float(free.logdensity_constrained(state.values)), rel=1e-12)
    assert min(counts.values()) >= 2


def test_off_the_skulls_grid_is_forbidden():
    skull = flat_skull(MESH.points, axis=1, wall=200.0, voxel=2.0, margin=6.0)
    assert not skull.voxels.any()
    post = posterior(skull=skull, skull_width=0.0)
    state = states(len(MESH.boundary), "tissue")[0]
    assert np.isfinite(float(post.logdensity_constrained(state.values)))
    for step in (150.0, -150.0):
        moved = state.u.copy()
        moved[7, 2] += step
        assert float(post.logdensity_constrained(state._replace(u=moved).values)) == -np.inf
