"""Samplers side by side on one posterior: a table and a figure of what effective draws cost."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from rich.table import Table as TerminalTable

from bayesreg.inference.chains.efficiency import Efficiency
from bayesreg.io.atomic import write_json, write_text
from bayesreg.report import style
from bayesreg.report.page import render
from bayesreg.report.style import Drawing
from bayesreg.report.tables import Table, in_terminal
from bayesreg.report.verdict import NONE, number, rhat_text

HEADER = (
    "", "ESS/s", "ESS/s, all in", "ESS per 1,000 evaluations", "ESS bulk", "ESS tail", "Worst R̂", "Acceptance",
    "Draws", "Prepared, s", "Sampling, s", "All, s", "Rule met, s",
)  # fmt: skip
IN_TERMINAL = ("ESS/s", "ESS/s, all in", "ESS per 1,000 evaluations", "Worst R̂", "All, s", "Rule met, s")
BARS = ("#2b5c8a", "#9bb8d3")


class Setting(NamedTuple):
    """The conditions that all samplers had in common.

    Attributes
    ----------
    name : str
        The name of the posterior.
    chains : int
    minutes : float
        Budget of each.
    rule : str
        The stop rule in words.
    """

    name: str
    chains: int
    minutes: float
    rule: str


def write_efficiencies(found: Sequence[Efficiency], setting: Setting, folder: str | Path) -> Path:
    """Write samplers.csv, samplers.json and samplers.html into a folder; the path of the page."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rows = [one._asdict() for one in found]
    text = io.StringIO()
    writer = csv.DictWriter(text, Efficiency._fields, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(folder / "samplers.csv", text.getvalue())
    write_json(folder / "samplers.json", {**setting._asdict(), "samplers": rows})
    drawn = [one for one in found if one.ess_per_second_in_all]
    content = {
        "title": "Samplers compared" + (f": {setting.name}" if setting.name else ""),
        "table": efficiency_table(found, setting),
        "notes": [f"{one.sampler} did not run: {one.note}" for one in found if one.note],
        "drawing": bars(drawn) if drawn else None,
    }
    write_text(folder / "samplers.html", render("efficiency.html", content))
    return folder / "samplers.html"


def efficiency_table(found: Sequence[Efficiency], setting: Setting) -> Table:
    """A row for each sampler, exact ones first, the most effective draws per second first."""
    exact = [_row(one) for one in _rank(found) if one.exact is not False]
    approximate = [_row(one) for one in _rank(found) if one.exact is False]
    caption = (
        f"One posterior, {setting.chains} chains and {setting.minutes:g} minutes for each sampler, which stops earlier "
        f"where its rule is met ({setting.rule}). ESS and R̂ are the worst of all estimands, ESS per second and per "
        "evaluation those of bulk and tail that are smaller. All in: with the search for the mode, the warm-up and all "
        "compilation; else draws alone. Evaluations: of the density with its gradient, or without for samplers that "
        "take none, after the warm-up. An R̂ far above one makes the ESS beside it worthless."
    )
    groups = [(title, rows) for title, rows in (("Exact", exact), ("Approximate", approximate)) if rows]
    return Table("Cost of effective draws", caption, list(HEADER), groups)


def terminal_table(table: Table) -> TerminalTable:
    """The most important columns of the table, for a terminal."""
    columns = [HEADER.index(name) for name in IN_TERMINAL]
    groups = []
    for title, rows in table.groups:
        mark = " (approximate)" if title == "Approximate" else ""
        groups.append((title, [[row[0] + mark, *(row[column] for column in columns)] for row in rows]))
    return in_terminal(Table(table.title, table.caption, [table.header[0], *IN_TERMINAL], groups))


def _rank(found: Sequence[Efficiency]) -> list[Efficiency]:
    return sorted(found, key=lambda one: -(one.ess_per_second or one.ess_per_second_in_all or 0.0))


def _row(one: Efficiency) -> list[str]:
    if one.note:
        return [one.sampler, *[NONE] * (len(HEADER) - 1)]
    per_thousand = None if one.ess_per_evaluation is None else 1000 * one.ess_per_evaluation
    return [
        one.sampler, number(one.ess_per_second), number(one.ess_per_second_in_all), number(per_thousand),
        number(one.ess_bulk), number(one.ess_tail), NONE if one.rhat is None else rhat_text(one.rhat),
        number(one.acceptance, 2), f"{one.draws:,}", number(one.preparing_seconds), number(one.sampling_seconds),
        number(one.seconds), number(one.seconds_to_rule),
    ]  # fmt: skip


def bars(found: Sequence[Efficiency]) -> Drawing:
    """ESS per second, draws alone and all in, and ESS per evaluation, on logarithmic axes."""
    ranked = _rank(found)[::-1]
    with style.look():
        figure = style.new_figure(0.9 + 0.36 * len(ranked))
        left, right = figure.subplots(1, 2, sharey=True)
        _bars(left, [one.ess_per_second for one in ranked], 0.2, BARS[0], "draws alone")
        _bars(left, [one.ess_per_second_in_all for one in ranked], -0.2, BARS[1], "all in")
        _bars(right, [one.ess_per_evaluation for one in ranked], 0.0, BARS[0], "", 0.5)
        left.set_yticks(range(len(ranked)), [one.sampler + ("" if one.exact else "*") for one in ranked])
        left.set_xlabel("least ESS per second")
        right.set_xlabel("least ESS per evaluation")
        left.legend(loc="lower right")
        uri = style.data_uri(figure, "svg")
    caption = "Effective draws of the worst estimand per second (left) and per evaluation of the density (right)."
    if not all(one.exact for one in ranked):
        caption += " *: approximate; effective draws of another distribution."
    return Drawing("efficiency", "Effective draws", caption, "Bars of effective sample sizes by sampler.", uri)


def _bars(
    axes: Axes, values: Sequence[float | None], shift: float, colour: str, label: str, height: float = 0.36
) -> None:
    """Bars of what is known."""
    known = [(place, value) for place, value in enumerate(values) if value]
    places, lengths = (np.array(part) for part in zip(*known, strict=True)) if known else (np.zeros(0), np.zeros(0))
    axes.barh(places + shift, lengths, height, color=colour, label=label)
    axes.set_xscale("log")
