"""Elastography: u_B is given, λ and μ alone are sampled; against a posterior worked out on a grid, and the truth."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayesreg as br
from bayesreg.inference.draws.diagnostics import convergence
from tests.options import posterior_of
from tests.oracles import paper
from tests.phantoms import LAM, MU, ball_mesh, pair_from_model

MESH = ball_mesh(spacing=18.0)
NOISE = 0.01
NAMES = MESH.names
RANGE = {"lam": (0.0, 40.0), "mu": (0.0, 8.0)}


@cache
def phantom():
    """Images, drawn from the model itself, and the true displacement."""
    centred = MESH.points[MESH.boundary] - MESH.points.mean(axis=0)
    u_boundary = 0.1 * centred * np.array([-1.5, 0.6, 0.9]) + 2 * np.sin(centred[:, [1, 2, 0]] / 12)
    u = np.asarray(br.solve_interior(MESH, LAM, MU, u_boundary).u)
    fixed, moving, t_similarity = pair_from_model(MESH, u, NOISE)
    return fixed, moving, t_similarity, u


def posterior(free=("lam gm", "mu wm"), **options):
    """Two parameters are free, the others known."""
    fixed, moving, t_similarity, u = phantom()
    known_parameters = {
        name: {t: float(v) for t, v in zip(NAMES, values, strict=True) if f"{name} {t}" not in free}
        for name, values in (("lam", LAM), ("mu", MU))
    }
    return posterior_of(
        fixed,
        moving,
        MESH,
        fixed=known_parameters,
        sampled=[],
        held={int(node): tuple(u[node].tolist()) for node in MESH.boundary},
        t_similarity=t_similarity,
        quadrature="voxels",
        interpolation="cubic",
        **{"priors": {name: br.PriorConfig(low=low, high=high) for name, (low, high) in RANGE.items()}} | options,
    )


def values(lam_gm, mu_wm):
    lam, mu = jnp.asarray(LAM).at[1].set(lam_gm), jnp.asarray(MU).at[2].set(mu_wm)
    return {"u_boundary": jnp.zeros((0, 3)), "lam": lam, "mu": mu}


@cache
def oracle():
    """E_s(λ_gm, μ_wm) / T_s by plain NumPy and SciPy; K is put together of its parts, one for each parameter."""
    fixed, moving, t_similarity, u = phantom()
    images = ((np.asarray(image.voxels), np.asarray(image.affine)) for image in (fixed, moving))
    plain = paper.Paper(
        MESH.points, MESH.cells, MESH.tissue, *images, MESH.boundary, quadrature="voxels", interpolation="cubic"
    )
    unit, none = np.eye(3), np.zeros(3)
    stiffnesses = [plain.stiffness(tissue, none) for tissue in unit], [plain.stiffness(none, tissue) for tissue in unit]

    def energy(lam_gm, mu_wm):
        lam, mu = np.array([LAM[0], lam_gm, LAM[2]]), np.array([MU[0], MU[1], mu_wm])
        K = sum(c * matrix for c, matrix in zip((*lam, *mu), (*stiffnesses[0], *stiffnesses[1]), strict=True))
        return plain.similarity(paper.solve_unknown(K, MESH.boundary, u[MESH.boundary])) / t_similarity

    return energy


def test_density_is_the_similarity_alone():
    """Without E_r, which would draw λ and μ to zero: u_B is given and needs no prior."""
    post, energy = posterior(), oracle()
    at_truth = float(post.logdensity_constrained(values(LAM[1], MU[2])))
    for place in [(3.0, 1.0), (20.0, 4.0), (5.0, 0.2)]:
        change = float(post.logdensity_constrained(values(*place))) - at_truth
        assert change == pytest.approx(energy(LAM[1], MU[2]) - energy(*place), rel=1e-6)
    terms = post.energies(values(LAM[1], MU[2]))
    assert not {"elastic", "rigid"} & set(terms)
    total = sum(float(terms[name]) for name in terms if not name.endswith("_energy"))
    assert total == pytest.approx(at_truth, rel=1e-12)


def grid_posterior():
    """Marginals of λ_gm and μ_wm on a grid about the truth that holds all of the mass."""
    energy = oracle()
    lam, mu = np.linspace(2.8, 9.0, 32), np.linspace(1.2, 1.9, 32)
    log = -np.array([[energy(a, b) for b in mu] for a in lam])
    mass = np.exp(log - log.max())
    edge = max(mass[[0, -1]].max(), mass[:, [0, -1]].max())
    assert edge < 1e-4
    return [(axis, weights / weights.sum()) for axis, weights in ((lam, mass.sum(axis=1)), (mu, mass.sum(axis=0)))]


@pytest.mark.long
def test_draws_follow_the_posterior_on_a_grid():
    draws = br.sample(posterior(), "hmc", chains=4, draws=300, seed=0, warm_up=40, block=300, progress=False)
    diagnostics = convergence(draws.idata)
    sampled = draws.idata.posterior["lam"].values[..., 1], draws.idata.posterior["mu"].values[..., 2]
    ess = float(diagnostics.ess_bulk["lam"][1]), float(diagnostics.ess_bulk["mu"][2])
    for chain_draws, count, (axis, mass) in zip(sampled, ess, grid_posterior(), strict=True):
        mean = mass @ axis
        sd = np.sqrt(mass @ (axis - mean) ** 2)
        assert count > 400
        assert abs(chain_draws.mean() - mean) < 4 * sd / np.sqrt(count)
        assert chain_draws.std() == pytest.approx(sd, rel=4 / np.sqrt(2 * count))
    # Intervals contain the truth.
    for name, index, truth in (("lam", 1, LAM[1]), ("mu", 2, MU[2])):
        low, high = np.quantile(draws.idata.posterior[name].values[..., index], (0.025, 0.975))
        assert low < truth < high
        assert high - low < 0.1 * (RANGE[name][1] - RANGE[name][0])
    # No displacement is an estimand.
    assert draws.idata.posterior["u_boundary"].shape == (4, 300, 0, 3)
    boundary = MESH.boundary
    np.testing.assert_allclose(draws.u_mean[boundary], phantom()[3][boundary], rtol=1e-12)
    assert draws.u_sd[boundary].max() < 1e-12
    assert draws.u_sd[MESH.interior].min() > 0


def test_gradient():
    post = posterior()

    def density(log):
        return post.logdensity_constrained(values(*jnp.exp(log)))

    place, step = jnp.log(jnp.array([6.0, 1.2])), 1e-4
    differences = [(density(place + step * e) - density(place - step * e)) / (2 * step) for e in jnp.eye(2)]
    np.testing.assert_allclose(jax.grad(density)(place), differences, rtol=1e-5)


def test_a_part_of_the_boundary_is_not_enough():
    fixed, moving, _, u = phantom()
    held = {int(node): tuple(u[node].tolist()) for node in MESH.boundary[1:]}
    priors = {name: br.PriorConfig(high=9.0) for name in RANGE}
    with pytest.raises(ValueError, match=rf"needs every boundary node held .* 1 of {len(MESH.boundary)} are not"):
        posterior_of(fixed, moving, MESH, sampled=[], held=held, priors=priors)


def test_a_flat_prior_would_be_improper():
    """The images have a limit where λ goes to infinity, and E_r is not there to bound it."""
    with pytest.raises(ValueError, match="a given boundary needs a prior with a finite high"):
        posterior(priors={})


def test_a_given_boundary_has_no_normaliser():
    with pytest.raises(ValueError, match="expected false where no node is sampled"):
        posterior(normalised=True)
