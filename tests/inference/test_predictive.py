"""Posterior draws pushed forward, against NumPy on all of them at once."""

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from bayesreg.inference.draws import predictive
from bayesreg.inference.draws.predictive import push_forward, summarise, thin
from bayesreg.model.observations.images.report import predictive_p

DRAWS = {"u": np.random.default_rng(0).gamma(2.0, size=(3, 50, 4)), "scale": np.linspace(1, 2, 150).reshape(3, 50)}


def function(draw, _=None):
    return {"scaled": jnp.sort(draw["u"]) * draw["scale"], "exceeds": (draw["u"] > 2).astype(float)}


def expected():
    return {"scaled": np.sort(DRAWS["u"], axis=-1) * DRAWS["scale"][..., None], "exceeds": (DRAWS["u"] > 2) * 1.0}


@pytest.mark.parametrize("block", [1, 7, 21, 1000])
def test_every_draw_is_evaluated_once_and_in_order(block):
    batches = list(push_forward(function, DRAWS, block=block))
    for name, values in expected().items():
        np.testing.assert_allclose(np.concatenate([batch[name] for batch in batches], axis=1), values, rtol=1e-14)


def test_mean_sd_and_quantiles_are_those_of_all_draws():
    summary = summarise(push_forward(function, DRAWS, block=21), (0.1, 0.5, 0.9))
    for name, values in expected().items():
        np.testing.assert_allclose(summary.mean[name], values.mean((0, 1)), rtol=1e-12)
        np.testing.assert_allclose(summary.sd[name], values.reshape(150, -1).std(axis=0, ddof=1), rtol=1e-12)
        np.testing.assert_allclose(summary.chain_mean[name], values.mean(1), rtol=1e-12)
        np.testing.assert_allclose(summary.quantiles[name], np.quantile(values, (0.1, 0.5, 0.9), (0, 1)))


def test_memory_is_bounded_and_quantiles_still_come_from_evenly_spaced_draws(monkeypatch):
    monkeypatch.setattr(predictive, "MOST_KEPT", 8)
    ramp = {"x": np.tile(np.arange(50.0), (2, 1))}
    summary = summarise(push_forward(lambda draw, factor: factor * draw["x"], ramp, 1.0, block=6), (0.0, 1.0))
    # 8 of 50 are draws 0, 8, …, 48 by way of strides 2 and 4.
    np.testing.assert_array_equal(summary.quantiles, [0, 48])
    assert summary.mean == pytest.approx(24.5)


def test_thinned_draws_are_evenly_spaced_and_at_most_so_many():
    posterior = xr.Dataset({"a": (("draw", "chain", "k"), np.arange(300.0).reshape(50, 3, 2))})
    some = thin(posterior, ["a"], 16)["a"]
    assert some.shape == (3, 5, 2)
    np.testing.assert_array_equal(some[1, :, 0], posterior["a"].isel(chain=1, k=0, draw=[5, 15, 25, 35, 45]))
    assert thin(posterior, ["a"], 10_000)["a"].shape == (3, 50, 2)
    assert thin(posterior, ["a"], 1)["a"].shape == (3, 1, 2)


def test_nothing_to_summarise_is_refused():
    with pytest.raises(ValueError, match="no draw"):
        summarise([])


def test_predictive_p_of_a_gaussian_model_is_that_of_the_closed_form():
    rng = np.random.default_rng(1)
    # y ~ N(θ, 1), flat prior: θ | y ~ N(y, 1); the discrepancy y − θ is N(0, 1) before and after.
    assert predictive_p(rng.normal(size=40_000), rng.normal(size=40_000)) == pytest.approx(0.5, abs=0.01)
    assert predictive_p(rng.normal(2, 1, 40_000), rng.normal(size=40_000)) == pytest.approx(0.0786, abs=0.006)
    assert predictive_p(np.zeros(3), np.zeros(3)) == 1.0
