"""The map from the real line to the range of λ and μ, against SciPy's Normal distribution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import betaln

from bayesreg.model.priors import RangeTransform, ScaledBeta
from tests.options import posterior_of
from tests.phantoms import box_mesh, smooth_image

Z = np.array([-9.0, -7.9, -6.5, -3.0, -0.5, 0.0, 0.7, 2.0, 7.0])


def unbounded(low=0.0, scale=0.01):
    return RangeTransform(jnp.asarray(low), jnp.asarray(jnp.inf), jnp.asarray(scale))


def test_a_bounded_range_is_reached_by_the_distribution_function():
    to_range = RangeTransform(jnp.asarray(0.5), jnp.asarray(40.0))
    np.testing.assert_allclose(to_range(Z), 0.5 + 39.5 * stats.norm.cdf(Z), rtol=1e-12)
    np.testing.assert_allclose(to_range.inv(to_range(Z[3:8])), Z[3:8], atol=1e-12)
    # A flat prior there is the standard Normal density of z.
    expected = stats.norm.logpdf(Z) + np.log(39.5)
    np.testing.assert_allclose(to_range.log_abs_det_jacobian(Z, to_range(Z)), expected, rtol=1e-12)


def test_a_range_without_end_is_that_of_an_exponential_distribution():
    to_range = unbounded(low=2.0, scale=3.0)
    np.testing.assert_allclose(to_range(Z), 2 - 3 * stats.norm.logsf(Z), rtol=1e-12)
    np.testing.assert_allclose(stats.expon.logsf(to_range(Z), 2, 3), stats.norm.logsf(Z), rtol=1e-12, atol=1e-12)
    steep = jax.vmap(jax.grad(unbounded()))(jnp.asarray(Z))
    np.testing.assert_allclose(unbounded().log_abs_det_jacobian(Z, unbounded()(Z)), np.log(steep), rtol=1e-11)


def test_both_tails_are_followed_far_out():
    """Also where Φ(−z) is next to zero, and beyond."""
    z = np.array([-35.0, -25.0, 12.0, 29.99, 30.01, 45.0, 1e3])
    np.testing.assert_allclose(unbounded(scale=1.0)(z), -stats.norm.logsf(z), rtol=1e-12)
    slopes = jax.vmap(jax.grad(unbounded(scale=1.0)))(jnp.asarray(z))
    np.testing.assert_allclose(slopes, np.exp(stats.norm.logpdf(z) - stats.norm.logsf(z)), rtol=1e-10)
    # The difference of two logarithms of 5 · 10⁵.
    np.testing.assert_allclose(unbounded().log_abs_det_jacobian(z, z), np.log(0.01 * slopes), atol=1e-10)
    bounded = RangeTransform(jnp.asarray(0.0), jnp.asarray(2.0))
    np.testing.assert_allclose(bounded(z[:3]), 2 * stats.norm.cdf(z[:3]), rtol=1e-12)
    # Φ(−z) / φ(z) is 1/z − 1/z³ + 3/z⁵ − …: the slope z + 1/z − 2/z³, the second derivative 1 − 1/z² + 6/z⁴.
    steep, far = unbounded(scale=1.0), jnp.asarray(1e4)
    assert float(jax.grad(steep)(far)) == pytest.approx(1e4 + 1e-4, rel=1e-15)
    assert float(jax.grad(jax.grad(steep))(far)) == pytest.approx(1 - 1e-8, rel=1e-12)


@pytest.mark.parametrize("above", [1e-30, 1e-9, 1e-3, 0.4, 0.6, 1.0, 1e2, 599.0, 601.0, 1e9, 1.3e19, 1e30])
def test_it_is_inverted_over_many_decades(above):
    z = unbounded().inv(jnp.asarray(0.01 * above))
    assert float(unbounded()(z)) == pytest.approx(0.01 * above, rel=1e-9, abs=0)
    assert np.sign(float(z)) == np.sign(above - np.log(2))


def test_a_flat_density_falls_off_as_a_normal_one_towards_the_bound():
    """At twice the distance log p is four times as low; under a logarithm twice."""
    z = np.array([-10.0, -20.0])
    near, far = unbounded().log_abs_det_jacobian(z, unbounded()(z)) - np.log(0.01)
    assert far / near == pytest.approx(4, rel=0.05)


def test_bounded_and_unbounded_entries_stand_beside_each_other():
    """With derivatives of any order: what is not taken is finite."""
    low, high, scale = (jnp.array(x) for x in ([0.0, 1.0], [jnp.inf, 3.0], [0.1, 50.0]))
    to_range, z = RangeTransform(low, high, scale), jnp.array([4.0, -4.0])
    apart = [RangeTransform(*(x[k] for x in (low, high, scale))) for k in range(2)]
    x = to_range(z)
    np.testing.assert_array_equal(x, [each(z[k]) for k, each in enumerate(apart)])
    np.testing.assert_allclose(to_range.inv(x), z, rtol=1e-9)
    slopes = jax.vmap(lambda e: jax.jvp(to_range, (z,), (e,))[1])(jnp.eye(2))
    inverse = jax.jacrev(to_range.inv)(x)
    np.testing.assert_allclose(inverse @ slopes, np.eye(2), atol=1e-6)
    assert np.isfinite(jax.jacfwd(jax.jacrev(lambda z: to_range.log_abs_det_jacobian(z, to_range(z)).sum()))(z)).all()


def test_no_value_rounds_to_a_bound_at_which_a_density_is_infinite():
    to_range, prior = (
        RangeTransform(jnp.asarray(0.0), jnp.asarray(5.0)),
        ScaledBeta(*map(jnp.asarray, (1.0, 0.2, 0.0, 5.0))),
    )
    assert np.isfinite(prior.log_prob(to_range(jnp.asarray([8.0, 9.0, 40.0])))).all()


def test_a_prior_is_the_same_after_a_round_trip_as_a_pytree():
    prior = ScaledBeta(*map(jnp.asarray, (2.0, 3.0, 0.0, 5.0)))
    expected = stats.beta.logpdf(1.0, 2, 3, 0, 5)
    assert float(jax.jit(lambda prior: prior.log_prob(jnp.ones(())))(prior)) == pytest.approx(expected, rel=1e-12)
    with_constant = ScaledBeta(*map(jnp.asarray, (2.0, 3.0, 0.0, 5.0)), jnp.asarray(betaln(2.0, 3.0)))
    assert float(jax.tree.map(lambda x: x, with_constant).log_prob(jnp.ones(()))) == pytest.approx(expected, rel=1e-12)


def test_the_scale_is_the_reference():
    mesh = box_mesh(2)
    images = (smooth_image(mesh.points, seed=seed) for seed in (1, 2))
    priors = {"lam": {"low": 1.0}, "mu": {"high": 8.0}}
    reference = {"lam": np.array([3.0, 0.5, 30.0]), "mu": np.ones(3)}
    posterior = posterior_of(*images, mesh, reference=reference, priors=priors)
    median = {**posterior.unconstrain(posterior.reference()), "lam": jnp.zeros(3), "mu": jnp.zeros(2)}
    values = posterior.constrain(median)
    np.testing.assert_allclose(values["lam"], 1 + np.log(2) * reference["lam"])
    # μ of GM is known.
    np.testing.assert_allclose(values["mu"], [4.0, 1.0, 4.0])
