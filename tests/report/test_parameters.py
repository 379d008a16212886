import numpy as np
import pytest
import xarray as xr
from scipy import stats

from bayesreg.image import Image
from bayesreg.io.records import Run
from bayesreg.report.parameters import (
    Interval,
    LogInterval,
    describe_bounds,
    parameter_table,
    prior_of,
    prior_of_ratio,
)
from bayesreg.report.study import Study
from tests.phantoms import box_mesh
from tests.report.conftest import Draws

MESH = box_mesh(2)
DRAWS = 4000


def posterior_of(lam: np.ndarray, mu: np.ndarray, **temperatures: np.ndarray) -> xr.Dataset:
    """Two chains of λ and μ by tissue, (draws, 3) each."""
    dims = ("chain", "draw", "tissue")
    variables = {name: (dims, values.reshape(2, -1, 3)) for name, values in (("lam", lam), ("mu", mu))}
    scalars = {name: (dims[:2], values.reshape(2, -1)) for name, values in temperatures.items()}
    return xr.Dataset(variables | scalars, coords={"tissue": list(MESH.names)})


def studied(posterior: xr.Dataset, model: dict, lam: list[float], mu: list[float], **scalars: float) -> Study:
    """A run with these R̂."""
    rhat = xr.Dataset({"lam": ("tissue", lam), "mu": ("tissue", mu)} | {k: ((), v) for k, v in scalars.items()})
    run = Run(
        "",
        {"model": model, "scales": {"t_similarity": {"median": 0.05, "log_sd": 1.0}}},
        MESH,
        *np.zeros((2, *MESH.points.shape)),
        None,
        None,
        Image(np.zeros((1, 1, 1)), np.eye(4)),
        None,
    )
    return Study(run, Draws(posterior, xr.Dataset()), rhat, 100 * rhat, 200 * rhat)


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
    ("law", "reading"),
    [
        (stats.norm(10, 0.5), "identified"),
        (stats.uniform(0, 3), "only an upper bound"),
        (stats.expon(), "only an upper bound"),
        (stats.halfnorm(), "only an upper bound"),
        (stats.invgamma(1), "only a lower bound"),
        (stats.lognorm(0.8), "weakly identified"),
        (stats.lognorm(3.0), "not identified"),
    ],
)
def test_readings_of_known_laws(law, reading):
    draws = law.ppf((np.arange(DRAWS) + 0.5) / DRAWS)
    assert describe_bounds(draws) == reading
    mirror = {"only an upper bound": "only a lower bound", "only a lower bound": "only an upper bound"}
    assert describe_bounds(1 / draws) == mirror.get(reading, reading)


def test_a_posterior_like_its_prior_is_not_identified():
    draws = np.linspace(0, 30, 1001)
    assert describe_bounds(draws, Interval(0.75, 29.25)) == "not identified"
    assert describe_bounds(np.linspace(10, 12, 1001), Interval(0.75, 29.25)) == "identified"
    assert describe_bounds(np.linspace(12, 30, 1001), Interval(0.75, 29.25)) == "weakly identified"
    assert describe_bounds(np.ones(9)) == "fixed"
    assert describe_bounds(np.full(3, np.nan)) == "undefined"


def test_the_width_of_a_log_normal_prior_is_that_of_logarithms():
    """A stiffness that is twice as well known, in logarithms, as before."""
    prior, level = LogInterval.of(1.5, 0.8), (np.arange(DRAWS) + 0.5) / DRAWS
    for log_sd, reading in ((0.8, "not identified"), (0.5, "weakly identified"), (0.3, "identified")):
        # The median moves, which is no change of width.
        draws = stats.lognorm.ppf(level, log_sd, scale=4.0)
        assert prior.share_of(draws) == pytest.approx(log_sd / 0.8, rel=2e-3)
        assert describe_bounds(draws, prior) == reading
        assert prior.share_of(1 / draws) == pytest.approx(log_sd / 0.8, rel=2e-3)
    assert prior.share_of(np.r_[np.zeros(100), np.linspace(1, 2, 900)]) == np.inf


def test_the_ratio_of_log_normal_numbers_is_log_normal():
    lam, mu = LogInterval.of(18.0, 0.6), LogInterval.of(1.5, 0.7)
    rng = np.random.default_rng(0)
    drawn = 12 * np.exp(0.6 * rng.normal(size=400_000) - 0.7 * rng.normal(size=400_000))
    np.testing.assert_allclose(prior_of_ratio(lam, mu, None), np.quantile(drawn, (0.025, 0.975)), rtol=0.01)
    np.testing.assert_allclose(prior_of_ratio(lam, mu, 2.0), np.array(lam) / 2)
    assert isinstance(prior_of_ratio(lam, mu, 2.0), LogInterval)
    assert prior_of_ratio(Interval(1.0, 2.0), mu, None) is prior_of_ratio(None, mu, 1.0) is None


def test_priors_are_read_from_the_manifest():
    beta = {"alpha": 2.0, "beta": 3.0, "low": 1.0, "high": 11.0}
    flat = {"alpha": 1.0, "beta": 1.0, "low": 0.0, "high": None}
    model = {"priors": {"lam": {"gm": beta, "wm": flat}, "mu": flat | {"high": 40.0}}}
    draws = 1 + 10 * np.random.default_rng(0).beta(2, 3, 200_000)
    np.testing.assert_allclose(prior_of(model, "lam", "gm"), np.quantile(draws, (0.025, 0.975)), rtol=0.01)
    assert prior_of(model, "lam", "wm") is prior_of(model, "lam", "csf") is prior_of({}, "mu", "gm") is None
    assert prior_of(model, "mu", "csf") == pytest.approx((1.0, 39.0))
    scale = LogInterval.of(0.05, 1.0)
    model = {"priors": {"lam": {"median": 0.05, "log_sd": 1.0}, "mu": {"gm": {"median": 0.05, "log_sd": 1.0}}}}
    assert prior_of(model, "lam", "wm") == prior_of(model, "mu", "gm") == prior_of(model, "mu", "uniform") == scale
    assert scale == pytest.approx((0.05 * np.exp(-1.96), 0.05 * np.exp(1.96)), rel=1e-3)


def test_a_row_for_all_that_is_known(posterior):
    model = {
        "priors": {"lam": {"gm": {"alpha": 1.0, "beta": 1.0, "low": 0.0, "high": 20.0}}},
    }
    table = parameter_table(studied(posterior, model, [1.0] * 3, [1.0, np.nan, 1.5], t_similarity=1.0))
    cells = {(group, row[0]): row[1:] for group, rows in table.groups for row in rows}
    elastic = [(tissue, symbol) for tissue in ("CSF", "GM", "WM") for symbol in ("λ/μ", "λ", "μ")]
    assert list(cells) == [*elastic, ("Scales", "T_s")]
    assert float(cells["WM", "λ/μ"][0]) == pytest.approx(24, rel=0.02)
    low, high = (float(edge) for edge in cells["WM", "λ/μ"][1].split(" to "))
    assert (low, high) == pytest.approx((24 * np.exp(-0.196), 24 * np.exp(0.196)), rel=0.03)
    assert cells["GM", "λ"][2:5] == ["0.500 to 19.5", "0.10", "identified"]
    assert cells["GM", "μ"] == ["1.00", "fixed", "–", "–", "–", "–", "–"]
    assert cells["CSF", "λ"][2:5] == ["improper", "–", "only an upper bound"]
    assert cells["CSF", "λ/μ"][4] == "not identified"
    assert cells["WM", "μ"][4:] == ["the chains disagree", "1.500", "150"]
    assert cells["Scales", "T_s"][3:5] == ["0.10", "identified"]
