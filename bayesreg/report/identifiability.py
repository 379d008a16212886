"""The data's word on each parameter: prior against posterior width, ratios by quantiles, a sentence by tissue."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy import stats

from bayesreg.mesh import TetMesh
from bayesreg.report.estimands import SYMBOLS, Diagnosed, Group, parameter_groups, sampled_scales, symbol_of
from bayesreg.report.tables import Table
from bayesreg.report.verdict import NONE, number, part, rhat_text, threshold_of
from bayesreg.tissues import label_of

RATIO_LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
# Identified: the central 90 % interval spans less than a factor of ten.
IDENTIFIED = 10.0
# A bound: the median is more than so many times the 1 % quantile, so that the density reaches zero, …
REACHES_ZERO = 20.0
# … and, of a ratio, the bound is within this factor of the median.
BOUND = 5.0
# An interval of at least this share of the prior’s is called as wide as the prior.
PRIOR_SHARE = 0.8
LAME = ("lam", "mu")


class Interval(NamedTuple):
    """Central 95 % interval."""

    low: float
    high: float

    @property
    def text(self) -> str:
        """For people."""
        return f"{number(self.low)} to {number(self.high)}"


def reading(draws: np.ndarray, prior: Interval | None = None) -> str:
    """Put in words how a posterior bounds a parameter with a prior on [0, ∞) or part of it.

    Parameters
    ----------
    draws : array
        Draws of any shape.
    prior : Interval, optional
        Central 95 % interval of its prior; None where it is improper.

    Returns
    -------
    str
        "fixed", "identified", "weakly identified", "only an upper bound" or "not identified".
    """
    if np.ptp(draws) == 0:
        return "fixed"
    if prior is not None and _width(draws) > PRIOR_SHARE * (prior.high - prior.low):
        return "not identified"
    q01, low, median, high = np.quantile(draws, (0.01, 0.05, 0.5, 0.95))
    if median > REACHES_ZERO * q01:
        return "only an upper bound"
    return "identified" if high < IDENTIFIED * low else "weakly identified"


def ratio_reading(draws: np.ndarray) -> str:
    """Put in words how a posterior bounds a ratio of parameters; draws that are not finite are left out.

    As `reading`, but alike for the ratio and its reciprocal: "only a lower bound" may be said too, and a tail of more
    than a factor of five on the side of the bound is none.
    """
    known = draws[np.isfinite(draws)]
    if known.size == 0:
        return "undefined"
    if np.ptp(known) == 0:
        return "fixed"
    q01, low, median, high, q99 = np.quantile(known, (0.01, 0.05, 0.5, 0.95, 0.99))
    if median > REACHES_ZERO * q01:
        return "only an upper bound" if high < BOUND * median else "not identified"
    if q99 > REACHES_ZERO * median:
        return "only a lower bound" if median < BOUND * low else "not identified"
    return "identified" if high < IDENTIFIED * low else "weakly identified"


def _width(draws: np.ndarray) -> float:
    low, high = np.quantile(draws, (0.025, 0.975))
    return float(high - low)


def prior_of(model: Mapping[str, Any], name: str, tissue: str | None = None) -> Interval | None:
    """Central 95 % interval of the prior of λ, μ or a temperature; None where it is improper (or there is none).

    Parameters
    ----------
    model : mapping
        The section `model` of the manifest.
    name : str
        "lam", "mu", or that of a temperature or of the sd of an observation.
    tissue : str, optional
        For λ and μ.
    """
    if name not in LAME:
        given = model.get(name)
        if not isinstance(given, Mapping):
            return None
        factor = math.exp(stats.norm.ppf(0.975) * float(given["log_sd"]))
        return Interval(float(given["median"]) / factor, float(given["median"]) * factor)
    given = (model.get("priors") or {}).get(name) or {}
    if "alpha" not in given:
        given = given.get(tissue) or (next(iter(given.values()), {}) if tissue == "uniform" else {})
    high = given.get("high")
    if high is None or math.isinf(high):
        return None
    low, alpha, beta = (float(given.get(key, default)) for key, default in (("low", 0), ("alpha", 1), ("beta", 1)))
    return Interval(*(float(x) for x in stats.beta(alpha, beta, low, high - low).ppf((0.025, 0.975))))


def width_table(mesh: TetMesh, posterior: xr.Dataset, diagnosed: Diagnosed, manifest: Mapping[str, Any]) -> Table:
    """Prior against posterior width of every free parameter."""
    model, threshold = part(manifest, "model") or {}, threshold_of(manifest)
    groups = []
    for index, group in enumerate(parameter_groups(mesh, posterior)):
        pooled = group.lam.shape[-1] > 1
        rows = [
            _width_row(
                SYMBOLS[name],
                getattr(group, name),
                prior_of(model, name, group.name),
                not pooled and _rhat(diagnosed, name, index) >= threshold,
            )
            for name in LAME
            if np.ptp(getattr(group, name)) > 0
        ]
        groups.append((label_of(group.name), rows or [["λ, μ", NONE, "fixed", NONE, NONE]]))
    rows = [
        _width_row(
            symbol_of(name),
            posterior[name].to_numpy(),
            prior_of(model, name),
            _rhat(diagnosed, name, 0) >= threshold,
        )
        for name in sampled_scales(posterior)
    ]
    if rows:
        groups.append(("Temperatures and sds", rows))
    caption = (
        "Central 95 % intervals and the ratio of their widths: near 1 the data say nothing that the prior did not. An "
        "improper prior, flat on [0, ∞), has no width. Of λ and μ alone the scale is a convention, set by the one that "
        "is fixed and by the elastic temperature: read the ratios first."
    )
    header = ["", "Prior", "Posterior", "Posterior / prior width", "Data say"]
    return Table("Prior and posterior", caption, header, groups)


def _width_row(symbol: str, draws: np.ndarray, prior: Interval | None, disputed: bool) -> list[str]:
    low, high = (float(x) for x in np.quantile(draws, (0.025, 0.975)))
    share = NONE if prior is None else number((high - low) / (prior.high - prior.low), 2)
    said = "the chains disagree" if disputed else reading(draws, prior)
    return [symbol, "improper" if prior is None else prior.text, Interval(low, high).text, share, said]


def ratio_table(mesh: TetMesh, posterior: xr.Dataset) -> Table:
    """λ/μ by tissue: quantiles, never a mean; sd of its logarithm; correlation of log λ and log μ."""
    rows = []
    for group in parameter_groups(mesh, posterior):
        known = group.ratio[np.isfinite(group.ratio)]
        levels = np.quantile(known, RATIO_LEVELS) if known.size else np.full(len(RATIO_LEVELS), np.nan)
        spread, correlation = log_figures(group)
        rows.append([label_of(group.name), *map(number, levels), number(spread, 2), number(correlation, 2)])
    header = ["", *(f"{level:.0%}".replace("%", " %") for level in RATIO_LEVELS), "sd of log λ/μ", "corr(log λ, log μ)"]
    header[1 + RATIO_LEVELS.index(0.5)] = "Median"
    caption = (
        "λ/μ has no mean where μ may be 0: quantiles only. A sd of the logarithm of 0.1 is about 10 %, one of 0.7 a "
        "factor of two. A correlation near 1 says that λ and μ move together, so that their ratio is known better than "
        "either; there is none where one of them is fixed."
    )
    return Table("λ/μ in quantiles", caption, header, [("", rows)])


def log_figures(group: Group) -> tuple[float, float]:
    """Sd of log λ/μ, and correlation of log λ and log μ; NaN where not defined."""
    lam, mu = group.lam.ravel(), group.mu.ravel()
    positive = (lam > 0) & (mu > 0)
    if positive.sum() < 2:
        return math.nan, math.nan
    log_lam, log_mu = np.log(lam[positive]), np.log(mu[positive])
    free = np.ptp(log_lam) > 0 and np.ptp(log_mu) > 0
    correlation = float(np.corrcoef(log_lam, log_mu)[0, 1]) if free else math.nan
    return float((log_lam - log_mu).std(ddof=1)), correlation


def readings(mesh: TetMesh, posterior: xr.Dataset, diagnosed: Diagnosed, manifest: Mapping[str, Any]) -> list[str]:
    """One sentence by tissue: what the data say of it."""
    model = part(manifest, "model") or {}
    groups = parameter_groups(mesh, posterior)
    return [_sentence(group, k, diagnosed, model, threshold_of(manifest)) for k, group in enumerate(groups)]


def _sentence(group: Group, index: int, diagnosed: Diagnosed, model: Mapping[str, Any], threshold: float) -> str:
    label = label_of(group.name)
    if group.lam.shape[-1] > 1:
        return (
            f"{label}: {group.lam.shape[-1]:,} elements pooled; the figures mix how they differ with what is unknown."
        )
    rhat = max(_rhat(diagnosed, name, index) for name in LAME)
    if rhat >= threshold:
        return f"{label}: the chains disagree about it (R̂ {rhat_text(rhat)}), so that nothing can be read off yet."
    if np.ptp(group.lam) == 0 and np.ptp(group.mu) == 0:
        return f"{label}: λ and μ are fixed."
    parts = [_phrase("λ/μ", group.ratio, ratio_reading(group.ratio))]
    if np.ptp(group.lam) > 0 and np.ptp(group.mu) > 0:
        parts += [
            _phrase(SYMBOLS[name], draws, reading(draws, prior_of(model, name, group.name)))
            for name, draws in (("lam", group.lam), ("mu", group.mu))
        ]
    return f"{label}: {'; '.join(parts)}."


def _phrase(symbol: str, draws: np.ndarray, said: str) -> str:
    known = draws[np.isfinite(draws)]
    if known.size == 0:
        return f"{symbol} is undefined"
    low, high = (number(float(x)) for x in np.quantile(known, (0.05, 0.95)))
    if said == "only an upper bound":
        return f"{symbol} has only an upper bound, {high} (95 %)"
    if said == "only a lower bound":
        return f"{symbol} has only a lower bound, {low} (95 %)"
    return f"{symbol} is {said}, {low} to {high} (90 %)"


def _rhat(diagnosed: Diagnosed, name: str, index: int) -> float:
    """R-hat of one entry; 0 where it has none, being fixed or not looked at."""
    if name not in diagnosed.rhat:
        return 0.0
    rhat = float(np.ravel(diagnosed.rhat[name].to_numpy())[index])
    return 0.0 if math.isnan(rhat) else rhat
