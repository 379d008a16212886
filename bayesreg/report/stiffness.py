"""Maps of the stiffness within tissues: by element, or as a field relative to each tissue's mean."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LogNorm, Normalize

from bayesreg.report import panels, style
from bayesreg.report.estimands import elastic_draws
from bayesreg.report.panels import Row, View
from bayesreg.report.study import Study
from bayesreg.report.style import Drawing
from bayesreg.report.verdict import number

MEDIAN_DRAWS = 500


def by_element(study: Study) -> Drawing | None:
    """Draw the posterior median of λ/μ of every element on three planes; None unless parameters vary by element."""
    ratio = element_ratio(study)
    if ratio is None:
        return None
    norm = LogNorm(*np.nanquantile(ratio, (0.01, 0.99)))
    row = Row("median of λ/μ", lambda plane: study.view.slice(plane).cellwise(ratio), style.MAGNITUDE, norm)
    caption = "Posterior median of λ/μ of every tetrahedron; lines: interfaces of the tissues."
    return Drawing("elements", "Stiffness by element", caption, "Maps of the median of λ/μ.", _maps(study.view, [row]))


def element_ratio(study: Study) -> np.ndarray | None:
    """Compute the posterior median of λ/μ of every element, NaN if μ may be 0; None unless they vary by element."""
    lam, mu = elastic_draws(study.posterior, MEDIAN_DRAWS)
    if lam.shape[2:] != (len(study.mesh.cells),):
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = lam / mu
    return np.median(np.where(ratio > 0, ratio, np.nan), axis=(0, 1))


def field(study: Study) -> Drawing | None:
    """Draw mean, sd and P(> 1.5) of every element's stiffness over its tissue's; None unless there is a field."""
    predicted, mesh = study.predicted, study.mesh
    if predicted.stiffness_mean is None:
        return None
    mean, sd = np.asarray(predicted.stiffness_mean), np.asarray(predicted.stiffness_sd)
    likely, factor = np.asarray(predicted.stiffer_probability), float(np.asarray(predicted.stiffer))
    span = float(np.abs(np.log(mean)).max()) + 1e-3
    most = int(mean.argmax())
    view = View.of(study.run, mesh.points[mesh.cells[most]].mean(axis=0))
    rows = [
        Row("mean", lambda plane: view.slice(plane).cellwise(mean), style.SIGNED, LogNorm(np.exp(-span), np.exp(span))),
        Row("sd", lambda plane: view.slice(plane).cellwise(sd), style.ERROR, panels.from_zero(sd)),
        Row(f"P(> {factor:g})", lambda plane: view.slice(plane).cellwise(likely), style.MAGNITUDE, Normalize(0, 1)),
    ]
    caption = (
        "Stiffness of every tetrahedron over the geometric mean of its tissue: posterior mean, standard deviation, and "
        f"probability of more than {factor:g} times, through the stiffest tetrahedron ({number(float(mean[most]))} ± "
        f"{number(float(sd[most]))} times)."
    )
    return Drawing(
        "field", "Stiffness within the tissues", caption, "Maps of mean, sd, probability.", _maps(view, rows)
    )


def _maps(view: View, rows: list[Row]) -> str:
    with style.look():
        return style.data_uri(panels.map_rows(view, rows)[0])
