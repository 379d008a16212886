"""Convergence: the key numbers, R̂ and ESS over all estimands, the estimands with the greatest R̂, traces and ranks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from scipy import stats

from bayesreg.report import style
from bayesreg.report.estimands import DISPLACEMENT, draws_of, worst
from bayesreg.report.study import Study
from bayesreg.report.style import Drawing
from bayesreg.report.tables import Table
from bayesreg.report.verdict import NONE, key_facts, number, place_text, rhat_text, threshold_of

SHOWN_DRAWS = 800
RANK_BINS = 20
MOST_PARAMETERS = 8
WORST_DISPLACEMENTS = 6
WORST_SHOWN = 10
STATISTICS = {"lp": "log density", "similarity_energy": "$E_s$", "strain_energy": "$E_r$"}
RUN_COLOURS = ("#2b5c8a", "#b3560f", "#4f9d86", "#7d6aa8", "#a84a63", "#8aa34f")


def key_table(studies: dict[str, Study]) -> Table:
    """Make a table of the key numbers of runs, with a column for each run."""
    columns = [key_facts(study.manifest, study.entries, study.posterior) for study in studies.values()]
    rows = [[label, *(facts[label] for facts in columns)] for label in columns[0]]
    rows = [row for row in rows if set(row[1:]) != {NONE}]
    return Table("Key numbers", "", ["", *studies], [("", rows)])


def worst_table(study: Study) -> Table:
    """Make a table of the estimands with the greatest R̂, with their places in numbers and in words."""
    rows = [
        [
            entry.name,
            place_text(entry.place) if entry.place else NONE,
            entry.region or NONE,
            rhat_text(entry.rhat),
            number(entry.ess_bulk),
            number(entry.ess_tail),
        ]
        for entry in worst(study.entries, WORST_SHOWN)
    ]
    caption = f"The {len(rows)} of {len(study.entries):,} estimands whose chains agree least."
    header = ["", "Place (x, y, z)", "Where", "R̂", "ESS bulk", "ESS tail"]
    return Table("Worst estimands", caption, header, [("", rows)])


class Trace(NamedTuple):
    """Draws (chain, draw) to show, with their name and figures."""

    name: str
    note: str
    draws: np.ndarray


def traces(study: Study) -> Drawing:
    """Draw trace and rank plots of every free parameter, the displacements with the greatest R̂, and the energies."""
    shown = _choose_traces(study)
    with style.look():
        figure, axes = _pairs(-(-len(shown) // 2))
        for (left, right), trace in zip(axes, shown, strict=False):
            _draw_trace(left, trace, study.posterior.sizes["draw"])
            _draw_ranks(right, trace.draws)
        for panel in axes[len(shown) :].ravel():
            panel.remove()
        for left, right in axes[max(0, len(shown) - 2) : len(shown)]:
            for panel, label in ((left, "draw"), (right, "rank among all draws")):
                panel.tick_params(labelbottom=True)
                panel.set_xlabel(label, fontsize=7.5)
        uri = style.data_uri(figure)
    caption = (
        "Left of each pair: every chain over its kept draws. Right: ranks of each chain among all draws; chains that "
        f"agree lie about the dotted line. Shown are parameters, the {WORST_DISPLACEMENTS} displacements of the "
        "greatest R̂, the log density and the energies."
    )
    alt = "Trace and rank plots: " + ", ".join(trace.name.replace("$", "") for trace in shown)
    return Drawing("traces", "Traces and ranks", caption, alt, uri)


def _pairs(rows: int) -> tuple[Figure, np.ndarray]:
    """Place pairs of a wide and a narrow panel, two to a row, by hand: a layout solver would take seconds."""
    height = 1.1 * rows + 0.6
    figure = Figure(figsize=(style.WIDTH, height))
    edges = {"left": 0.045, "right": 0.995, "top": 1 - 0.25 / height, "bottom": 0.4 / height}
    grid = figure.add_gridspec(rows, 5, width_ratios=[2.3, 1, 0.12, 2.3, 1], wspace=0.16, hspace=0.42, **edges)
    axes = np.array([[figure.add_subplot(grid[row, column]) for column in (0, 1, 3, 4)] for row in range(rows)])
    for panel in axes.ravel():
        panel.tick_params(labelbottom=False)
    return figure, axes.reshape(-1, 2)


def _choose_traces(study: Study) -> list[Trace]:
    parameters = [entry for entry in study.entries if entry.variable != DISPLACEMENT]
    displacements = [entry for entry in study.entries if entry.variable == DISPLACEMENT]
    if len(parameters) > MOST_PARAMETERS:
        parameters = worst(parameters, MOST_PARAMETERS)
    chosen = []
    for entry in [*parameters, *worst(displacements, WORST_DISPLACEMENTS)]:
        note = f"R̂ {rhat_text(entry.rhat)} · ESS {number(entry.ess_bulk, 2)}"
        chosen.append(Trace(_symbolic(entry.name), note, draws_of(study.posterior, entry, SHOWN_DRAWS)))
    for name, title in STATISTICS.items():
        # Without images E_s is zero.
        if name in study.sample_stats and study.sample_stats[name].any():
            draws = study.sample_stats[name].transpose("chain", "draw").to_numpy()
            chosen.append(Trace(title, "", draws[:, :: max(1, draws.shape[1] // SHOWN_DRAWS)]))
    return chosen


def _symbolic(name: str) -> str:
    """Convert "u_x of node 3" to a formula with an index, for a figure."""
    name = style.literal(name)
    for plain in ("u_x", "u_y", "u_z", "T_s", "T_r"):
        name = name.replace(plain, f"${plain}$") if name.startswith(plain) else name
    return name


def _draw_trace(axes: Axes, trace: Trace, total: int) -> None:
    draw_numbers = np.linspace(0, total - 1, trace.draws.shape[1])
    for chain, colour in zip(trace.draws, style.chain_colours(len(trace.draws)), strict=True):
        axes.plot(draw_numbers, chain, color=colour, lw=0.55, alpha=0.85)
    axes.set_title(trace.name, fontsize=8.5, pad=3)
    axes.set_title(trace.note, fontsize=7, color=style.MUTED, loc="right", pad=3)
    axes.set_xlim(0, max(1, total - 1))
    axes.yaxis.set_major_locator(MaxNLocator(3))
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.yaxis.set_major_formatter(FuncFormatter(_shorten))


def _shorten(value: float, _: int) -> str:
    text = f"{value / 1000:,.6g}k" if abs(value) >= 1e4 else f"{value:.6g}"
    return text.replace("-", "−")


def _draw_ranks(axes: Axes, draws: np.ndarray) -> None:
    ranks = (stats.rankdata(draws, axis=None) - 0.5).reshape(draws.shape) / draws.size
    for chain, colour in zip(ranks, style.chain_colours(len(ranks)), strict=True):
        count, edges = np.histogram(chain, RANK_BINS, (0, 1))
        axes.stairs(count * RANK_BINS / chain.size, edges, color=colour, lw=0.9, baseline=None)
    axes.axhline(1, color=style.INK, lw=0.7, ls=":")
    axes.set(xlim=(0, 1), xticks=[0, 1], ylim=(0, None))
    axes.yaxis.set_major_locator(MaxNLocator(2, integer=True))


def distributions(studies: dict[str, Study]) -> Drawing:
    """Draw R̂ and ESS of runs over all estimands, as the share of estimands up to each value."""
    labels = {"rhat": "R̂", "ess_bulk": "effective sample size, bulk", "ess_tail": "effective sample size, tail"}
    with style.look():
        figure = style.new_figure(2.5)
        axes = figure.subplots(1, 3, sharey=True)
        for panel, (name, label) in zip(axes, labels.items(), strict=True):
            _cumulate(panel, studies, name)
            panel.set_xlabel(label)
        axes[0].axvline(threshold_of(next(iter(studies.values())).manifest), color=style.ACCENT, ls=(0, (4, 2)), lw=1.1)
        axes[0].set_ylabel("share of estimands")
        if len(studies) > 1:
            axes[0].legend(loc="lower right")
        uri = style.data_uri(figure, "svg")
    caption = "Share of all estimands up to each value; dashed: the R̂ that was asked for."
    return Drawing("distributions", "Convergence of all estimands", caption, "Distributions of R̂ and ESS.", uri)


def _cumulate(axes: Axes, studies: dict[str, Study], figure: str) -> None:
    for (name, study), colour in zip(studies.items(), RUN_COLOURS * len(studies), strict=False):
        values = np.array([getattr(entry, figure) for entry in study.entries])
        if np.isfinite(values).any():
            axes.ecdf(values[np.isfinite(values)], label=style.literal(name), color=colour, lw=1.4)
    axes.set_xscale("log")
    _write_plainly(axes)


def _write_plainly(axes: Axes) -> None:
    """Write plain numbers on a logarithmic axis, and between the decades if it spans less than one."""
    low, high = axes.get_xlim()
    short = high < 8 * low
    axes.xaxis.set_major_formatter(FuncFormatter(_shorten))
    if short:
        axes.xaxis.set_minor_locator(LogLocator(subs=(1.1, 1.2, 1.5, 2, 3, 5) if high < 3 * low else (2, 3, 5)))
    axes.xaxis.set_minor_formatter(FuncFormatter(_shorten) if short else NullFormatter())
