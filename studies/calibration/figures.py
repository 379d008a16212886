"""Figures of a calibration: rank histograms, coverage and intervals of the pairs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from scipy import stats

from bayesreg.report.style import ACCENT, FAINT, INK, MUTED, look, new_figure
from studies.calibration.sbc import BINS, LEVELS, Ranks, verdict

COLUMNS, DPI = 8, 110


def rank_histograms(ranks: Ranks, path: Path) -> None:
    """Draw a histogram for each quantity; the band holds 99 % of the bars of uniform ranks."""
    count, rows = len(ranks.place), -(-len(ranks.names) // COLUMNS)
    band = stats.binom(count, 1 / BINS).interval(0.99)
    uniformity = verdict(ranks.place)
    with look():
        figure = new_figure(1.15 * rows)
        axes = figure.subplots(rows, COLUMNS, sharex=True, sharey=True, squeeze=False)
        for axis in axes.flat:
            axis.set_axis_off()
        for axis, name, place, p in zip(axes.flat, ranks.names, ranks.place.T, uniformity.histogram, strict=False):
            axis.set_axis_on()
            axis.axhspan(*band, color=FAINT, alpha=0.6, lw=0)
            colour = INK if p > uniformity.threshold else ACCENT
            axis.hist(place, BINS, (0, 1), color=colour, alpha=0.75, rwidth=0.9)
            axis.axhline(count / BINS, color=MUTED, lw=0.6)
            axis.set_title(f"{name}  p = {p:.2g}", fontsize=7, color=colour)
            axis.set_xticks([0, 1])
        figure.savefig(path, dpi=DPI)


def coverage(runs: dict[str, Ranks], path: Path) -> None:
    """Draw the share of the truths inside central intervals, a dot for each quantity, over 99 % binomial intervals."""
    with look():
        figure = new_figure(2.2)
        axes = figure.subplots(1, len(LEVELS), sharey=True, squeeze=False)[0]
        for level, axis, index in zip(LEVELS, axes, range(len(LEVELS)), strict=True):
            for row, ranks in enumerate(runs.values()):
                count = len(ranks.place)
                low, high = np.array(stats.binom(count, level).interval(0.99)) / count
                axis.barh(row, high - low, left=low, height=0.7, color=FAINT, alpha=0.7)
                shares = verdict(ranks.place).coverage[index]
                spread = np.linspace(-0.25, 0.25, len(shares))
                axis.plot(shares, row + spread, ".", ms=3, color=INK)
            axis.axvline(level, color=MUTED, lw=0.6)
            axis.set_title(f"central {level:.0%} interval")
            axis.set_xlabel("share of the truths inside")
        axes[0].set_yticks(range(len(runs)), list(runs))
        axes[0].invert_yaxis()
        figure.savefig(path, dpi=DPI)


def intervals(pairs: list[dict[str, Any]], truth: dict[str, float], path: Path) -> None:
    """Draw the 95 % and 50 % intervals of λ/μ of each pair, and beside them the uncorrected ones, if they exist."""
    with look():
        figure = new_figure(2.6)
        axes = figure.subplots(1, len(truth), squeeze=False)[0]
        for axis, (tissue, true) in zip(axes, truth.items(), strict=True):
            for place, key, colour in ((0.0, "ratio", INK), (0.35, "ratio_on_the_mesh", ACCENT)):
                for number, pair in enumerate(pairs, start=1):
                    if key in pair:
                        _bar(axis, number + place, pair[key][tissue], colour)
            axis.axhline(true, color=MUTED, lw=0.8, ls="--")
            axis.set(yscale="log", title=f"λ/μ of {tissue.upper()}", xlabel="pair", xticks=[1, 5, 10, 15, 20])
        figure.savefig(path, dpi=DPI)


def _bar(axis: Axes, place: float, quantiles: list[float], colour: str) -> None:
    low, lower, middle, upper, high = quantiles
    axis.plot([place, place], [low, high], color=colour, lw=1)
    axis.plot([place, place], [lower, upper], color=colour, lw=3)
    axis.plot(place, middle, "o", ms=2.5, color="white", mec=colour)
