"""Log-normal priors of λ and μ against SciPy, and the default priors of tissues."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import bayesreg as br
from bayesreg.model.options import PriorConfig
from bayesreg.model.problem import lame_parameter
from bayesreg.settings import ScalePrior
from tests.options import posterior_of
from tests.phantoms import box_mesh, of_one_tissue, smooth_image

MESH = box_mesh(2)
NAMES = MESH.names
# λ of the three tissues has a log-normal, a Beta and a flat prior.
MIXED = {NAMES[0]: {"median": 3.0, "log_sd": 0.5}, NAMES[1]: {"alpha": 2.0, "beta": 3.0, "high": 40.0}}
REGISTRATION = br.ModelConfig(preset="registration")


def block_of(name="lam", mesh=MESH, **options):
    return lame_parameter(name, mesh, br.ModelConfig(**options), None)


def named(*names: str) -> br.TetMesh:
    """The box with these tissues."""
    return br.TetMesh.from_arrays(MESH.points, MESH.cells, np.arange(len(MESH.cells)) % len(names), names)


def medians(name: str, mesh: br.TetMesh, **options) -> dict[str, float]:
    block = block_of(name, mesh, preset="registration", **options)
    return dict(zip(mesh.names, np.asarray(block.median), strict=True))


def test_the_density_of_every_kind_of_prior_is_scipys():
    images = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    posterior = posterior_of(*images, MESH, priors={"lam": MIXED, "mu": ScalePrior(median=0.8, log_sd=0.7)})
    values = {**posterior.reference(), "lam": np.array([2.2, 17.0, 5.0]), "mu": np.array([0.1, 1.0, 2.5])}
    terms = posterior.energies(values)
    of_lam = stats.lognorm.logpdf(2.2, 0.5, scale=3.0) + stats.beta.logpdf(17.0, 2, 3, 0, 40)
    # μ of the middle tissue is known.
    of_mu = stats.lognorm.logpdf([0.1, 2.5], 0.7, scale=0.8).sum()
    assert float(terms["prior_lam"]) == pytest.approx(of_lam, rel=1e-12)
    assert float(terms["prior_mu"]) == pytest.approx(of_mu, rel=1e-12)
    for name, entry in (("lam", 0), ("mu", 2)):
        outside = {**values, name: values[name].copy()}
        outside[name][entry] = 0.0
        assert float(posterior.logdensity_constrained(outside)) == -np.inf


@pytest.mark.parametrize("priors", [MIXED, {"median": 3.0, "log_sd": 0.5}], ids=["mixed", "log-normal"])
def test_scores_are_mapped_and_back_with_the_volume_of_differences(priors):
    block, z, h = block_of(priors={"lam": priors}), jnp.array([-1.7, 0.4, 2.1]), 1e-5
    lam, log_jacobian = block.constrain(z)
    assert float(lam[0]) == pytest.approx(3 * np.exp(-0.5 * 1.7))
    np.testing.assert_allclose(block.unconstrain(lam), z, rtol=1e-10)
    slopes = (block.constrain(z + h)[0] - block.constrain(z - h)[0]) / (2 * h)
    assert float(log_jacobian) == pytest.approx(float(jnp.log(slopes).sum()), abs=1e-8)
    # Where all is log-normal, the prior of the scores is N(0, 1), whose curvature is one.
    density = float(block.prior().log_prob(lam) + log_jacobian)
    if priors is not MIXED:
        assert density == pytest.approx(stats.norm.logpdf(z).sum(), rel=1e-12)
    np.testing.assert_array_equal(block.least_curvature(z)[:2], 1.0)


def test_no_derivative_takes_a_branch_that_is_not_its_own():
    """Also at the lower bound of a Beta prior, where a logarithm has none."""
    block = block_of(priors={"lam": MIXED})
    slopes = jax.grad(lambda lam: block.prior().log_prob(lam))(jnp.array([1.0, 0.0, 2.0]))
    assert np.isfinite(np.asarray(slopes)[[0, 2]]).all()
    scores = jax.jacrev(block.unconstrain)(jnp.array([1.0, 1e-12, 2.0]))
    assert np.isfinite(scores).all()
    assert np.isfinite(jax.jacfwd(jax.jacrev(lambda z: block.constrain(z)[1]))(jnp.array([4.0, -4.0, 9.0]))).all()


def test_draws_of_a_solid_have_the_poissons_ratios_that_the_docs_state():
    """For a μ that is known, and for one that is not."""
    mesh = named("liver", "rest")
    draws = {
        name: np.asarray(block_of(name, mesh, preset="registration").prior().sample(jax.random.key(k), (200_000,)))
        for k, name in enumerate(("lam", "mu"))
    }
    for ratio in (draws["lam"][:, 0], draws["lam"][:, 1] / draws["mu"][:, 1]):
        nu = ratio / (2 * (ratio + 1))
        np.testing.assert_allclose(np.quantile(nu, (0.025, 0.5, 0.975)), (0.336, 0.462, 0.493), atol=0.002)
        assert np.mean(nu > 0.48) == pytest.approx(0.22, abs=0.005)
        assert np.mean((nu > 0.3) & (nu < 0.495)) == pytest.approx(0.98, abs=0.002)
    np.testing.assert_allclose(np.quantile(draws["mu"][:, 1], (0.025, 0.975)), np.exp([-1.372, 1.372]), rtol=0.01)


def test_the_names_of_tissues_tell_their_stiffness():
    brain = named("CSF", "gm", "tumour_core", "something")
    assert medians("mu", brain) == {"CSF": 0.05, "gm": 1.0, "tumour_core": 1.5, "something": 1.0}
    assert medians("lam", brain) == pytest.approx({"CSF": 0.05, "gm": 12.0, "tumour_core": 18.0, "something": 12.0})
    block = block_of("mu", brain, preset="registration")
    np.testing.assert_array_equal(block.free.is_in, [True, False, True, True])
    np.testing.assert_array_equal(block.log_sd, 0.7)
    # Chains start at the medians.
    np.testing.assert_array_equal(block.reference(), block.median)


def test_stiffness_is_relative_to_what_is_known():
    brain = named("csf", "gm", "tumour")
    assert medians("mu", brain, fixed={"mu": {"tumour": 3.0, "csf": 0.01}})["gm"] == pytest.approx(2.0)
    assert medians("lam", brain, fixed={"mu": {"tumour": 3.0}}) == pytest.approx({"csf": 0.1, "gm": 24, "tumour": 36})
    # λ follows a given μ.
    given = {"mu": {"tumour": ScalePrior(median=4.0, log_sd=0.3)}}
    assert medians("lam", brain, priors=given)["tumour"] == pytest.approx(48.0)
    log_sd = np.asarray(block_of("lam", brain, preset="registration", priors=given).log_sd)
    np.testing.assert_allclose(log_sd, np.sqrt(0.81 - np.array([0.49, 0.0, 0.09])))


def test_given_priors_replace_the_defaults_entry_by_entry():
    brain = named("csf", "gm", "tumour")
    given = {"mu": {"tumour": {"high": 9.0}}, "lam": {"median": 5.0, "log_sd": 0.4}}
    lam, mu = (block_of(name, brain, preset="registration", priors=given) for name in ("lam", "mu"))
    np.testing.assert_array_equal(mu.log_normal.is_in, [True, True, False])
    assert (float(mu.high[2]), float(mu.median[0])) == (9.0, 0.05)
    np.testing.assert_array_equal(lam.median, 5.0)
    with pytest.raises(ValueError, match=r"names \['bone'\]"):
        block_of("mu", brain, preset="registration", priors={"mu": {"bone": {"high": 9.0}}})


@pytest.mark.parametrize("elasticity", ["uniform", "element", "field"])
def test_every_elasticity_has_default_priors(elasticity):
    brain = named("csf", "gm", "tumour")
    lam = block_of("lam", brain, preset="registration", elasticity=elasticity)
    by_tissue = np.array([0.05, 12.0, 18.0])
    expected = {"uniform": [12.0], "element": by_tissue[brain.tissue], "field": by_tissue}[elasticity]
    np.testing.assert_allclose(lam.median, expected)
    assert lam.log_normal.is_in.all()


def test_one_tissue_has_a_stiffness_relative_to_itself():
    fluid = block_of("lam", of_one_tissue(MESH), preset="registration", elasticity="uniform")
    assert (float(fluid.median[0]), float(fluid.log_sd[0])) == (12.0, 0.9)
    assert np.isfinite(fluid.bounds()).all()


def test_the_papers_preset_has_flat_priors_as_before():
    paper = br.ModelConfig()
    assert paper.with_default_priors(NAMES) is paper
    block = block_of()
    assert not block.log_normal.is_in.any()
    np.testing.assert_array_equal(block.high, np.inf)
    np.testing.assert_array_equal(block.reference(), lame_parameter("lam", MESH, paper, None).reference())


def test_defaults_are_proper_and_written_out():
    REGISTRATION.require_proper_priors(NAMES)
    written = REGISTRATION.with_default_priors(NAMES)
    assert written.with_default_priors(NAMES) == written
    assert br.ModelConfig(**written.model_dump(mode="json")) == written
    proper = {"kind": "boltzmann", "normalised": True}
    log_normal = {name: {"median": 1.0} for name in ("lam", "mu")}
    br.ModelConfig(elastic_prior=proper, priors=log_normal).require_proper_priors(NAMES)
    with pytest.raises(ValueError, match="or a log-normal one, for every free parameter, and mu of"):
        br.ModelConfig(elastic_prior=proper, priors={"lam": {"median": 1.0}}).require_proper_priors(NAMES)


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ({"median": 1.0, "high": 3.0}, "log-normal .* or a Beta prior .*, not both"),
        ({"liver": {"log_sd": 1.0, "alpha": 3.0}}, "log-normal .* or a Beta prior .*, not both"),
        ({"median": 0.0}, "greater than 0"),
        ({"log_sd": 1.0}, r"median\n.*required"),
        ({"liver": 3.0}, "liver"),
    ],
)
def test_priors_of_both_kinds_need_sense(prior, message):
    with pytest.raises(ValueError, match=message):
        br.ModelConfig(priors={"mu": prior})


def test_both_kinds_of_prior_are_taken_as_records_and_as_mappings():
    records = {"lam": PriorConfig(high=3.0), "mu": {"liver": ScalePrior(median=2.0, log_sd=0.5)}}
    mappings = {"lam": {"high": 3.0}, "mu": {"liver": {"median": 2.0, "log_sd": 0.5}}}
    assert br.ModelConfig(priors=records) == br.ModelConfig(priors=mappings)
