"""The observations in the report: the terms of the density, the fit of each observation, and the parts of each kind."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from bayesreg.io.records import Predicted
from bayesreg.mesh import TetMesh
from bayesreg.model.observations.registry import kinds
from bayesreg.model.observations.section import ObservationSection, ReportFigure, ReportTable
from bayesreg.report import style
from bayesreg.report.estimands import symbol_of
from bayesreg.report.places import regions
from bayesreg.report.style import Drawing
from bayesreg.report.tables import Table
from bayesreg.report.verdict import NONE, nested_entry, number, place_text

_log = logging.getLogger(__name__)


def formula(manifest: Mapping[str, Any], elastography: bool) -> Markup:
    """Write the logarithm of the density as a sum of its terms.

    Parameters
    ----------
    manifest : mapping
    elastography : bool
        Whether the displacement of the boundary is given; then it has no prior.
    """
    elastic = nested_entry(manifest, "model", "elastic_prior") or {}
    loads, normalised = elastic.get("kind") == "loads", elastic.get("normalised")
    priors = {
        " + log p(<var>u</var> | λ, μ, random loads)": loads,
        " − <var>E</var><sub>r</sub> / <var>T</var><sub>r</sub>": not loads,
        " − log <var>Z</var>(λ, μ, <var>T</var><sub>r</sub>)": normalised and not loads,
        " + log p(rigid motion of <var>u</var>)": nested_entry(manifest, "model", "rigid_sd") is not None,
    }
    observed = [
        _kind(observation).log_density(str(escape(name))) for name, observation in observations_of(manifest).items()
    ]
    prior = "".join(text for text, holds in priors.items() if holds and not elastography)
    scales = [f" + log p({_symbol(name)})" for name in nested_entry(manifest, "scales") or {}]
    total = "".join(observed) + prior + " + log p(λ) + log p(μ)" + "".join(scales)
    return Markup(re.sub("^ − ", "−", total).removeprefix(" + "))


def _symbol(name: str) -> str:
    """Return the symbol of a scale in HTML, without its unit."""
    symbol = str(escape(symbol_of(name).removesuffix(", mm")))
    return re.sub(r"^T_([rs])\b", r"<var>T</var><sub>\1</sub>", symbol)


def explanations(manifest: Mapping[str, Any]) -> list[Markup]:
    """Explain the terms of the observations, in a sentence for each term that has an explanation."""
    texts = [_kind(observation).explain(name, observation) for name, observation in observations_of(manifest).items()]
    return [Markup(text) for text in texts if text]


def observation_table(manifest: Mapping[str, Any]) -> Table | None:
    """Make a table of the fit of each observation at the posterior mean; None if the run has no such entry."""
    observed = observations_of(manifest)
    rows = [
        [
            name.replace("_", " "),
            observation["title"],
            f"{observation['values']:,}" if "values" in observation else NONE,
            number(observation.get("residual_rms")),
            number(observation["log"]),
        ]
        for name, observation in observed.items()
    ]
    caption = (
        "At the posterior mean. Residual over sd: the root mean square of the residuals in units of the sd that the "
        "model gives them; about 1 where the model holds, less where there are many unknowns to so many values. Log: "
        "of the term of the density, up to its constant."
    )
    header = ["", "Kind", "Values", "Residual over sd", "Log"]
    return Table("What was observed", caption, header, [("", rows)]) if rows else None


def shown_by_kinds(manifest: Mapping[str, Any], mesh: TetMesh, predicted: Predicted | None) -> list[Drawing | Table]:
    """Make the figures and tables that the kind of each observation provides."""
    if predicted is None:
        return []
    shown: list[Drawing | Table] = []
    for name, observation in observations_of(manifest).items():
        summary = {key: np.asarray(value) for key, value in predicted.of_observation(name).items()}
        shown += [_drawing(figure) for figure in _kind(observation).figures(name, summary, mesh.names, observation)]
        shown += [_table(table, mesh) for table in _kind(observation).tables(name, summary)]
    return shown


def observations_of(manifest: Mapping[str, Any]) -> Mapping[str, Mapping[str, Any]]:
    """Return the descriptions of the observations in run.json, by name."""
    return nested_entry(manifest, "observations") or {}


def _kind(described: Mapping[str, Any]) -> type[ObservationSection]:
    """Return the class of a kind of observation; the base class, with a warning, if the kind is not registered."""
    if described["kind"] not in kinds():
        _log.warning(
            "the report leaves out tables and figures of %s: no installed package registers this kind of observation",
            described["kind"],
        )
    return kinds().get(described["kind"], ObservationSection)


def _drawing(figure: ReportFigure) -> Drawing:
    with style.look():
        drawn = style.new_figure(figure.height)
        figure.draw(drawn, style)
        uri = style.data_uri(drawn, "svg")
    return Drawing(figure.name, figure.title, figure.caption, figure.alt, uri)


def _table(table: ReportTable, mesh: TetMesh) -> Table:
    header, rows = table.header, [[_cell(cell) for cell in row] for row in table.rows]
    if table.places is not None:
        words = regions(mesh, table.places)
        texts = [place_text((float(x), float(y), float(z))) for x, y, z in table.places]
        header = [header[0], "Place (x, y, z), mm", "Where", *header[1:]]
        rows = [[row[0], text, where, *row[1:]] for row, text, where in zip(rows, texts, words, strict=True)]
    return Table(table.title, table.caption, header, [("", rows)])


def _cell(cell: Any) -> str:
    return cell if isinstance(cell, str) else number(None if cell is None else float(cell))
