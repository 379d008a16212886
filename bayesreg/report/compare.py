"""The comparison of two or more runs, as the paper compares three tissues with uniform parameters."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayesreg.report import panels, parameters, style, tables
from bayesreg.report.convergence import distributions, key_table
from bayesreg.report.marginals import ratio_panel
from bayesreg.report.metrics import divergence
from bayesreg.report.page import Opening, PageSection, write_page
from bayesreg.report.study import Study
from bayesreg.report.style import Drawing
from bayesreg.report.verdict import approximation
from bayesreg.types import InputError


def write_comparison(runs: Sequence[tuple], path: str | Path) -> None:
    """Write one page that sets runs side by side.

    Parameters
    ----------
    runs : sequence of tuples
        The arguments of `bayesreg.report.study.Study`; two or more.
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
    named = dict(zip(_names(studies), studies, strict=True))
    metrics = {name: study.metrics for name, study in named.items() if study.metrics}
    of_the_paper = all(study.is_of_the_paper for study in studies)
    errors = tables.error_tables(metrics, studies[0].mesh.names, of_the_paper) if metrics else []
    stiffness = [
        parameters.parameter_table(study)._replace(title=f"Elastic parameters: {name}") for name, study in named.items()
    ]
    title = " against ".join(named) if len(named) == 2 else "Comparison of " + ", ".join(named)
    verdicts = [(name, study.verdict) for name, study in named.items()]
    opening = Opening("Bayesian elastic registration · comparison", title, verdicts=verdicts, warnings=_warnings(named))
    sections = [
        PageSection("Registration", [*errors, _maps(named)]),
        PageSection("Stiffness", [_ratios(named), *stiffness]),
        PageSection("Convergence and cost", [key_table(named), distributions(named)]),
    ]
    write_page(path, opening, sections)


def _names(studies: Sequence[Study]) -> list[str]:
    """Make a unique name for each run: the variation of its parameters if this is unique, otherwise its own name."""
    names = [study.elasticity for study in studies]
    if len(set(names)) < len(names) or not all(names):
        names = [study.name for study in studies]
    if len(set(names)) == len(names):
        return names
    return [f"{name} ({k})" for k, name in enumerate(names, 1)]


def _warnings(named: dict[str, Study]) -> list[str]:
    """Write sentences about differences that make the comparison unfair."""
    first, *others = [study.run for study in named.values()]
    warnings = []
    if not all(_same(first.fixed, run.fixed) and _same(first.moving, run.moving) for run in others):
        warnings.append("These runs are not of one pair of images: their errors and maps cannot be compared directly.")
    if any(run.mesh.digest != first.mesh.digest for run in others):
        warnings.append("These runs are on different meshes.")
    doubts = {name: approximation(study.manifest) for name, study in named.items()}
    return warnings + [f"{name} is approximate. {text}" for name, text in doubts.items() if text]


def _same(a: Any, b: Any) -> bool:
    if a is None or b is None:
        return a is b
    return bool(np.allclose(a.affine, b.affine) and np.array_equal(a.voxels, b.voxels))


def _maps(named: dict[str, Study]) -> Drawing:
    """Draw the paper's Fig. 3: error, standard deviation and divergence of every run on one plane, on common scales."""
    studies = list(named.values())
    first = studies[0].view
    views, plane = [first.view_of(study.run) for study in studies], first.main
    rows = {"posterior sd, mm": [view.norm(plane, view.run.u_sd) for view in views]}
    if all(view.run.truth is not None for view in views):
        rows = {"|ū − u|, mm": [view.norm(plane, panels.error_of(view.run)) for view in views]} | rows
    rows["div ū"] = [view.divergence(plane, view.run.u_mean) for view in views]
    like = divergence(first.run.mesh, panels.true_or_mean_displacement(first.run))
    with style.look():
        height = style.WIDTH / (len(views) + 0.5) * np.ptp(plane.vertical) / np.ptp(plane.horizontal)
        figure = style.new_figure(len(rows) * min(height, 4.0) + 0.4)
        axes = figure.subplots(len(rows), len(views), squeeze=False)
        for row, (label, pictures) in zip(axes, rows.items(), strict=True):
            signed = label == "div ū"
            norm = panels.symmetric(like, quantile=0.98) if signed else panels.from_zero(*pictures)
            for panel, view, picture in zip(row, views, pictures, strict=True):
                drawn = panels.field_panel(panel, picture, plane, norm, style.SIGNED if signed else style.ERROR)
                panels.outline(panel, view, plane)
            panels.colourbar(figure, drawn, list(row), label)
        for panel, name in zip(axes[0], named, strict=True):
            panel.set_title(style.literal(name), weight="bold")
        uri = style.data_uri(figure)
    caption = f"Plane: {plane.title}; a column for each run; each row has one colour scale."
    return Drawing("maps", "Error, uncertainty and divergence", caption, "Maps of " + ", ".join(named) + ".", uri)


def _ratios(named: dict[str, Study]) -> Drawing:
    """Draw the paper's Fig. 4 for every run, one row each."""
    with style.look():
        figure = style.new_figure(2.5 * len(named))
        subfigures = figure.subfigures(len(named), 1, squeeze=False)
        for subfigure, (name, study) in zip(subfigures[:, 0], named.items(), strict=True):
            subfigure.suptitle(style.literal(name), fontsize=9, weight="bold", x=0.005, ha="left")
            panels_of_run = subfigure.subplots(1, len(study.parameters), squeeze=False)[0]
            for panel, group in zip(panels_of_run, study.parameters, strict=True):
                ratio_panel(panel, study.run, group)
        uri = style.data_uri(figure, "svg")
    caption = "Marginal posteriors of λ/μ with median and 95 % interval; dashed: truth, where it is known."
    return Drawing("ratios", "Stiffness ratios", caption, "Histograms of λ/μ of " + ", ".join(named) + ".", uri)
