"""The table of the elastic parameters: the value of each, its uncertainty, and the information from data and prior."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from bayesreg.report.estimands import SYMBOLS, Group, sampled_scales, symbol_of
from bayesreg.report.study import Study
from bayesreg.report.tables import Table
from bayesreg.report.verdict import NONE, decimal_text, nested_entry, number, rhat_text, threshold_of
from bayesreg.tissues import label_of

# A parameter is identified if its central 90 % interval spans less than a factor of ten.
IDENTIFIED = 10.0
# A number has only an upper bound if its median is more than this many times the 1 % quantile, so that the density
# reaches zero (a lower bound: the 99 % quantile is more than this many times the median), …
REACHES_ZERO = 20.0
# … and the bound is within this factor of the median.
BOUND = 5.0
# A parameter whose interval is wider than the first share of the prior’s has it mostly from there, and is weakly
# identified at best; above the second it is not identified.
PRIOR_SHARES = 0.5, 0.8
LEVELS = 0.025, 0.975
LAME = ("lam", "mu")
HEADER = ["", "Median", "95 % interval", "Prior, 95 %", "Width", "Data say", "R̂", "Least ESS"]
CAPTION = (
    "Only ratios shape the deformation where no force acts inside; the scale of λ and μ is set by the parameter that "
    "is fixed and by the elastic temperature. λ/μ has no mean where μ may be 0. A flat prior on [0, ∞) is improper. "
    "Width: that of the interval over that of the prior’s, of logarithms where the prior is log-normal. Near 1 the "
    "data say nothing beyond the prior."
)


class Interval(NamedTuple):
    """The central 95 % interval."""

    low: float
    high: float

    @property
    def text(self) -> str:
        """The interval as text."""
        return f"{number(self.low)} to {number(self.high)}"

    def share_of(self, draws: np.ndarray) -> float:
        """Return the width of the draws' central 95 % interval, as a share of the width of this one."""
        low, high = np.quantile(draws, LEVELS)
        return float((high - low) / (self.high - self.low))


class LogInterval(Interval):
    """The central 95 % interval of a log-normal number, whose width is that of logarithms."""

    @classmethod
    def of(cls, median: float, log_sd: float) -> LogInterval:
        """Return the interval of a log-normal number."""
        factor = math.exp(stats.norm.ppf(LEVELS[1]) * log_sd)
        return cls(median / factor, median * factor)

    @property
    def log_width(self) -> float:
        """The logarithm of the factor between the ends."""
        return math.log(self.high / self.low)

    def share_of(self, draws: np.ndarray) -> float:
        """Return the width of the draws' interval as a share of the width of this one, of logarithms."""
        low, high = np.quantile(draws, LEVELS)
        return math.log(high / low) / self.log_width if low > 0 else math.inf


def describe_bounds(draws: np.ndarray, prior: Interval | None = None) -> str:
    """Describe in words how a posterior bounds a positive number.

    For the reciprocal of the number, the description is equal with upper and lower bound exchanged.

    Parameters
    ----------
    draws : array
        Draws of any shape; draws that are not finite are left out.
    prior : Interval, optional
        Central 95 % interval of the prior; None if the prior is improper.

    Returns
    -------
    str
        "undefined", "fixed", "identified", "weakly identified", "only an upper bound", "only a lower bound" or "not
        identified".
    """
    finite = draws[np.isfinite(draws)]
    if finite.size == 0:
        return "undefined"
    if np.ptp(finite) == 0:
        return "fixed"
    q01, low, median, high, q99 = np.quantile(finite, (0.01, 0.05, 0.5, 0.95, 0.99))
    share = 0.0 if prior is None else prior.share_of(finite)
    if share > PRIOR_SHARES[1]:
        return "not identified"
    if median > REACHES_ZERO * q01:
        return "only an upper bound" if high < BOUND * median else "not identified"
    if q99 > REACHES_ZERO * median:
        return "only a lower bound" if median < BOUND * low else "not identified"
    return "identified" if high < IDENTIFIED * low and share <= PRIOR_SHARES[0] else "weakly identified"


def prior_of(model: Mapping[str, Any], name: str, tissue: str | None = None) -> Interval | None:
    """Return the central 95 % interval of the prior of "lam" or "mu" of a tissue; None if it is improper.

    Parameters
    ----------
    model : mapping
        The section `model` of the manifest.
    name : str
    tissue : str, optional
    """
    prior = (model.get("priors") or {}).get(name) or {}
    if not {"alpha", "median"} & set(prior):
        prior = prior.get(tissue) or (next(iter(prior.values()), {}) if tissue == "uniform" else {})
    if "median" in prior:
        return LogInterval.of(**prior)
    high = prior.get("high")
    if high is None or math.isinf(high):
        return None
    low, alpha, beta = (float(prior.get(key, default)) for key, default in (("low", 0), ("alpha", 1), ("beta", 1)))
    return Interval(*(float(x) for x in stats.beta(alpha, beta, low, high - low).ppf(LEVELS)))


def prior_of_ratio(lam: Interval | None, mu: Interval | None, known_mu: float | None) -> Interval | None:
    """Return the central 95 % interval of the prior of λ/μ; None if it has none of its own."""
    if known_mu and lam:
        return type(lam)(lam.low / known_mu, lam.high / known_mu)
    if not (isinstance(lam, LogInterval) and isinstance(mu, LogInterval)):
        return None
    # The logarithms of independent numbers have variances that add.
    width = math.hypot(lam.log_width, mu.log_width)
    median = math.sqrt(lam.low * lam.high / (mu.low * mu.high))
    return LogInterval(median * math.exp(-width / 2), median * math.exp(width / 2))


def parameter_table(study: Study) -> Table:
    """Make a table with a row for λ/μ, λ and μ of every tissue, and for every sampled scale, with the known truth."""
    groups = [(label_of(group.name), _group_rows(study, index, group)) for index, group in enumerate(study.parameters)]
    rows = []
    for name in sampled_scales(study.posterior):
        scale_prior = nested_entry(study.manifest, "scales", name)
        draws, prior = study.posterior[name].to_numpy(), LogInterval.of(**scale_prior) if scale_prior else None
        rows.append(_row(study, symbol_of(name), draws, (name, 0), prior, describe_bounds(draws, prior)))
    groups += [("Scales", rows)] if rows else []
    header, caption = list(HEADER), CAPTION
    if study.run.truth is not None:
        header.append("Truth")
        groups = [(title, [[*row, _truth(study, title, row[0])] for row in rows]) for title, rows in groups]
    if any(group.lam.shape[-1] > 1 for group in study.parameters):
        caption += " Elements of a tissue are pooled: the interval holds how they differ, too."
    return Table("Elastic parameters", caption, header, groups)


def _group_rows(study: Study, index: int, group: Group) -> list[list[str]]:
    model = nested_entry(study.manifest, "model") or {}
    entry = None if group.lam.shape[-1] > 1 else index
    priors = {name: prior_of(model, name, group.name) for name in LAME}
    known_mu = float(np.ravel(group.mu)[0]) if np.ptp(group.mu) == 0 else None
    ratio_prior = prior_of_ratio(priors["lam"], priors["mu"], known_mu)
    rows = []
    for name, prior in {"ratio": ratio_prior, **priors}.items():
        draws = getattr(group, name)
        rows.append(_row(study, SYMBOLS[name], draws, (name, entry), prior, describe_bounds(draws, prior)))
    if ratio_prior is None:
        rows[0][3] = NONE
    return rows


def _row(
    study: Study,
    symbol: str,
    draws: np.ndarray,
    entry: tuple[str, int | None],
    prior: Interval | None,
    description: str,
) -> list[str]:
    finite = draws[np.isfinite(draws)]
    if description in ("fixed", "undefined"):
        value = number(float(finite[0])) if finite.size else NONE
        return [symbol, value, description, *[NONE] * 5]
    low, median, high = (float(x) for x in np.quantile(finite, (LEVELS[0], 0.5, LEVELS[1])))
    rhat, bulk, tail = _figures(study, *entry)
    description = "the chains disagree" if rhat >= threshold_of(study.manifest) else description
    prior_text, width = ("improper", NONE) if prior is None else (prior.text, decimal_text(prior.share_of(finite)))
    least = number(float(np.fmin(bulk, tail)))
    return [symbol, number(median), Interval(low, high).text, prior_text, width, description, _rhat(rhat), least]


def _rhat(rhat: float) -> str:
    return NONE if math.isnan(rhat) else rhat_text(rhat)


def _figures(study: Study, name: str, entry: int | None) -> tuple[float, float, float]:
    """Return R̂ and both ESS of one entry; NaN if it has none, or represents several elements."""
    if entry is None or name not in study.rhat:
        return math.nan, math.nan, math.nan
    rhat, bulk, tail = (float(np.ravel(figure[name].to_numpy())[entry]) for figure in study.diagnosed)
    return rhat, bulk, tail


def _truth(study: Study, title: str, symbol: str) -> str:
    """Format the true value of a parameter of a tissue; a dash if there is none."""
    truth, labels = study.run.truth, [label_of(name) for name in study.mesh.names]
    if truth is None or title not in labels:
        return NONE
    lam, mu = (float(np.asarray(values)[labels.index(title)]) for values in (truth.lam, truth.mu))
    return number({SYMBOLS["lam"]: lam, SYMBOLS["mu"]: mu, SYMBOLS["ratio"]: lam / mu}[symbol])
