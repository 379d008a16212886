import math
import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import bayesreg as br
from bayesreg.report import verdict as verdict_module
from bayesreg.report.estimands import Estimand
from bayesreg.report.verdict import (
    approximation,
    decimal_text,
    duration,
    key_facts,
    number,
    percent,
    verdict,
    warnings_of,
)
from tests.phantoms import box_mesh


def entry(rhat: float, bulk: float = 500.0, tail: float = 400.0, name: str = "u_x of node 7") -> Estimand:
    return Estimand("u_boundary", (0, 0), name, (1.0, -20.4, 3.0), rhat, bulk, tail)


def stopped(reason: str = "the budget of 60 s was spent", threshold: float = 1.2, converged: bool = False) -> dict:
    return {"stopped": {"reason": reason, "converged": converged, "rhat_threshold": threshold}}


def elastic(lam: list[float], mu: list[float]) -> xr.Dataset:
    dims = ("chain", "draw", "tissue")
    spread = np.array([0.9, 1.0, 1.1])[None, :, None]
    return xr.Dataset({"lam": (dims, spread * lam), "mu": (dims, np.ones_like(spread) * mu)})


def test_converged_only_if_every_estimand_is_below_the_threshold():
    judgement = verdict(stopped("R̂ is below 1.2", converged=True), [entry(1.01), entry(1.19, name="λ gm")])
    assert judgement.converged
    assert judgement.headline.startswith("Converged: R̂ is below 1.2 for all 2 estimands; the greatest is 1.190 (λ gm")
    assert judgement.detail == "It stopped because R̂ is below 1.2."


def test_one_estimand_above_is_not_converged_whatever_the_manifest_says():
    judgement = verdict(stopped(converged=True), [entry(1.01)] * 9 + [entry(1.2)])
    assert not judgement.converged
    assert "Not converged: R̂ is 1.2 or more for 1 of 10 estimands" in judgement.headline
    assert "u_x of node 7 at (1, −20, 3) mm" in judgement.headline
    assert "the budget of 60 s was spent" in judgement.detail
    assert "not the posterior" in judgement.detail


@pytest.mark.parametrize("rhat", [math.nan, math.inf])
def test_undefined_figures_are_not_converged(rhat):
    judgement = verdict(stopped(), [entry(1.0), entry(rhat)])
    assert not judgement.converged
    assert ("undefined" if math.isnan(rhat) else "infinite") in judgement.headline


def test_nothing_sampled_is_not_converged():
    assert not verdict(stopped(), []).converged


def test_few_effective_draws_are_admitted_even_when_converged():
    manifest = stopped(converged=True)
    assert "effective sample size is only 35" in verdict(manifest, [entry(1.0), entry(1.0, bulk=35.2)]).detail
    assert "effective" not in verdict(manifest, [entry(1.0)]).detail


def test_a_run_whose_own_rule_says_no_has_not_converged():
    manifest = stopped() | {"convergence": {"rhat_paper_max": 1.4321}}
    judgement = verdict(manifest, [entry(1.01)])
    assert not judgement.converged
    assert "unsplit, as in the paper) is 1.432, asked for 1.2" in judgement.headline
    assert "not the posterior" in judgement.detail


def test_without_a_stop_rule_the_estimands_decide():
    manifest = {"stopped": {"reason": "all draws are taken", "converged": None, "rhat_threshold": None}}
    assert verdict(manifest, [entry(1.005)]).converged
    assert not verdict(manifest, [entry(1.015)]).converged
    assert "none asked for" in key_facts(manifest, [entry(1.0)], elastic([1.0], [1.0]))["Greatest R̂"]


def test_key_facts_hold_the_numbers_of_the_manifest():
    manifest = stopped() | {
        "acceptance": {"overall": 0.0871, "inside_support": 0.243},
        "contact_nodes": 17,
        "solver": {"failed": 1234, "iterations_mean": 14.2},
        "timings": {"total": 3725.0, "sampling": 61.0},
        "steps_per_second_per_chain": 63.4,
        "residual_sd": 0.0151,
        "implied_noise_sd": 0.0146,
        "convergence": {"rhat_paper_max": 2.3451},
    }
    entries = [entry(1.3, 12.0, 9.0), entry(1.1, 40.0, 33.0)]
    posterior = elastic([1.0], [1.0])
    facts = key_facts(manifest, entries, posterior)
    assert facts == {
        "Greatest R̂": "1.300 (asked for 1.2; unsplit, as in the paper, 2.345)",
        "Least ESS, bulk": "12",
        "Least ESS, tail": "9.0",
        "Chains × draws": "1 × 3",
        "Acceptance inside the support": "24.3 %",
        "Acceptance in all": "8.7 %",
        "Nodes in contact with the skull": "17",
        "Failed elastic solves": "1,234",
        "Iterations of a solve": "14.2",
        "Time in all": "1 h 02 min",
        "Time of sampling": "1 min 01 s",
        "Steps per second and chain": "63.4",
        "Sd of the residual": "0.0151 (T_s implies 0.0146)",
    }


def test_an_empty_manifest_gives_dashes():
    facts = key_facts({}, [], elastic([1.0], [1.0]))
    assert {facts[name] for name in ("Acceptance in all", "Time in all", "Failed elastic solves", "Greatest R̂")} == {
        "–"
    }


def test_warnings_about_the_data_come_first():
    manifest = {"appraisal": {"warnings": ["The images are hardly alike."]}, "inverted_elements": 1}
    first, second = warnings_of(manifest, box_mesh(), elastic([1.0] * 3, [1.0] * 3))
    assert first == "The images are hardly alike."
    assert second.startswith("1 tetrahedron")


@pytest.mark.parametrize(
    ("ratio", "expected"), [(2.0, "too narrow. A T_s 4.0 times"), (0.5, "too wide. A T_s 0.25 times")]
)
def test_a_residual_that_does_not_fit_t_s_is_warned_of(ratio, expected):
    manifest = {"residual_to_noise": ratio, "implied_noise_sd": 0.0146}
    assert any(expected in text for text in warnings_of(manifest, box_mesh(), elastic([1.0] * 3, [1.0] * 3)))


def test_a_residual_that_fits_is_not():
    manifest = {"residual_to_noise": 1.03, "implied_noise_sd": 0.0146, "exact": True, "solver": {"failed": 0}}
    assert warnings_of(manifest, box_mesh(), elastic([1.0, 10.0, 20.0], [1.0] * 3)) == []


def test_locking_names_the_tissue_and_poissons_ratio():
    (text,) = warnings_of({}, box_mesh(), elastic([1.0, 10.0, 30.0], [1.0] * 3))
    assert "Poisson’s ratio of WM is 0.484" in text
    assert warnings_of({}, box_mesh(), elastic([30.0], [1.0]))[0].startswith("Poisson’s ratio of the whole organ")


def test_failed_solves_are_warned_of():
    quiet = elastic([1.0] * 3, [1.0] * 3)
    (text,) = warnings_of({"solver": {"failed": 3}}, box_mesh(), quiet)
    assert text.startswith("3 elastic solves failed")


def test_options_that_advice_names_exist():
    """Every dotted name in the source of the advice is a key of a configuration."""
    config = br.load_config(Path(__file__).parents[2] / "configs" / "quickstart.yaml")
    source = Path(verdict_module.__file__).read_text()
    named = set(re.findall(rf"\(({'|'.join(type(config).model_fields)})\.(\w+)\)", source))
    assert {("model", "priors"), ("start", "field")} <= named
    for section, key in named:
        assert key in type(getattr(config, section)).model_fields, (section, key)


def test_folded_tetrahedra_are_warned_of():
    quiet = elastic([1.0] * 3, [1.0] * 3)
    assert warnings_of({"inverted_elements": 0}, box_mesh(), quiet) == []
    (text,) = warnings_of({"inverted_elements": 3}, box_mesh(), quiet)
    assert text.startswith("3 tetrahedra are turned inside out")


def test_only_an_approximate_sampler_is_called_so():
    text = approximation({"exact": False, "sampler": {"name": "laplace"}})
    assert "laplace" in text
    assert "too narrow or too wide" in text
    assert approximation({"exact": True}) == approximation({}) == ""


def test_the_worst_estimand_is_named_with_its_region():
    judgement = verdict(stopped(), [entry(1.3)._replace(region="left posterior, GM")])
    assert "u_x of node 7 at (1, −20, 3) mm, left posterior, GM" in judgement.headline


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (1234.5, "1,234"),
        (-1234.5, "−1,234"),
        (6.08e23, "6.1e23"),
        (12.345, "12.3"),
        (-0.5, "−0.500"),
        (1e-6, "1e−06"),
        (math.nan, "–"),
        (None, "–"),
    ],
)
def test_numbers(value, text):
    assert number(value) == text


def test_other_formats():
    assert decimal_text(2.4) == "2.40"
    assert decimal_text(None) == "–"
    assert percent(0.0871) == "8.7 %"
    assert [duration(x) for x in (4.26, 59.0, 119.6, 3725.0, None)] == [
        "4.3 s",
        "59 s",
        "2 min 00 s",
        "1 h 02 min",
        "–",
    ]


def test_too_few_effective_draws_are_named():
    manifest = {
        "stopped": {"converged": False, "rhat_threshold": 1.01, "ess_threshold": 400.0},
        "convergence": {"ess_bulk_min": 512.3, "ess_tail_min": 380.2},
    }
    judgement = verdict(manifest, [entry(1.004)])
    assert not judgement.converged
    assert "the least ESS is 512 (bulk) and 380 (tail), asked for more than 400" in judgement.headline
