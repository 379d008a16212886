import re

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from bayesreg.report.estimands import Diagnosed, Group
from bayesreg.report.identifiability import (
    Interval,
    log_figures,
    prior_of,
    ratio_reading,
    ratio_table,
    reading,
    readings,
    width_table,
)
from tests.phantoms import box_mesh

MESH = box_mesh(2)
DRAWS = 4000


def posterior_of(lam: np.ndarray, mu: np.ndarray, **temperatures: np.ndarray) -> xr.Dataset:
    """Two chains of λ and μ by tissue, (draws, 3) each."""
    dims = ("chain", "draw", "tissue")
    variables = {name: (dims, values.reshape(2, -1, 3)) for name, values in (("lam", lam), ("mu", mu))}
    scalars = {name: (dims[:2], values.reshape(2, -1)) for name, values in temperatures.items()}
    return xr.Dataset(variables | scalars, coords={"tissue": list(MESH.names)})


def diagnosed(lam: list[float], mu: list[float], **scalars: float) -> Diagnosed:
    rhat = xr.Dataset({"lam": ("tissue", lam), "mu": ("tissue", mu)} | {k: ((), v) for k, v in scalars.items()})
    return Diagnosed(rhat, rhat, rhat)


@pytest.fixture
def posterior():
    """CSF bounded from above, GM with μ fixed, WM with λ and μ together."""
    rng = np.random.default_rng(0)
    scale = np.exp(0.5 * rng.normal(size=DRAWS))
    ratio = 24 * np.exp(0.1 * rng.normal(size=DRAWS))
    lam = np.stack([rng.exponential(0.01, DRAWS), rng.normal(10, 0.5, DRAWS), ratio * scale], axis=1)
    mu = np.stack([rng.exponential(0.02, DRAWS), np.ones(DRAWS), scale], axis=1)
    return posterior_of(lam, mu, t_similarity=0.05 * np.exp(0.1 * rng.normal(size=DRAWS)))


@pytest.mark.parametrize(
    ("law", "parameter", "ratio"),
    [
        (stats.norm(10, 0.5), "identified", "identified"),
        (stats.uniform(0, 3), "only an upper bound", "only an upper bound"),
        (stats.expon(), "only an upper bound", "only an upper bound"),
        (stats.halfnorm(), "only an upper bound", "only an upper bound"),
        (stats.invgamma(1), "weakly identified", "only a lower bound"),
        (stats.lognorm(0.8), "weakly identified", "weakly identified"),
        (stats.lognorm(3.0), "only an upper bound", "not identified"),
    ],
)
def test_readings_of_known_laws(law, parameter, ratio):
    draws = law.ppf((np.arange(DRAWS) + 0.5) / DRAWS)
    assert reading(draws) == parameter
    assert ratio_reading(draws) == ratio
    mirror = {"only an upper bound": "only a lower bound", "only a lower bound": "only an upper bound"}
    assert ratio_reading(1 / draws) == mirror.get(ratio, ratio)


def test_a_posterior_like_its_prior_is_not_identified():
    draws = np.linspace(0, 30, 1001)
    assert reading(draws, Interval(0.75, 29.25)) == "not identified"
    assert reading(np.linspace(10, 12, 1001), Interval(0.75, 29.25)) == "identified"
    assert reading(np.ones(9)) == ratio_reading(np.ones(9)) == "fixed"
    assert ratio_reading(np.full(3, np.nan)) == "undefined"


def test_priors_are_read_from_the_manifest():
    beta = {"alpha": 2.0, "beta": 3.0, "low": 1.0, "high": 11.0}
    flat = {"alpha": 1.0, "beta": 1.0, "low": 0.0, "high": None}
    model = {"priors": {"lam": {"gm": beta, "wm": flat}, "mu": flat | {"high": 40.0}}, "t_elastic": 1e4}
    model["t_similarity"] = {"median": 0.05, "log_sd": 1.0}
    draws = 1 + 10 * np.random.default_rng(0).beta(2, 3, 200_000)
    np.testing.assert_allclose(prior_of(model, "lam", "gm"), np.quantile(draws, (0.025, 0.975)), rtol=0.01)
    assert prior_of(model, "lam", "wm") is prior_of(model, "lam", "csf") is prior_of({}, "mu", "gm") is None
    assert prior_of(model, "mu", "csf") == pytest.approx((1.0, 39.0))
    assert prior_of(model, "t_similarity") == pytest.approx((0.05 * np.exp(-1.96), 0.05 * np.exp(1.96)), rel=1e-3)
    assert prior_of(model, "t_elastic") is None


def test_widths_of_all_that_is_free(posterior):
    manifest = {
        "model": {
            "priors": {"lam": {"gm": {"alpha": 1.0, "beta": 1.0, "low": 0.0, "high": 20.0}}},
            "t_similarity": {"median": 0.05, "log_sd": 1.0},
        }
    }
    table = width_table(MESH, posterior, diagnosed([1.0] * 3, [np.nan, np.nan, 1.5], t_similarity=1.0), manifest)
    found = {(group, row[0]): row[1:] for group, rows in table.groups for row in rows}
    assert list(found) == [(g, s) for g, s in [("CSF", "λ"), ("CSF", "μ"), ("GM", "λ"), ("WM", "λ"), ("WM", "μ")]] + [
        ("Temperatures and sds", "T_s")
    ]
    assert found["CSF", "λ"][0] == "improper"
    assert found["CSF", "λ"][2:] == ["–", "only an upper bound"]
    assert float(found["GM", "λ"][2]) == pytest.approx(2 * 1.96 * 0.5 / 19, abs=0.012)
    assert found["WM", "μ"][3] == "the chains disagree"
    assert found["Temperatures and sds", "T_s"][3] == "identified"


def test_ratios_by_quantiles_with_their_correlation(posterior):
    ((_, rows),) = ratio_table(MESH, posterior).groups
    wm = next(row for row in rows if row[0] == "WM")
    assert float(wm[3]) == pytest.approx(24, rel=0.02)
    assert float(wm[1]) == pytest.approx(24 * np.exp(-0.1645), rel=0.03)
    assert float(wm[6]) == pytest.approx(0.1, abs=0.006)
    assert float(wm[7]) == pytest.approx(0.5 / np.hypot(0.5, 0.1), abs=0.01)
    assert next(row for row in rows if row[0] == "GM")[7] == "–"


def test_what_stands_at_zero_is_left_out_of_logarithms():
    lam, mu = np.array([[[0.0], [2.0], [4.0]]]), np.array([[[1.0], [1.0], [1.0]]])
    spread, correlation = log_figures(Group("gm", lam, mu))
    assert spread == pytest.approx(np.log(2) / np.sqrt(2))
    assert np.isnan(correlation)


def test_one_sentence_by_tissue(posterior):
    said = readings(MESH, posterior, diagnosed([1.0] * 3, [1.0, np.nan, 1.0]), {})
    assert said[0].startswith("CSF: λ/μ is not identified")
    bound = re.search(r"; λ has only an upper bound, ([\d.]+)", said[0])
    assert float(bound[1]) == pytest.approx(0.01 * np.log(20), rel=0.05)
    assert said[1].startswith("GM: λ/μ is identified, 9.")
    assert "μ is" not in said[1].replace("λ/μ is", "")
    assert said[2].startswith("WM: λ/μ is identified")
    disagree = readings(MESH, posterior, diagnosed([1.0, 1.0, 1.3], [1.0, np.nan, 1.0]), {})
    assert disagree[2] == "WM: the chains disagree about it (R̂ 1.300), so that nothing can be read off yet."
