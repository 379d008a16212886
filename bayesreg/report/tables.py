"""Tables as text, and the tables of errors against a known truth: the paper's Tables 1 and 2, and coverage."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from bayesreg.report.metrics import WHOLE
from bayesreg.report.verdict import decimal_text, number, percent
from bayesreg.tissues import BRAIN, label_of

PAPER_TABLE_1 = {
    "Initial configuration": (2.56, 8.24, 15.08),
    "By tissue": (0.16, 0.72, 2.43),
    "Uniform": (0.18, 0.83, 2.40),
}
PAPER_TABLE_2 = {
    "By tissue": dict(zip((WHOLE, *BRAIN), (0.040, 0.049, 0.049, 0.023), strict=True)),
    "Uniform": dict(zip((WHOLE, *BRAIN), (0.065, 0.087, 0.067, 0.048), strict=True)),
}
STAGES = {"unregistered": "No motion", "initial": "Start of the chains", "posterior_mean": "Posterior mean"}


class Table(NamedTuple):
    """A table of texts.

    Attributes
    ----------
    title, caption : str
    header : list of str
        The first entry heads the row names.
    groups : list of (str, list of rows)
        Rows under a common heading (which may be empty); the first entry of a row is its name.
    """

    title: str
    caption: str
    header: list[str]
    groups: list[tuple[str, list[list[str]]]]
    kind: str = "table"


def error_tables(
    metrics: Mapping[str, Mapping[str, Any]], tissues: Sequence[str], with_paper: bool = False
) -> list[Table]:
    """Make Tables 1 and 2 and the coverage of runs (name -> metrics), and add the paper's values on request."""
    first_prefix, second_prefix = ("Table 1. ", "Table 2. ") if with_paper else ("", "")
    columns = ("median", "q95", "max")
    rows = _stages(metrics, "boundary_error", lambda error: [decimal_text(error.get(key)) for key in columns])
    paper = [[name, *map(decimal_text, row)] for name, row in PAPER_TABLE_1.items()]
    caption = "Distance between estimated and true displacement of the boundary nodes, mm."
    first = Table(
        first_prefix + "Error on the boundary", caption, ["", "Median", "95 %", "Max"], _beside(rows, paper, with_paper)
    )
    regions = (WHOLE, *tissues)
    rows = _stages(metrics, "mean_squared_error", lambda error: [number(error.get(key)) for key in regions])
    paper = [[name, *(decimal_text(row.get(key), 3) for key in regions)] for name, row in PAPER_TABLE_2.items()]
    caption = "Mean squared error of the displacement over the domain Ω and each tissue, mm²."
    header = ["", "Ω", *(f"Ω {label_of(name)}" for name in tissues)]
    second = Table(second_prefix + "Mean squared error", caption, header, _beside(rows, paper, with_paper))
    return [first, second, *_coverage(metrics)]


def _beside(rows: list[list[str]], paper: list[list[str]], with_paper: bool) -> list[tuple[str, list[list[str]]]]:
    return [("Here", rows), ("Paper", paper)] if with_paper else [("", rows)]


def _stages(
    metrics: Mapping[str, Mapping[str, Any]], name: str, texts: Callable[[Mapping[str, float]], list[str]]
) -> list[list[str]]:
    """Make rows of the stages of each run; stages that all runs share occur once."""
    rows: list[list[str]] = []
    for stage, label in STAGES.items():
        cells = {run: texts(figures[name][stage]) for run, figures in metrics.items() if stage in figures[name]}
        common = stage != "posterior_mean" and all(row == next(iter(cells.values())) for row in cells.values())
        if len(metrics) == 1 or common:
            new = [[label, *row] for row in list(cells.values())[:1]]
        else:
            new = [[run if stage == "posterior_mean" else f"{label}: {run}", *row] for run, row in cells.items()]
        rows += [row for row in new if stage == "posterior_mean" or row[1:] not in [earlier[1:] for earlier in rows]]
    return rows


def _coverage(metrics: Mapping[str, Mapping[str, Any]]) -> list[Table]:
    """Make a table of the coverage of true boundary displacements; empty if none was sampled."""
    coverage_by_run = {name: figures["coverage"] for name, figures in metrics.items() if figures.get("coverage")}
    if not coverage_by_run:
        return []
    levels = list(next(iter(coverage_by_run.values())))
    rows = [[name, *(percent(shares.get(level)) for level in levels)] for name, shares in coverage_by_run.items()]
    header = ["", *(f"{100 * float(level):.0f} %" for level in levels)]
    caption = "Share of the true boundary displacements (each component) inside their central posterior intervals."
    return [Table("Coverage", caption, header, [("", rows)])]
