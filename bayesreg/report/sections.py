"""The sections of a report: first the questions of a clinician, then the statistics."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from bayesreg.report import (
    anatomy,
    convergence,
    evaluation,
    marginals,
    modes,
    observations,
    paper,
    parameters,
    pose,
    stiffness,
    tables,
    trust,
    uncertainty,
)
from bayesreg.report.page import Item, PageSection, render
from bayesreg.report.study import Study
from bayesreg.report.three_d import three_d
from bayesreg.report.verdict import nested_entry

Draw = Callable[[Study], Item | list[Item] | None]


def _always(_: Study) -> bool:
    return True


class Section(NamedTuple):
    """A section of the report.

    Attributes
    ----------
    title : str
    draws : list of functions
        Each makes a figure, a table, or several of them; None or an empty list if a run has none.
    applies : function
        Whether a run has this section.
    """

    title: str
    draws: Sequence[Draw]
    applies: Callable[[Study], bool] = _always

    def page_section(self, study: Study) -> PageSection:
        """Draw the section for a run."""
        items: list[Item] = []
        for draw in self.draws:
            drawn = draw(study)
            items += drawn if isinstance(drawn, list) else [drawn] if drawn else []
        return PageSection(self.title, items)


def _before_and_after(study: Study) -> Item | None:
    return anatomy.before_and_after(study.run, study.view, study.image_differences)


def _displacement(study: Study) -> Item:
    return anatomy.displacement(study.run, study.view, np.asarray(study.predicted.reach))


def _fit(study: Study) -> list[Item]:
    table = observations.observation_table(study.manifest)
    shown = observations.shown_by_kinds(study.manifest, study.mesh, study.predicted)
    return [*([] if table is None else [table]), *shown]


def _errors(study: Study) -> list[Item]:
    metrics = {"This run": study.metrics} if study.metrics else {}
    return [*tables.error_tables(metrics, study.mesh.names, study.is_of_the_paper)] if metrics else []


def _convergence(study: Study) -> list[Item]:
    return [convergence.key_table({"": study}), convergence.distributions({"": study})]


def _model(study: Study) -> list[Item]:
    elastography = not study.samples_nodes
    content = {
        "formula": observations.formula(study.manifest, elastography),
        "explanations": observations.explanations(study.manifest),
        "images": study.run.fixed is not None,
        "hard_wall": nested_entry(study.manifest, "model", "skull_width") == 0,
        "skull": study.run.skull is not None,
        "elastography": elastography,
    }
    return [Markup(render("model.html", content))]


def _settings(study: Study) -> list[Item]:
    folded = Markup("<details><summary>{}</summary><pre>{}</pre></details>")
    manifest = json.dumps(study.manifest, indent=2, ensure_ascii=False, default=str)
    return [folded.format("Configuration, as resolved", study.run.config), folded.format("run.json", manifest)]


SECTIONS = (
    Section("Registration", [pose.notes, _before_and_after, three_d]),
    Section("Displacement", [_displacement, uncertainty.place_table, uncertainty.places, trust.explain]),
    Section("Pose", [pose.pose_table]),
    Section("Landmarks held out", [evaluation.evaluation_table, evaluation.evaluation]),
    Section("Error", [_errors]),
    Section("Stiffness", [parameters.parameter_table, marginals.marginals, stiffness.by_element, stiffness.field]),
    Section("What was observed", [_fit]),
    Section("Chains that disagree", [modes.explain, modes.modes], modes.disagree),
    Section("Convergence", [_convergence, convergence.worst_table, convergence.traces]),
    Section("Figures of the paper", [paper.data, paper.result, paper.node], lambda study: study.is_of_the_paper),
    Section("Model", [_model]),
    Section("Settings", [_settings]),
)
