"""The field of log-stiffness: its prior against dense normals, its density against that of parameters by element."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg, stats

import bayesreg as br
from bayesreg.model import field
from bayesreg.model.options import FieldConfig
from tests.options import posterior_of
from tests.phantoms import LAM, MU, ball_mesh, box_mesh, smooth_image

MESH = ball_mesh(spacing=24.0)
MODES = 30


def by_tissue(values):
    return {name: float(value) for name, value in zip(MESH.names, values, strict=True)}


def posterior(elasticity="field", **options):
    fixed, moving = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    field_options = {"field": FieldConfig(modes=MODES, correlation=30.0)} if elasticity == "field" else {}
    settings = {"t_similarity": 5.0, "t_elastic": 100.0, "interpolation": "cubic", "fixed": {"mu": by_tissue(MU)}}
    return posterior_of(fixed, moving, MESH, elasticity=elasticity, **(field_options | settings | options))


@cache
def example():
    return posterior()


def values(seed=0, u_sd=1.0):
    rng = np.random.default_rng(seed)
    return {
        "u_boundary": jnp.asarray(u_sd * rng.normal(size=(len(MESH.boundary), 3))),
        "lam": jnp.asarray(LAM),
        "mu": jnp.asarray(MU),
        "field": jnp.asarray(rng.normal(size=MODES)),
        "field_sd": jnp.asarray(0.6),
    }


def test_laplacian_is_the_sum_over_common_faces():
    """Every pair of elements, face by face."""
    s = np.random.default_rng(0).normal(size=len(MESH.cells))
    centres, expected = MESH.points[MESH.cells].mean(axis=1), 0.0
    for e, cell in enumerate(MESH.cells):
        for f in range(e):
            common = sorted(set(cell) & set(MESH.cells[f]))
            if len(common) == 3:
                a, b, c = MESH.points[common]
                area = np.linalg.norm(np.cross(b - a, c - a)) / 2
                expected += area / np.linalg.norm(centres[e] - centres[f]) * (s[e] - s[f]) ** 2
    assert s @ field.face_laplacian(MESH) @ s == pytest.approx(expected, rel=1e-12)


def test_prior_is_a_dense_multivariate_normal():
    """With all components, on the fields of mean zero in each tissue: SciPy's density of Nᵀs, N a basis of these."""
    size, tissues = len(MESH.cells), len(MESH.names)
    prior = field.stiffness_field(MESH, FieldConfig(correlation=30.0, modes=size))
    basis = np.asarray(prior.basis)
    assert basis.shape == (size, size - tissues)
    assert float(prior.share) == pytest.approx(1.0)
    means = np.array([(MESH.tissue == t) * MESH.volumes for t in range(tissues)])
    assert abs(means @ basis).max() < 1e-8 * abs(means).sum()
    N = linalg.null_space(means)
    Q = field.precision(MESH, 30.0).toarray()
    dense = stats.multivariate_normal(cov=linalg.inv(N.T @ Q @ N))
    log_volume = np.linalg.slogdet(N.T @ basis)[1]
    for z in np.random.default_rng(1).normal(size=(5, size - tissues)):
        log_density = stats.norm.logpdf(z).sum() - log_volume
        assert log_density == pytest.approx(dense.logpdf(N.T @ basis @ z), abs=1e-6)


def test_components_are_those_of_the_greatest_variance():
    most, all_of_them = (
        field.stiffness_field(MESH, FieldConfig(correlation=30.0, modes=modes)) for modes in (MODES, 1000)
    )
    variances = [MESH.volumes @ np.asarray(prior.basis) ** 2 for prior in (most, all_of_them)]
    assert (np.diff(variances[1]) < 1e-9 * variances[1].max()).all()
    np.testing.assert_allclose(variances[0], variances[1][:MODES], rtol=1e-8)
    assert float(most.share) == pytest.approx(variances[1][:MODES].sum() / variances[1].sum())
    assert 0.3 < float(most.share) < 1


def test_covariance_is_materns():
    """Summed over the reflections in the faces of a cube, exp(−κr): the field belongs to space, not to the mesh."""
    box, correlation = box_mesh(5, size=80.0), 30.0
    covariance = linalg.inv(field.precision(box, correlation).toarray())
    centres = box.points[box.cells].mean(axis=1)
    along = [np.concatenate([2 * 80.0 * k + sign * centres for k in (-1, 0, 1)]) for sign in (1, -1)]
    for middle in np.linalg.norm(centres - 40.0, axis=1).argsort()[:5]:
        expected = np.zeros(len(centres))
        for index in np.ndindex(6, 6, 6):
            image = [along[k % 2][len(centres) * (k // 2) + middle, axis] for axis, k in enumerate(index)]
            expected += np.exp(-2 * np.linalg.norm(centres - image, axis=1) / correlation)
        # The cells are 16 mm wide.
        apart = np.linalg.norm(centres - centres[middle], axis=1) > 16
        assert abs(covariance[middle] - expected)[apart].max() < 0.1
        assert abs((covariance[middle] - expected)[apart].mean()) < 0.02


def test_density_is_that_of_parameters_by_element():
    """E_s, E_r and the normaliser, with λ_e = λ_t exp(s_e) and μ_e alike; besides them only the priors."""
    options = {"normalised": True, "priors": {"lam": br.PriorConfig(high=100.0), "mu": br.PriorConfig(high=100.0)}}
    field_posterior, state = posterior(**options), values()
    factor = np.exp(0.6 * np.asarray(field_posterior.data.body.field.basis) @ np.asarray(state["field"]))
    np.testing.assert_allclose(field_posterior.data.body.stiffness_factor(state), factor, rtol=1e-12)
    lam, mu = (jnp.asarray(entries[MESH.tissue] * factor) for entries in (LAM, MU))
    element = posterior("element", **options | {"fixed": {"mu": by_tissue(MU)}})
    element = element.energies({"u_boundary": state["u_boundary"], "lam": lam, "mu": mu})
    energies = field_posterior.energies(state)
    for name in ("similarity_energy", "strain_energy", "images", "elastic"):
        assert float(energies[name]) == pytest.approx(float(element[name]), rel=1e-8), name
    assert float(energies["prior_field"]) == pytest.approx(stats.norm.logpdf(state["field"]).sum())
    assert float(energies["prior_field_sd"]) == pytest.approx(stats.halfnorm(scale=0.5).logpdf(0.6))
    total = sum(float(value) for name, value in energies.items() if not name.endswith("_energy"))
    assert float(field_posterior.logdensity_constrained(state)) == pytest.approx(total, rel=1e-10)


def test_positions_and_values_are_two_names_of_one_state():
    position = example().unconstrain(values())
    assert float(position["field_sd"]) == pytest.approx(np.log(0.6))
    constrained = example().constrain(position)
    for name, value in values().items():
        np.testing.assert_allclose(constrained[name], value, rtol=1e-12)
    # The Jacobian of λ (three entries) and log sd.
    slopes = jax.jacobian(lambda z: example().constrain({**position, "lam": z})["lam"])(position["lam"])
    jacobian = np.linalg.slogdet(slopes)[1] + np.log(0.6)
    expected = float(example().logdensity_constrained(values())) + jacobian
    assert float(example().logdensity(position)) == pytest.approx(expected, rel=1e-12)


def test_gradient_against_differences():
    position = example().unconstrain(values())
    density = jax.jit(example().logdensity)
    gradient = jax.grad(density)(position)
    rng = np.random.default_rng(2)
    for name, value in position.items():
        direction = jnp.asarray(rng.normal(size=value.shape))

        def at(t, name=name, direction=direction):
            return float(density(position | {name: position[name] + t * direction}))

        difference = (8 * (at(1e-4) - at(-1e-4)) - (at(2e-4) - at(-2e-4))) / 1.2e-3
        assert float((gradient[name] * direction).sum()) == pytest.approx(difference, rel=1e-5), name


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_curvature_is_gauss_newtons(share):
    """dᵀHd = 2s/T_s Σ w (∂r/∂d)² + |d_z|² + 2 E_r(d_u)/T_r with a share s of independent points; ∂r by differences."""
    post, place = example(), values(u_sd=0.3)
    images, estimands = post.images._replace(independent_share=jnp.asarray(share)), post.estimands(place)
    data = post.data.with_term("images", images)
    H = post.target.mode_search.curvature(data, estimands).gauss_newton
    assert H.shape == (MODES + 3 * len(MESH.boundary),) * 2
    assert np.linalg.eigvalsh(H).min() > -1e-6 * np.trace(H)
    residuals = jax.jit(lambda v: post.images.residuals(post.evaluate(v).u))
    rng = np.random.default_rng(3)
    for weights in ((1.0, 0.0), (0.0, 1.0), (1.0, 0.2)):
        d = {name: w * jnp.asarray(rng.normal(size=place[name].shape)) for name, w in zip(KEYS, weights, strict=True)}

        def moved(t, d=d):
            return place | {name: place[name] + t * d[name] for name in KEYS}

        slope = (residuals(moved(1e-4)) - residuals(moved(-1e-4))) / 2e-4
        # E_r is quadratic in u_B.
        still = {"u_boundary": d["u_boundary"]}
        energy = post.evaluate(place | still).strain_energy
        expected = (
            2 * share / 5.0 * (images.quadrature.weights @ slope**2) + (d["field"] ** 2).sum() + 2 * energy / 100.0
        )
        flat = np.concatenate([np.ravel(d[name]) for name in KEYS])
        assert flat @ H @ flat == pytest.approx(float(expected), rel=1e-5)


KEYS = ("field", "u_boundary")


def test_a_stiffness_that_is_not_finite_has_no_density():
    for name, value in (("field_sd", 1e6), ("field_sd", -0.1)):
        evaluation = example().evaluate(values() | {name: jnp.asarray(value)})
        assert float(evaluation.logdensity) == -np.inf
        assert bool(evaluation.outside_support)


def test_the_random_walk_of_the_paper_has_no_step_for_a_field():
    with pytest.raises(ValueError, match="no step for field, field_sd"):
        br.sample(example(), "rwmh", chains=2, draws=2, progress=False)


def test_a_field_needs_its_elasticity_and_a_mesh_that_is_not_too_fine(monkeypatch):
    with pytest.raises(ValueError, match="it belongs to elasticity: field, which is tissue here"):
        br.ModelConfig(field=FieldConfig())
    monkeypatch.setattr(field, "DENSE_LIMIT", 50)
    with pytest.raises(ValueError, match="a mesh of at most 50 elements, this one has"):
        posterior()
