"""What effective draws cost, reckoned by hand."""

import arviz as az
import numpy as np
import pytest

import bayesreg as br
from studies.compare_samplers import efficiency as module
from studies.compare_samplers.efficiency import Budget, measure_efficiency, sampling_seconds
from tests.inference.gaussians import GaussianTarget

BUDGET = Budget(chains=3, draws=60, stop=br.StopRule(rhat=1.01, ess=1e6))


@pytest.fixture(scope="module")
def target():
    return GaussianTarget()


def test_figures_are_those_of_the_draws(target, monkeypatch):
    recorded = {}

    def sample(*args, **options):
        recorded["samples"] = br.sample(*args, **options)
        return recorded["samples"]

    monkeypatch.setattr(module, "sample", sample)
    efficiency = measure_efficiency(target, "rwmh", BUDGET, thin=4, block=20, sigma_u=0.4)
    draws = recorded["samples"].idata.posterior["u_boundary"]
    bulk, tail = (float(az.ess(draws, method=method).min()["u_boundary"]) for method in ("bulk", "tail"))
    assert (efficiency.ess_bulk, efficiency.ess_tail) == (pytest.approx(bulk), pytest.approx(tail))
    inside = 3 * 60 * 4 - int(recorded["samples"].tally.outside_support.sum())
    assert (efficiency.draws, efficiency.gradients, efficiency.densities) == (180, 0, inside)
    assert efficiency.ess_per_evaluation == pytest.approx(min(bulk, tail) / inside)
    assert efficiency.ess_per_second_in_all == pytest.approx(min(bulk, tail) / efficiency.seconds)
    assert 0 < efficiency.sampling_seconds < efficiency.seconds
    assert 0 < efficiency.preparing_seconds < efficiency.seconds
    assert efficiency.exact
    assert efficiency.seconds_to_rule is None


def test_time_to_the_rule_is_told_where_it_was_met(target):
    met = measure_efficiency(
        target, "rwmh", BUDGET._replace(stop=br.StopRule(rhat=9.0, min_draws=4)), block=10, sigma_u=0.4
    )
    assert met.seconds_to_rule == met.seconds
    assert met.draws == 30
    assert met.sampling_seconds is None


@pytest.mark.slow
def test_gradients_are_counted(target):
    """As many a draw as the trajectory of hmc has steps."""
    efficiency = measure_efficiency(target, "hmc", BUDGET._replace(draws=4), block=2, warm_up=5)
    assert efficiency.densities == 0
    assert efficiency.gradients % 12 == 0
    assert efficiency.gradients >= 12
    assert not measure_efficiency(target, "laplace", BUDGET._replace(draws=4), block=2).exact


def test_a_sampler_that_cannot_run_says_why(target):
    efficiency = measure_efficiency(target, "smc", BUDGET, particles=2)
    assert "particles must be at least as many" in efficiency.note
    assert efficiency.ess_per_second is None


def test_compilation_is_not_sampling():
    assert sampling_seconds([(10, 25.0), (20, 30.0), (30, 35.0)]) == pytest.approx(15.0)
    assert sampling_seconds([(10, 25.0)]) is None


def test_an_ess_that_is_not_known_has_no_rate():
    efficiency = measure_efficiency(GaussianTarget(), "rwmh", BUDGET._replace(draws=2), block=2, sigma_u=0.4)
    assert efficiency.ess_bulk is None
    assert efficiency.ess_per_second is None
    assert np.isfinite(efficiency.acceptance)
