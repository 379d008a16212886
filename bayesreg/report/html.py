"""The report of a run: one HTML file that needs no network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from bayesreg.io.records import Run
from bayesreg.report import anatomy
from bayesreg.report.page import Opening, PageSection, write_page
from bayesreg.report.panels import View
from bayesreg.report.sections import SECTIONS
from bayesreg.report.study import Study, image_differences
from bayesreg.report.summary import answers
from bayesreg.report.verdict import approximation, nested_entry, warnings_of

KICKER = "Bayesian elastic registration"
FIRST = (
    "The run goes on. What follows is Laplace’s approximation: the Gaussian with the curvature of the posterior near "
    "its mode. The report of the draws will replace this page when they have converged, or when their budget is spent; "
    "bayesreg run --resume goes on with a run that was interrupted."
)


def write_report(
    run: Run, idata: Any, rhat: xr.Dataset, ess_bulk: xr.Dataset, ess_tail: xr.Dataset, path: str | Path
) -> None:
    """Write the report of a run.

    Parameters
    ----------
    run, idata, rhat, ess_bulk, ess_tail
        As in `bayesreg.report.study.Study`.
    path : path
        The HTML file; replaced in one step.
    """
    study = Study(run, idata, rhat, ess_bulk, ess_tail)
    write_page(path, _opening(study), [section.page_section(study) for section in SECTIONS if section.applies(study)])


def write_first_report(run: Run, reach: Float[np.ndarray, "nodes"], path: str | Path) -> None:
    """Write the report of the first answer, which the report of the draws replaces later.

    Parameters
    ----------
    run : Run
        Of its manifest, the entries `name` and `appraisal` are read.
    reach : (n,) array
        Radius of the ball around the mean that holds each displaced node with 95 % probability, mm.
    path : path
        The HTML file; replaced in one step.
    """
    view = View.of(run)
    before_and_after = anatomy.before_and_after(run, view, image_differences(run))
    opening = Opening(
        kicker=KICKER,
        title=str(run.manifest["name"] or "Registration"),
        lead="First answer, before the first draw",
        approximation=FIRST,
        warnings=nested_entry(run.manifest, "appraisal", "warnings") or [],
    )
    displacement = anatomy.displacement(run, view, reach)
    sections = [
        PageSection("Registration", [before_and_after] if before_and_after else []),
        PageSection("Displacement", [displacement]),
    ]
    write_page(path, opening, sections)


def _opening(study: Study) -> Opening:
    return Opening(
        kicker=KICKER,
        title=str(study.manifest.get("name") or "Registration"),
        lead=_describe(study),
        verdicts=[("", study.verdict)],
        answers=answers(study),
        approximation=approximation(study.manifest),
        warnings=warnings_of(study.manifest, study.mesh, study.posterior),
    )


def _describe(study: Study) -> str:
    """Describe in one line what was sampled and how."""
    unknowns = "Elastography: posterior of the elastic parameters, the displacement of the boundary given"
    if study.samples_nodes:
        nodes = study.posterior.sizes["node"]
        unknowns = f"Joint posterior of the displacement at {nodes:,} nodes and the elastic parameters"
    exact = {True: " (exact)", False: " (approximate)"}.get(nested_entry(study.manifest, "exact"), "")
    sampler = nested_entry(study.manifest, "sampler", "name")
    phrases = [unknowns, study.elasticity and f"parameters {study.elasticity.lower()}", sampler and f"{sampler}{exact}"]
    return " · ".join(text for text in phrases if text)
