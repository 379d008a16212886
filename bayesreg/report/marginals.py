"""Marginal posteriors: stiffness ratios by tissue, and the scales of the observations and of the prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from scipy import stats

from bayesreg.io.records import Run
from bayesreg.report import style
from bayesreg.report.estimands import Group, sampled_scales, symbol_of
from bayesreg.report.study import Study
from bayesreg.report.style import Drawing
from bayesreg.report.verdict import nested_entry, number
from bayesreg.tissues import colours_of, label_of

BINS = 32
# A ratio has a logarithmic axis if its interval spans more than this factor.
LOG_SPAN = 20.0
# A mark that lies further from the axis than this many widths of it is named at its edge.
FAR = 2.0
COLUMNS = 4


def marginals(study: Study) -> Drawing:
    """Draw the paper's Fig. 4, marginal posteriors of λ/μ with the known truth, and those of sampled scales."""
    groups, scales = study.parameters, sampled_scales(study.posterior)
    count = len(groups) + len(scales)
    columns = min(COLUMNS, count)
    with style.look():
        figure = style.new_figure(2.5 * -(-count // columns))
        axes = figure.subplots(-(-count // columns), columns, squeeze=False).ravel()
        for panel, group in zip(axes, groups, strict=False):
            ratio_panel(panel, study.run, group)
        for panel, name in zip(axes[len(groups) :], scales, strict=False):
            _scale_panel(panel, study, name)
        for panel in axes[count:]:
            panel.remove()
        uri = style.data_uri(figure, "svg")
    caption = (
        "Filled: all chains; lines: each chain; dot and bar: median and 95 % interval"
        + ("; dashed: truth" if study.run.truth is not None else "")
        + (", and the prior of a scale (red)." if scales else ".")
        + (" This is the paper’s Fig. 4." if study.is_of_the_paper else "")
    )
    medians = ", ".join(f"{group.name} {number(float(np.nanmedian(group.ratio)))}" for group in groups)
    alt = f"Posterior histograms; medians of λ/μ: {medians}."
    return Drawing("stiffness", "Stiffness ratios" + (" and scales" if scales else ""), caption, alt, uri)


class Mark(NamedTuple):
    """A value to point out in a histogram, its label and colour."""

    value: float
    label: str
    colour: str


def ratio_panel(axes: Axes, run: Run, group: Group) -> None:
    """Draw the histogram of λ/μ of one group, with its median, 95 % interval and truth."""
    colours = {"uniform": style.UNIFORM} | dict(zip(run.mesh.names, colours_of(run.mesh.names), strict=True))
    truths = _true_ratios(run, group.name)
    marks = [Mark(value, f"truth {style.literal(name)}", colours[name]) for name, value in truths.items()]
    if len(marks) == 1:
        marks = [Mark(marks[0].value, "truth", style.TRUTH)]
    histogram(axes, group.ratio.reshape(len(group.ratio), -1), colours[group.name], marks, ratio=True)
    axes.set_title(style.literal(label_of(group.name)), weight="bold")
    axes.set_xlabel("λ / μ")


def _true_ratios(run: Run, name: str) -> dict[str, float]:
    """Return λ/μ of the named tissue, or of all tissues if the parameters are uniform."""
    if run.truth is None:
        return {}
    ratios = dict(zip(run.mesh.names, np.asarray(run.truth.lam) / np.asarray(run.truth.mu), strict=True))
    return {key: float(ratio) for key, ratio in ratios.items() if name in (key, "uniform")}


def _scale_panel(axes: Axes, study: Study, name: str) -> None:
    """Draw the histogram of a temperature, a load or the sd of an observation, and its log-normal prior."""
    histogram(axes, np.asarray(study.posterior[name].transpose("chain", "draw").to_numpy(), float), style.UNIFORM, [])
    symbol = symbol_of(name)
    axes.set_xlabel(f"${symbol}$" if symbol in ("T_s", "T_r") else style.literal(symbol))
    prior = nested_entry(study.manifest, "scales", name)
    if isinstance(prior, Mapping):
        low, high = axes.get_xlim()
        x = np.linspace(max(low, 1e-9 * high), high, 300)
        density = stats.lognorm.pdf(x, float(prior["log_sd"]), scale=float(prior["median"]))
        axes.plot(x, density, color=style.ACCENT, ls=(0, (4, 2)), lw=1.1)
        axes.set_xlim(low, high)


def histogram(axes: Axes, draws: np.ndarray, colour: str, marks: Sequence[Mark], ratio: bool = False) -> None:
    """Draw densities of (chain, draw) values: all chains filled, each chain as a line, with median, interval and marks.

    The interval is the central 95 % interval. A ratio whose central interval spans more than a factor of twenty has a
    logarithmic axis. A mark far outside the draws is named at the edge of the axis on its side.
    """
    finite = draws[np.isfinite(draws)]
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    if finite.size == 0 or np.ptp(finite) == 0:
        text = f"fixed: {number(float(finite[0]))}" if finite.size else "undefined"
        axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center")
        return
    low, median, high = (float(value) for value in np.quantile(finite, (0.025, 0.5, 0.975)))
    logarithmic = bool(ratio and low > 0 and high > LOG_SPAN * low)
    edges = _edges(finite, logarithmic)
    axes.set_xscale("log" if logarithmic else "linear")
    axes.stairs(_density(finite, edges, logarithmic), edges, fill=True, color=colour, alpha=0.45, lw=0)
    for chain, line in zip(draws, style.chain_colours(len(draws)), strict=True):
        axes.stairs(_density(chain[np.isfinite(chain)], edges, logarithmic), edges, color=line, lw=0.7, alpha=0.85)
    base = -0.05 * axes.get_ylim()[1]
    axes.plot([low, high], [base, base], color=colour, lw=3, solid_capstyle="butt")
    axes.plot([median], [base], "o", mfc="white", mec=colour, ms=5)
    axes.set_ylim(2 * base, axes.get_ylim()[1] * (1.22 if marks else 1.05))
    interval = f"{number(median)} [{number(low)}, {number(high)}]"
    axes.set_title(interval, fontsize=7, color=style.MUTED, loc="right")
    _point_out(axes, edges, marks, logarithmic)


def _point_out(axes: Axes, edges: np.ndarray, marks: Sequence[Mark], logarithmic: bool) -> None:
    """Draw a dashed line at every mark near the draws, and an arrow towards every other mark."""
    scale = np.log10 if logarithmic else np.asarray
    first, last = scale(edges[0]), scale(edges[-1])
    for index, mark in enumerate(marks):
        position = scale(mark.value) if mark.value > 0 or not logarithmic else -np.inf
        settings: dict[str, Any] = {"color": mark.colour, "fontsize": 7, "va": "top"}
        if first - FAR * (last - first) <= position <= last + FAR * (last - first):
            axes.axvline(mark.value, color=mark.colour, ls=(0, (4, 2)), lw=1.2)
            settings |= {"transform": axes.get_xaxis_transform(), "rotation": 90, "ha": "right"}
            axes.text(mark.value, 0.99, f"{mark.label} ", **settings)
        else:
            below = position < first
            text = f"← {mark.label} {number(mark.value)}" if below else f"{mark.label} {number(mark.value)} →"
            settings |= {"transform": axes.transAxes, "ha": "left" if below else "right"}
            axes.text(0.0 if below else 1.0, 0.98 - 0.09 * index, text, **settings)


def _density(values: np.ndarray, edges: np.ndarray, logarithmic: bool) -> np.ndarray:
    """Compute the density per unit of the drawn axis, so that areas are proportional to probabilities."""
    return np.histogram(values, edges)[0] / max(1, values.size) / np.diff(np.log(edges) if logarithmic else edges)


def _edges(values: np.ndarray, logarithmic: bool) -> np.ndarray:
    low, high = np.quantile(values, (0.002, 0.998))
    if logarithmic:
        return np.geomspace(max(low, 1e-12), high, BINS)
    margin = 0.02 * (high - low) or 1e-9
    return np.linspace(low - margin, high + margin, BINS)
