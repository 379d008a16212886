"""The tables of a report, as text: the paper's Tables 1 and 2, the parameters, the worst estimands, coverage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from rich.table import Table as TerminalTable

from bayesreg.io.records import Run
from bayesreg.report.estimands import SYMBOLS, Diagnosed, Estimand, Group, parameter_groups, worst
from bayesreg.report.metrics import WHOLE
from bayesreg.report.verdict import NONE, fixed, number, percent, place_text, rhat_text
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
WORST_SHOWN = 10


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


def in_terminal(table: Table) -> TerminalTable:
    """A table for a terminal, without its caption."""
    shown = TerminalTable(title=table.title)
    for index, name in enumerate(table.header):
        shown.add_column(name, justify="right" if index else "left")
    for _, rows in table.groups:
        for row in rows:
            shown.add_row(*row)
    return shown


def boundary_error_table(metrics: Mapping[str, Mapping[str, Any]]) -> Table:
    """Table 1 of runs (name -> metrics) beside the paper's."""
    errors = {name: one["boundary_error"] for name, one in metrics.items()}
    columns = ("median", "q95", "max")
    ours = [[label, *(fixed(found.get(key)) for key in columns)] for label, found in _stages(errors)]
    paper = [[name, *map(fixed, row)] for name, row in PAPER_TABLE_1.items()]
    caption = "Distance between estimated and true displacement of the boundary nodes, mm."
    return Table(
        "Table 1. Error on the boundary", caption, ["", "Median", "95 %", "Max"], _beside(ours, paper, metrics)
    )


def squared_error_table(metrics: Mapping[str, Mapping[str, Any]], tissues: Sequence[str]) -> Table:
    """Table 2 of runs (name -> metrics) beside the paper's."""
    errors = {name: one["mean_squared_error"] for name, one in metrics.items()}
    columns = (WHOLE, *tissues)
    ours = [[label, *(number(found.get(key)) for key in columns)] for label, found in _stages(errors)]
    paper = [[name, *(fixed(row.get(key), 3) for key in columns)] for name, row in PAPER_TABLE_2.items()]
    caption = "Mean squared error of the displacement over the domain and each tissue (exact for linear elements), mm²."
    header = ["", "Ω", *(f"Ω {label_of(name)}" for name in tissues)]
    return Table("Table 2. Mean squared error", caption, header, _beside(ours, paper, metrics))


def _beside(ours: list[list[str]], paper: list[list[str]], metrics: Mapping[str, Any]) -> list[tuple[str, list]]:
    return [("This run" if len(metrics) == 1 else "These runs", ours), ("Paper", paper)]


def _stages(errors: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, Mapping[str, Any]]]:
    """Labelled rows: what all runs share once, then one row per run."""
    rows = []
    for stage, label in STAGES.items():
        found = {name: one[stage] for name, one in errors.items() if stage in one}
        if stage == "initial" and all(errors[name].get("unregistered") == one for name, one in found.items()):
            continue
        values = list(found.values())
        if len(errors) == 1 or (stage != "posterior_mean" and all(one == values[0] for one in values)):
            rows += [(label, one) for one in values[:1]]
        else:
            rows += [(name if stage == "posterior_mean" else f"{label}: {name}", one) for name, one in found.items()]
    return rows


def coverage_table(metrics: Mapping[str, Mapping[str, Any]]) -> Table | None:
    """How many true boundary displacements lie in their intervals."""
    known = {name: one["coverage"] for name, one in metrics.items() if one.get("coverage")}
    if not known:
        return None
    levels = list(next(iter(known.values())))
    rows = [[name, *(percent(found.get(level)) for level in levels)] for name, found in known.items()]
    header = ["", *(f"{float(level):.0%}".replace("%", " %") for level in levels)]
    caption = "Share of the true boundary displacements (each component) inside their central posterior intervals."
    return Table("Coverage", caption, header, [("", rows)])


def parameter_table(run: Run, posterior: xr.Dataset, diagnosed: Diagnosed) -> Table:
    """Median, 95 % interval, truth and convergence of λ, μ and λ/μ by tissue."""
    groups = []
    for index, group in enumerate(parameter_groups(run.mesh, posterior)):
        truth = _truth(run, group.name)
        rows = [
            _parameter_row(name, draws, truth.get(name), _figures(diagnosed, name, index, group))
            for name, draws in (("ratio", group.ratio), ("lam", group.lam), ("mu", group.mu))
        ]
        groups.append((label_of(group.name), rows))
    caption = (
        "With no forces inside, only ratios shape the deformation; the scale enters through the elastic temperature "
        "alone. A fixed parameter has no interval."
    )
    header = ["", "Median", "95 % interval", "Truth", "R̂", "ESS bulk", "ESS tail"]
    return Table("Elastic parameters", caption, header, groups)


def _parameter_row(name: str, draws: np.ndarray, truth: float | int | None, figures: list[float]) -> list[str]:
    known = draws[np.isfinite(draws)]
    if known.size == 0:
        return [SYMBOLS[name], "undefined", NONE, number(truth), NONE, NONE, NONE]
    low, median, high = (number(float(value)) for value in np.quantile(known, (0.025, 0.5, 0.975)))
    if np.ptp(known) == 0:
        return [SYMBOLS[name], median, "fixed", number(truth), NONE, NONE, NONE]
    rhat, bulk, tail = figures
    shown = [NONE if np.isnan(rhat) else rhat_text(rhat), number(bulk), number(tail)]
    return [SYMBOLS[name], median, f"{low} to {high}", number(truth), *shown]


def _figures(diagnosed: Diagnosed, name: str, index: int, group: Group) -> list[float]:
    """R-hat and both ESS of one parameter; none where elements are gathered."""
    if group.lam.shape[-1] != 1 or name not in diagnosed.rhat:
        return [float("nan")] * 3
    return [float(np.ravel(part[name].to_numpy())[index]) for part in diagnosed]


def _truth(run: Run, name: str) -> dict[str, float]:
    if run.truth is None or name not in run.mesh.names:
        return {}
    k = run.mesh.names.index(name)
    lam, mu = float(np.asarray(run.truth.lam)[k]), float(np.asarray(run.truth.mu)[k])
    return {"lam": lam, "mu": mu, "ratio": lam / mu}


def worst_table(entries: Sequence[Estimand]) -> Table:
    """The estimands of the greatest R-hat, with their places in numbers and in words."""
    rows = [
        [
            entry.name,
            place_text(entry.place) if entry.place else NONE,
            entry.region or NONE,
            rhat_text(entry.rhat),
            number(entry.ess_bulk),
            number(entry.ess_tail),
        ]
        for entry in worst(entries, WORST_SHOWN)
    ]
    caption = f"The {len(rows)} of {len(entries):,} estimands whose chains agree least."
    header = ["", "Place (x, y, z)", "Where", "R̂", "ESS bulk", "ESS tail"]
    return Table("Worst estimands", caption, header, [("", rows)])
