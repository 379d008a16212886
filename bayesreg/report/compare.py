"""Two or more runs side by side, as the paper sets three tissues against uniform parameters."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from bayesreg.inference.draws.inference_data import dataset
from bayesreg.io.atomic import write_text
from bayesreg.io.records import Run
from bayesreg.report import panels, style, tables
from bayesreg.report.convergence import plain_log_axis
from bayesreg.report.estimands import Diagnosed, Estimand, estimands, parameter_groups
from bayesreg.report.html import elasticity_of, error_tables, metrics_of, name_of, render
from bayesreg.report.marginals import ratio_panel
from bayesreg.report.metrics import divergence
from bayesreg.report.panels import View
from bayesreg.report.style import Drawing
from bayesreg.report.tables import Table
from bayesreg.report.verdict import Verdict, approximation, key_facts, verdict
from bayesreg.types import InputError

RUN_COLOURS = ("#2b5c8a", "#b3560f", "#4f9d86", "#7d6aa8", "#a84a63", "#8aa34f")


class Study(NamedTuple):
    """A run with its draws and its convergence figures, as `write_report` takes them.

    Attributes
    ----------
    run : Run
    idata : InferenceData or DataTree
    rhat, ess_bulk, ess_tail : xarray.Dataset
    """

    run: Run
    idata: Any
    rhat: xr.Dataset
    ess_bulk: xr.Dataset
    ess_tail: xr.Dataset

    @property
    def posterior(self) -> xr.Dataset:
        """The draws of the run."""
        return dataset(self.idata, "posterior")

    @property
    def diagnosed(self) -> Diagnosed:
        """The convergence figures of the run."""
        return Diagnosed(self.rhat, self.ess_bulk, self.ess_tail)

    @property
    def entries(self) -> list[Estimand]:
        """The estimands of the run."""
        return estimands(self.run.mesh, self.diagnosed, self.posterior)


class Judged(NamedTuple):
    """A run's name and verdict."""

    name: str
    verdict: Verdict


def write_comparison(runs: Sequence[Study | tuple], path: str | Path) -> None:
    """Write one page that sets runs side by side.

    Parameters
    ----------
    runs : sequence of Study
        Or of tuples (run, idata, rhat, ess_bulk, ess_tail); two or more.
    path : path
        The HTML file; replaced in one step.

    Raises
    ------
    InputError
        If there are fewer than two runs.
    """
    studies = [Study(*run) for run in runs]
    if len(studies) < 2:
        raise InputError(f"a comparison needs two or more runs, got {len(studies)}")
    named = dict(zip(_names([study.run for study in studies]), studies, strict=True))
    metrics = {name: found for name, study in named.items() if (found := metrics_of(study.run, study.posterior))}
    tissues = studies[0].run.mesh.names
    content = {
        "title": " against ".join(named) if len(named) == 2 else "Comparison of " + ", ".join(named),
        "judged": [Judged(name, verdict(study.run.manifest, study.entries)) for name, study in named.items()],
        "notes": _notes(named),
        "facts": _facts_table(named),
        "error_tables": error_tables(metrics, tissues),
        "drawings": {drawing.key: drawing for drawing in (_maps(named), _ratios(named), _distributions(named))},
        "parameters": [
            tables.parameter_table(study.run, study.posterior, study.diagnosed)._replace(
                title=f"Elastic parameters: {name}"
            )
            for name, study in named.items()
        ],
    }
    write_text(path, render("compare.html", content))


def _names(runs: Sequence[Run]) -> list[str]:
    """A name for each run, none twice: how its parameters vary, where that tells them apart, else its own name."""
    names = [elasticity_of(run) for run in runs]
    if len(set(names)) < len(names) or not all(names):
        names = [name_of(run) for run in runs]
    if len(set(names)) == len(names):
        return names
    return [f"{name} ({k})" for k, name in enumerate(names, 1)]


def _notes(named: dict[str, Study]) -> list[str]:
    """Sentences about what makes the comparison unfair."""
    runs = [study.run for study in named.values()]
    found = []
    if not all(_same(runs[0].fixed, run.fixed) and _same(runs[0].moving, run.moving) for run in runs):
        found.append("These runs are not of one pair of images: their errors and maps cannot be compared directly.")
    if len({run.mesh.digest for run in runs}) > 1:
        found.append("These runs are on different meshes.")
    found += [
        f"{name} is approximate. {text}" for name, study in named.items() if (text := approximation(study.run.manifest))
    ]
    return found


def _same(a: Any, b: Any) -> bool:
    if a is None or b is None:
        return a is b
    return bool(np.allclose(a.affine, b.affine) and np.array_equal(a.voxels, b.voxels))


def _facts_table(named: dict[str, Study]) -> Table:
    """The key numbers, one column per run."""
    columns = [key_facts(study.run.manifest, study.entries, study.posterior) for study in named.values()]
    rows = [
        [facts[0].label, *(f"{fact.value} ({fact.note})" if fact.note else fact.value for fact in facts)]
        for facts in zip(*columns, strict=True)
    ]
    return Table("Key numbers", "", ["", *named], [("", rows)])


def _maps(named: dict[str, Study]) -> Drawing:
    """The paper's Fig. 3: error, standard deviation and divergence of every run on one plane, on common scales."""
    first = next(iter(named.values())).run
    view = View.of(first)
    views = [view.on(study.run) for study in named.values()]
    known = all(study.run.truth is not None for study in named.values())
    plane, rows = view.main, 3 if known else 2
    with style.look():
        columns = len(views) + 1
        height = style.WIDTH / (columns + 0.5) * np.ptp(plane.vertical) / np.ptp(plane.horizontal)
        figure = style.new_figure(rows * min(height, 4.0) + 0.4)
        axes = figure.subplots(rows, columns, squeeze=False)
        if known:
            _fill(axes[0], views, [one.error(plane) for one in views], "|ū − u|, mm")
        _fill(axes[-2], views, [one.spread(plane) for one in views], "posterior sd, mm")
        _fill_divergence(axes[-1], views)
        _fill_last(axes[:, -1], views, known)
        for panel, name in zip(axes[0], named, strict=False):
            panel.set_title(style.literal(name), weight="bold")
        uri = style.data_uri(figure)
    caption = f"The paper’s Fig. 3 for these runs, {plane.title}. " + (
        "Top: norm of the error of the posterior mean. Middle: " if known else "Top: "
    )
    caption += "posterior standard deviation. Bottom: divergence of the posterior mean. Each row has one colour scale. "
    caption += "Last column: distance between the posterior means" + (" of the first two" if len(views) > 2 else "")
    caption += ", the fixed image and the true divergence." if known else " and the fixed image."
    return Drawing("maps", "Error, uncertainty and divergence", caption, "Maps of " + ", ".join(named) + ".", uri)


def _fill(row: np.ndarray, views: list[View], pictures: list[np.ndarray], label: str) -> None:
    norm = panels.from_zero(*pictures)
    for panel, view, picture in zip(row, views, pictures, strict=False):
        drawn = panels.field_panel(panel, picture, view.main, norm, style.ERROR)
        panels.outline(panel, view, view.main)
    panels.colourbar(row[0].figure, drawn, list(row[: len(views)]), label)


def _fill_divergence(row: np.ndarray, views: list[View]) -> None:
    like = panels.true_or_mean_displacement(views[0].run)
    norm = panels.symmetric(divergence(views[0].run.mesh, like), quantile=0.98)
    for panel, view in zip(row, views, strict=False):
        picture = view.divergence(view.main, np.asarray(view.run.u_mean))
        drawn = panels.field_panel(panel, picture, view.main, norm, style.SIGNED)
        panels.outline(panel, view, view.main)
    panels.colourbar(row[0].figure, drawn, list(row[: len(views)]), "div ū")


def _fill_last(column: np.ndarray, views: list[View], known: bool) -> None:
    """How far the first two means lie apart, the fixed image, and the true divergence where it is known."""
    first, plane = views[0], views[0].main
    means = [view.slice(plane).nodal(view.run.u_mean) for view in views[:2]]
    picture = np.linalg.norm(means[1] - means[0], axis=-1)
    drawn = panels.field_panel(column[0], picture, plane, panels.from_zero(picture), style.MAGNITUDE)
    panels.outline(column[0], first, plane)
    panels.colourbar(column[0].figure, drawn, column[0], "mm")
    column[0].set_title("apart: |ū₂ − ū₁|")
    panels.image_panel(column[1], first.run.background, plane, panels.grey_limits(first.run))
    column[1].set_title("fixed f")
    if known:
        like = panels.true_or_mean_displacement(first.run)
        norm = panels.symmetric(divergence(first.run.mesh, like), quantile=0.98)
        panels.field_panel(column[2], first.divergence(plane, like), plane, norm, style.SIGNED)
        panels.outline(column[2], first, plane)
        column[2].set_title("true div u")


def _ratios(named: dict[str, Study]) -> Drawing:
    """The paper's Fig. 4 for every run, one row each."""
    grouped = {name: parameter_groups(study.run.mesh, study.posterior) for name, study in named.items()}
    with style.look():
        figure = style.new_figure(2.5 * len(named))
        parts = figure.subfigures(len(named), 1, squeeze=False)
        for part, (name, groups) in zip(parts[:, 0], grouped.items(), strict=True):
            part.suptitle(style.literal(name), fontsize=9, weight="bold", x=0.005, ha="left")
            for panel, group in zip(part.subplots(1, len(groups), squeeze=False)[0], groups, strict=True):
                ratio_panel(panel, named[name].run, group)
        uri = style.data_uri(figure, "svg")
    caption = "The paper’s Fig. 4 for these runs: marginal posteriors of λ/μ with median and 95 % interval"
    known = any(study.run.truth is not None for study in named.values())
    caption += "; dashed: truth." if known else "."
    return Drawing("ratios", "Stiffness ratios", caption, "Histograms of λ/μ of " + ", ".join(named) + ".", uri)


def _distributions(named: dict[str, Study]) -> Drawing:
    """R-hat and ESS over all estimands, as the share of estimands up to each value."""
    with style.look():
        figure = style.new_figure(2.6)
        axes = figure.subplots(1, 2)
        _cumulate(axes[0], named, "rhat", "R̂")
        _cumulate(axes[1], named, "ess_bulk", "effective sample size, bulk")
        axes[0].legend(loc="lower right")
        uri = style.data_uri(figure, "svg")
    caption = (
        "Share of all estimands up to each R̂ (left; steep and near one is good) and effective sample size (right)."
    )
    return Drawing("distributions", "Convergence", caption, "Distributions of R-hat and effective sample size.", uri)


def _cumulate(axes: Axes, named: dict[str, Study], figure: str, label: str) -> None:
    for (name, study), colour in zip(named.items(), RUN_COLOURS * len(named), strict=False):
        values = np.array([getattr(entry, figure) for entry in study.entries])
        if np.isfinite(values).any():
            axes.ecdf(values[np.isfinite(values)], label=style.literal(name), color=colour, lw=1.4)
    axes.set(xlabel=label, ylabel="share of estimands", xscale="log")
    plain_log_axis(axes)
