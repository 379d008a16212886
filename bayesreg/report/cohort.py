"""The table of a cohort, and a page with all runs: the state of each, and the stiffness of tissues in all of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.ticker import MaxNLocator

from bayesreg.io.atomic import replacing, write_text
from bayesreg.report import style
from bayesreg.report.page import Opening, PageSection, write_page
from bayesreg.report.style import Drawing
from bayesreg.report.tables import Table
from bayesreg.report.verdict import Verdict, decimal_text, number

TABLE, PARQUET, PAGE = "cohort.csv", "cohort.parquet", "cohort.html"
# A cohort of more runs is drawn without their names.
MOST_NAMED = 60
# The greatest number of panels side by side.
MOST_COLUMNS = 6
COLUMNS = {
    "R̂": "rhat_max",
    "Least ESS": "ess_min",
    "Mean, mm": "shift_mean_mm",
    "Greatest, mm": "shift_max_mm",
    "Radius, mm": "radius95_mean_mm",
    "Minutes": "minutes",
}
# An axis is logarithmic if its values differ by more than this factor.
DECADES = 30


def write_cohort(table: pd.DataFrame, out: Path) -> None:
    """Write cohort.csv, cohort.parquet and cohort.html into a folder.

    Parameters
    ----------
    table : DataFrame
        As `bayesreg.workflow.batch.batch` makes it.
    out : Path
    """
    write_text(out / TABLE, table.to_csv(index=False))
    with replacing(out / PARQUET) as temporary:
        # A setting of a sweep may have values of several types, which Parquet cannot store in one column.
        mixed = {name: table[name].astype(str) for name in table if table[name].dtype == object}
        table.assign(**mixed).to_parquet(temporary)
    failed = table[table["state"] == "failed"]
    finished = table[table["state"] == "finished"]
    converged = int((finished["converged"] == True).sum()) if len(finished) else 0  # noqa: E712 - None is not False
    headline = f"{len(finished)} of {len(table)} runs have finished, {converged} converged; {len(failed)} failed."
    sound = not len(failed) and converged == len(table)
    failures = [f"{row['folder']}: {row.get('message', '')}" for row in failed.to_dict("records")]
    opening = Opening(
        "Bayesian elastic registration · cohort",
        out.name,
        verdicts=[("", Verdict(sound, headline, ""))],
        warnings=failures,
    )
    sections = [PageSection("Runs", [_table(finished), _stiffness(finished)])] if len(finished) else []
    write_page(out / PAGE, opening, sections)


def _table(finished: pd.DataFrame) -> Table:
    """Make a table with a row for each run, whose name links to its report."""
    link = Markup('<a href="{0}/report.html">{0}</a>')
    rows = [
        [link.format(name), *(_text(row.get(column)) for column in COLUMNS.values())]
        for name, row in zip(finished["folder"], finished.to_dict("records"), strict=True)
    ]
    caption = (
        "Each name leads to the report of its run. Displacement: mean and greatest length over the organ, the pose "
        "left out. Radius: mean over the organ of the radius within which a point lies with 95 %."
    )
    return Table("Results", caption, ["", *COLUMNS], [("", rows)])


def _text(value: Any) -> str:
    is_finite = value is not None and np.isfinite(value)
    return (decimal_text(value) if abs(value) < 1000 else number(value)) if is_finite else number(None)


def _stiffness(finished: pd.DataFrame) -> Drawing:
    """Draw λ and μ of every tissue, with a line for each run."""
    names = [name.removesuffix("_low") for name in finished if str(name).endswith("_low")]
    named, columns = len(finished) <= MOST_NAMED, min(len(names), MOST_COLUMNS)
    rows = -(-len(names) // columns)
    with style.look():
        figure = style.new_figure(rows * (0.8 + 0.16 * min(len(finished), 4 * MOST_NAMED)))
        grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
        axes = grid.ravel()
        for panel in axes[len(names) :]:
            panel.remove()
        heights = np.arange(len(finished))[::-1]
        for panel, name in zip(axes, names, strict=False):
            low, middle, high = (finished[f"{name}{end}"].to_numpy(float) for end in ("_low", "", "_high"))
            panel.hlines(heights, low, high, color=style.ACCENT, lw=1.0)
            panel.plot(middle, heights, "o", ms=3, color=style.ACCENT)
            panel.set(title=style.literal(name.replace("_", " ").replace("lam", "λ").replace("mu", "μ")))
            if high.max() > DECADES * low.min() > 0:
                panel.set_xscale("log")
            else:
                panel.xaxis.set_major_locator(MaxNLocator(3))
        labels = [style.literal(name) for name in finished["folder"]]
        for panel in grid[:, 0]:
            panel.set_yticks(heights if named else [], labels if named else [])
        uri = style.data_uri(figure)
    caption = "Median and 95 % interval of λ and μ by tissue, relative; a line for each run, in the order of the table."
    return Drawing("stiffness", "λ and μ", caption, f"Stiffness of {len(finished)} runs.", uri)
