"""Figures of convergence: traces, ranks, and the distributions of R-hat and ESS over all estimands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from scipy import stats

from bayesreg.mesh import TetMesh
from bayesreg.report import panels, style
from bayesreg.report.estimands import DISPLACEMENT, SYMBOLS, Estimand, draws_of, worst
from bayesreg.report.slices import DIRECTIONS, IN_PLANE
from bayesreg.report.style import Drawing
from bayesreg.report.verdict import number, rhat_text

SHOWN_DRAWS = 800
RANK_BINS = 20
MOST_PARAMETERS = 8
WORST_DISPLACEMENTS = 6
STATISTICS = {"lp": "log density", "similarity_energy": "$E_s$", "strain_energy": "$E_r$"}
PARAMETER_COLOURS = {"lam": "#b07c46", "mu": "#5c9a86"}


class Trace(NamedTuple):
    """Draws (chain, draw) to show, with their name and figures."""

    name: str
    note: str
    draws: np.ndarray


def traces(posterior: xr.Dataset, sample_stats: xr.Dataset, entries: Sequence[Estimand]) -> Drawing:
    """Trace and rank plots of every free parameter, the worst displacements, and the energies."""
    shown = _choose(posterior, sample_stats, entries)
    rows = -(-len(shown) // 2)
    with style.look():
        figure, axes = _pairs(rows)
        for (left, right), trace in zip(axes, shown, strict=False):
            _trace(left, trace, posterior.sizes["draw"])
            _ranks(right, trace.draws)
        for panel in axes[len(shown) :].ravel():
            panel.remove()
        for left, right in axes[max(0, len(shown) - 2) : len(shown)]:
            left.tick_params(labelbottom=True)
            right.tick_params(labelbottom=True)
            left.set_xlabel("draw", fontsize=7.5)
            right.set_xlabel("rank among all draws", fontsize=7.5)
        uri = style.data_uri(figure)
    caption = (
        "Left of each pair: every chain over its kept draws. Right: how the ranks of each chain spread among those of "
        "all chains, relative to an even spread (dotted): chains that explore the same posterior lie about the line. "
        f"Shown are the free parameters, the {WORST_DISPLACEMENTS} displacements of the greatest R̂, the log density "
        "and both energies."
    )
    alt = "Trace and rank plots: " + ", ".join(trace.name.replace("$", "") for trace in shown)
    return Drawing("traces", "Traces and ranks", caption, alt, uri)


def _pairs(rows: int) -> tuple[Figure, np.ndarray]:
    """Pairs of a wide and a narrow panel, two to a row; placed by hand, since a solver takes seconds for so many."""
    height = 1.1 * rows + 0.6
    figure = Figure(figsize=(style.WIDTH, height))
    edges = {"left": 0.045, "right": 0.995, "top": 1 - 0.25 / height, "bottom": 0.4 / height}
    grid = figure.add_gridspec(rows, 5, width_ratios=[2.3, 1, 0.12, 2.3, 1], wspace=0.16, hspace=0.42, **edges)
    axes = np.array([[figure.add_subplot(grid[row, column]) for column in (0, 1, 3, 4)] for row in range(rows)])
    for panel in axes.ravel():
        panel.tick_params(labelbottom=False)
    return figure, axes.reshape(-1, 2)


def _choose(posterior: xr.Dataset, sample_stats: xr.Dataset, entries: Sequence[Estimand]) -> list[Trace]:
    parameters = [entry for entry in entries if entry.variable != DISPLACEMENT]
    displacements = [entry for entry in entries if entry.variable == DISPLACEMENT]
    if len(parameters) > MOST_PARAMETERS:
        parameters = worst(parameters, MOST_PARAMETERS)
    found = []
    for entry in [*parameters, *worst(displacements, WORST_DISPLACEMENTS)]:
        note = f"R̂ {rhat_text(entry.rhat)} · ESS {number(entry.ess_bulk, 2)}"
        found.append(Trace(symbolic(entry.name), note, draws_of(posterior, entry, SHOWN_DRAWS)))
    for name, title in STATISTICS.items():
        if name in sample_stats:
            draws = sample_stats[name].transpose("chain", "draw").to_numpy()
            found.append(Trace(title, "", draws[:, :: max(1, draws.shape[1] // SHOWN_DRAWS)]))
    return found


def symbolic(name: str) -> str:
    """ "u_x of node 3" with a proper index, for a figure."""
    name = style.literal(name)
    for plain in ("u_x", "u_y", "u_z", "T_s", "T_r"):
        name = name.replace(plain, f"${plain}$") if name.startswith(plain) else name
    return name


def _trace(axes: Axes, trace: Trace, total: int) -> None:
    at = np.linspace(0, total - 1, trace.draws.shape[1])
    for chain, colour in zip(trace.draws, style.chain_colours(len(trace.draws)), strict=True):
        axes.plot(at, chain, color=colour, lw=0.55, alpha=0.85)
    axes.set_title(trace.name, fontsize=8.5, pad=3)
    axes.set_title(trace.note, fontsize=7, color=style.MUTED, loc="right", pad=3)
    axes.set_xlim(0, max(1, total - 1))
    axes.yaxis.set_major_locator(MaxNLocator(3))
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.yaxis.set_major_formatter(FuncFormatter(_short))


def _short(value: float, _: int) -> str:
    text = f"{value / 1000:,.6g}k" if abs(value) >= 1e4 else f"{value:.6g}"
    return text.replace("-", "−")


def _ranks(axes: Axes, draws: np.ndarray) -> None:
    ranks = (stats.rankdata(draws, axis=None) - 0.5).reshape(draws.shape) / draws.size
    for chain, colour in zip(ranks, style.chain_colours(len(ranks)), strict=True):
        count, edges = np.histogram(chain, RANK_BINS, (0, 1))
        axes.stairs(count * RANK_BINS / chain.size, edges, color=colour, lw=0.9, baseline=None)
    axes.axhline(1, color=style.INK, lw=0.7, ls=":")
    axes.set(xlim=(0, 1), xticks=[0, 1], ylim=(0, None))
    axes.yaxis.set_major_locator(MaxNLocator(2, integer=True))


def distributions(mesh: TetMesh, entries: Sequence[Estimand], nodes: np.ndarray, threshold: float) -> Drawing:
    """Histograms of R-hat and ESS over all estimands, and where in the organ R-hat is worst."""
    with style.look():
        rows = 2 if len(nodes) else 1
        figure = style.new_figure(5.6 if len(nodes) else 2.5)
        axes = figure.subplots(rows, 3, height_ratios=[1, 1.25][:rows], squeeze=False)
        _histogram(axes[0, 0], entries, "rhat", "R̂", threshold)
        _histogram(axes[0, 1], entries, "ess_bulk", "effective sample size, bulk", None)
        _histogram(axes[0, 2], entries, "ess_tail", "effective sample size, tail", None)
        axes[0, 0].set_ylabel("displacements")
        if len(nodes):
            _map(figure, list(axes[1]), mesh, entries, nodes)
        uri = style.data_uri(figure)
    caption = (
        f"R̂ and effective sample size over all {len(entries):,} estimands: bars for the displacements, ticks "
        f"below for the elastic parameters; dashed, the R̂ of {threshold:g} that was asked for."
    )
    if len(nodes):
        caption = (
            f"Top: {caption} Bottom: the greatest R̂ of the three components at every sampled node, seen along z, y and "
            "x; the worst lie on top."
        )
    return Drawing("distributions", "Convergence of all estimands", caption, "Distributions of R-hat and ESS.", uri)


def _histogram(axes: Axes, entries: Sequence[Estimand], figure: str, label: str, threshold: float | None) -> None:
    values = np.array([getattr(entry, figure) for entry in entries])
    finite = values[np.isfinite(values) & (values > 0)]
    axes.set_xlabel(label)
    if finite.size == 0:
        axes.text(0.5, 0.5, "undefined", transform=axes.transAxes, ha="center")
        return
    logarithmic = finite.max() > (1.5 if threshold else 5) * finite.min()
    low, high = finite.min(), max(finite.max(), threshold or 0.0)
    high = high if high > low else low * 1.01
    axes.set_xscale("log" if logarithmic else "linear")
    edges = (np.geomspace if logarithmic else np.linspace)(low, high, 41)
    moved = [getattr(e, figure) for e in entries if e.variable == DISPLACEMENT]
    axes.stairs(np.histogram(moved, edges)[0], edges, fill=True, color=style.UNIFORM, alpha=0.8)
    _ticks(axes, [e for e in entries if e.variable != DISPLACEMENT], figure)
    if threshold:
        axes.axvline(threshold, color=style.ACCENT, ls=(0, (4, 2)), lw=1.1)
    if logarithmic:
        plain_log_axis(axes)


def plain_log_axis(axes: Axes) -> None:
    """Plain numbers along a logarithmic axis; also between the decades, where it spans less than one."""
    low, high = axes.get_xlim()
    short = high < 8 * low
    axes.xaxis.set_major_formatter(FuncFormatter(_short))
    if short:
        axes.xaxis.set_minor_locator(LogLocator(subs=(1.1, 1.2, 1.5, 2, 3, 5) if high < 3 * low else (2, 3, 5)))
    axes.xaxis.set_minor_formatter(FuncFormatter(_short) if short else NullFormatter())


def _ticks(axes: Axes, entries: Sequence[Estimand], figure: str) -> None:
    """Marks of the parameters below the bars."""
    top = axes.get_ylim()[1] or 1.0
    names = sorted({entry.variable for entry in entries})
    for name in names:
        values = [getattr(entry, figure) for entry in entries if entry.variable == name]
        colour, label = PARAMETER_COLOURS.get(name, style.ACCENT), SYMBOLS.get(name, name)
        axes.plot(values, np.full(len(values), -0.05 * top), "|", color=colour, ms=9, mew=1.6, label=label)
    axes.set_ylim(-0.1 * top, top)
    if figure == "rhat" and names:
        place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1, 1), "ncols": len(names)}
        axes.legend(handletextpad=0.1, columnspacing=1.2, **place)


def _map(figure: Figure, axes: list[Axes], mesh: TetMesh, entries: Sequence[Estimand], nodes: np.ndarray) -> None:
    """Worst R-hat of each node, as dots on three projections."""
    greatest = np.full(len(nodes), np.nan)
    for entry in entries:
        if entry.variable == DISPLACEMENT and np.isfinite(entry.rhat):
            greatest[entry.position[0]] = np.fmax(greatest[entry.position[0]], entry.rhat)
    order = np.argsort(np.nan_to_num(greatest, nan=-1.0), kind="stable")
    excess, points = np.clip(greatest[order] - 1, 1e-4, None), mesh.points[nodes[order]]
    known = excess[np.isfinite(excess)]
    norm = LogNorm(known.min(), max(known.max(), 1.01 * known.min())) if known.size else LogNorm(1e-4, 1)
    for panel, axis in zip(axes, (2, 1, 0), strict=True):
        across, up = IN_PLANE[axis]
        dots = {"c": excess, "norm": norm, "cmap": style.ERROR, "s": 22, "lw": 0.3, "ec": "white"}
        drawn = panel.scatter(points[:, across], points[:, up], **dots)
        panel.set_aspect("equal")
        (left, right), (bottom, top) = DIRECTIONS[across], DIRECTIONS[up]
        panel.set_xlabel(f"{left} — {right}, mm", fontsize=7.5)
        panel.set_ylabel(f"{bottom} — {top}, mm", fontsize=7.5)
    panels.colourbar(figure, drawn, axes, "greatest R̂ − 1 of a node", location="bottom", aspect=60, shrink=0.6)
