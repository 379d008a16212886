"""The report of one run: one HTML file that needs no network."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import xarray as xr
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from bayesreg import __version__
from bayesreg.inference.draws.inference_data import dataset
from bayesreg.io.atomic import write_text
from bayesreg.io.records import Run
from bayesreg.report import (
    adequacy,
    anatomy,
    convergence,
    density,
    evaluation,
    identifiability,
    landmarks,
    marginals,
    matching,
    modes,
    overlays,
    tables,
    uncertainty,
)
from bayesreg.report.estimands import Diagnosed, Estimand, estimands
from bayesreg.report.metrics import compute_metrics
from bayesreg.report.modes import Grouping, grouping
from bayesreg.report.panels import View
from bayesreg.report.summary import summarise_run
from bayesreg.report.three_d import three_d
from bayesreg.report.trust import explain_intervals
from bayesreg.report.verdict import (
    Verdict,
    approximation,
    duration,
    key_facts,
    part,
    threshold_of,
    verdict,
    warnings_of,
)

SECTIONS = (
    ("accuracy", "Registration"),
    ("pose", "Pose"),
    ("trust", "Uncertainty"),
    ("landmarks", "Landmarks"),
    ("evaluation", "Held out"),
    ("groups", "Chains that disagree"),
    ("stiffnesses", "Stiffness"),
    ("fit", "Fit"),
    ("one-node", "One node"),
    ("convergence", "Convergence"),
    ("model", "Model"),
    ("settings", "Settings"),
)
LONGEST_LIST = 8
PROVENANCE = {
    "model": "Model",
    "sampler": "Sampler",
    "timings": "Time",
    "versions": "Versions",
    "pair": "Synthetic pair",
    "images": "Digests of the images",
    "image_digests": "Digests of the images",
}


def write_report(
    run: Run, idata: Any, rhat: xr.Dataset, ess_bulk: xr.Dataset, ess_tail: xr.Dataset, path: str | Path
) -> None:
    """Write the report of a run.

    Parameters
    ----------
    run : Run
    idata : InferenceData or DataTree
        With the groups `posterior` and `sample_stats`, as in the run folder. The coordinate `node` of u_boundary
        holds mesh node indices.
    rhat, ess_bulk, ess_tail : xarray.Dataset
        The posterior's variables without chain and draw; NaN where an entry was not sampled.
    path : path
        The HTML file; replaced in one step.
    """
    posterior, sample_stats = dataset(idata, "posterior"), dataset(idata, "sample_stats")
    diagnosed = Diagnosed(rhat, ess_bulk, ess_tail)
    entries = estimands(run.mesh, diagnosed, posterior)
    metrics = {"This run": known} if (known := metrics_of(run, posterior)) else {}
    view, predicted, groups = View.of(run), run.predicted, grouping(posterior)
    apart = groups.groups > 1
    nodes = posterior.sizes["node"]
    fit = bool(predicted and predicted.discrepancies is not None)
    pairs = bool(predicted and predicted.landmark_names is not None)
    held_out = bool(predicted and predicted.evaluation_residual is not None)
    shown = {
        "evaluation": held_out,
        "groups": apart,
        "pose": predicted,
        "trust": predicted,
        "landmarks": pairs,
        "fit": fit,
        "one-node": nodes,
    }
    left_out = {key for key, wanted in shown.items() if not wanted}
    drawings = [
        *(draw(view) for draw in (anatomy.registration, overlays.checkerboard, anatomy.data, anatomy.result)),
        anatomy.displacement(view),
        matching.pose_picture(view),
        uncertainty.maps(view, predicted) if predicted else None,
        uncertainty.places(view, predicted) if predicted else None,
        landmarks.residuals(predicted) if predicted else None,
        evaluation.evaluation(predicted) if predicted else None,
        modes.modes(view, groups) if apart else None,
        marginals.stiffness(run, posterior),
        anatomy.element_stiffness(view, posterior),
        anatomy.stiffness_field(view, predicted) if predicted else None,
        marginals.temperatures(run, posterior),
        adequacy.residual(view),
        marginals.skull_node(run, posterior) if nodes else None,
        convergence.traces(posterior, sample_stats, entries),
        convergence.distributions(run.mesh, entries, posterior["node"].to_numpy(), threshold_of(run.manifest)),
    ]
    judged = _judge(run.manifest, entries, groups)
    content = {
        "title": name_of(run),
        "subtitle": _subtitle(run, posterior),
        "sections": [(key, name) for key, name in SECTIONS if key not in left_out],
        "approximation": approximation(run.manifest),
        "verdict": judged,
        "summary": summarise_run(run, predicted, judged) if predicted else [],
        "facts": key_facts(run.manifest, entries, posterior),
        "warnings": warnings_of(run.manifest, run.mesh, posterior),
        "drawings": {drawing.key: drawing for drawing in drawings if drawing is not None},
        "swipes": overlays.swipes(view),
        "three_d": three_d(view, predicted) if predicted else None,
        "error_tables": error_tables(metrics, run.mesh.names),
        "notes": matching.notes(run.manifest),
        "pose": matching.pose_table(predicted) if predicted else None,
        "trust": explain_intervals(run.manifest),
        "places": uncertainty.place_table(view, predicted) if predicted else None,
        "landmarks": landmarks.landmark_table(run.mesh, predicted) if predicted else None,
        "evaluation": evaluation.evaluation_table(predicted) if predicted else None,
        "groups": modes.explanation(groups) if apart else "",
        "differences": modes.difference_table(run.mesh, posterior, groups) if apart else None,
        "readings": identifiability.readings(run.mesh, posterior, diagnosed, run.manifest),
        "ratios": identifiability.ratio_table(run.mesh, posterior),
        "widths": identifiability.width_table(run.mesh, posterior, diagnosed, run.manifest),
        "parameters": tables.parameter_table(run, posterior, diagnosed),
        "checks": adequacy.check_table(predicted) if predicted else None,
        "worst": tables.worst_table(entries),
        "provenance": provenance(run.manifest),
        "config": run.config,
        "elastography": not nodes,
        "formula": density.formula(run.manifest, not nodes),
        "skull": run.skull is not None,
        "similarity_energy": density.similarity_energy(run.manifest),
        "observed": density.observation_table(run.manifest),
    }
    write_text(path, render("template.html", content))


def _judge(manifest: Mapping[str, Any], entries: Sequence[Estimand], groups: Grouping) -> Verdict:
    """The verdict, with a word on chains that lie apart."""
    judged = verdict(manifest, entries)
    if groups.groups == 1:
        return judged
    apart = f" The chains lie in {groups.groups} groups, each shown by itself under “Chains that disagree”."
    return judged._replace(detail=(judged.detail + apart).strip())


def render(template: str, content: Mapping[str, Any]) -> str:
    """A page from a template; all text is escaped."""
    environment = Environment(
        loader=PackageLoader("bayesreg", "report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.filters["indexed"] = _index
    style = Markup(files("bayesreg.report").joinpath("style.css").read_text(encoding="utf-8"))
    return environment.get_template(template).render(version=__version__, style=style, **content)


def _index(text: str) -> Markup:
    """Escaped text in which u_x, T_s and the like get a subscript."""
    return Markup(re.sub(r"\b([uTE])_([xyzrs])\b", r"\1<sub>\2</sub>", str(escape(text))))


def name_of(run: Run) -> str:
    """The run's name, else what it sampled."""
    return str(run.manifest.get("name") or elasticity_of(run) or "Registration")


def elasticity_of(run: Run) -> str:
    """How the elastic parameters vary, for people."""
    known = {"tissue": "By tissue", "uniform": "Uniform", "element": "By element", "field": "By tissue, with a field"}
    return known.get(str(part(run.manifest, "model", "elasticity")), "")


def metrics_of(run: Run, posterior: xr.Dataset) -> dict[str, Any] | None:
    """The run's metrics, made now where they were not stored; None where no truth is known."""
    if run.metrics is not None or run.truth is None:
        return run.metrics
    return compute_metrics(run.mesh, run.u_mean, run.truth, posterior)


def error_tables(metrics: Mapping[str, Mapping[str, Any]], tissues: tuple[str, ...]) -> list[tables.Table]:
    """Tables 1 and 2 and the coverage; none where no truth is known."""
    if not metrics:
        return []
    made = [tables.boundary_error_table(metrics), tables.squared_error_table(metrics, tissues)]
    covered = tables.coverage_table(metrics)
    return made + ([covered] if covered else [])


def _subtitle(run: Run, posterior: xr.Dataset) -> str:
    sampler = part(run.manifest, "sampler", "name")
    exact = {True: "exact", False: "approximate"}.get(part(run.manifest, "exact"))
    nodes = posterior.sizes["node"]
    given = "Elastography: posterior of the elastic parameters, the displacement of the boundary given"
    parts = [
        f"Joint posterior of the displacement at {nodes:,} nodes and the elastic parameters" if nodes else given,
        f"parameters {elasticity_of(run).lower()}" if elasticity_of(run) else None,
        f"sampler {sampler}" + (f" ({exact})" if exact else "") if sampler else None,
    ]
    return " · ".join(text for text in parts if text)


def provenance(manifest: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """The provenance of a run, in named lists of key and value."""
    listed = []
    for key, title in PROVENANCE.items():
        flat = _flat(manifest.get(key) or {})
        if key == "timings":
            flat = [(name, duration(float(value))) for name, value in flat if value not in ("", "None")]
        if flat:
            listed.append((title, flat))
    rest = [(key, manifest.get(key)) for key in ("seed", "devices", "mesh_digest", "exact")]
    listed.append(("Run", [(key.replace("_", " "), str(value)) for key, value in rest if value is not None]))
    return listed


def _flat(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    if isinstance(value, list) and len(value) > LONGEST_LIST:
        return [(prefix, f"{len(value)} entries")]
    if not isinstance(value, Mapping):
        return [(prefix, str(value))]
    return [pair for key, entry in value.items() for pair in _flat(entry, f"{prefix}.{key}" if prefix else str(key))]
